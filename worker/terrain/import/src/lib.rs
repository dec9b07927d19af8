//! Rasters to a terrain store: mosaic, reproject, fill, report.
//!
//! [`import`] opens elevation rasters, finer insets and photos, and writes one store.
//! The world of a store is one metric projected grid. What already lies on it is taken
//! bit for bit; what does not is resampled bilinearly, never across voids, and the error
//! that this makes is measured and reported. A post is the centre of a sample.
//!
//! Read in this order: [`request`] is what is asked; `place` puts rasters on the map and
//! `plan` decides systems, grids and layers; `mosaic` reads rasters on one lattice as one; `warp` finds samples for
//! posts; `sample` interpolates; `surface` and `photo` give the posts of a layer on
//! demand; `measure` compares; `run` does all of it in order.
//!
//! Reprojected terrain ends where the outermost samples lie, less a part of a cell: a
//! surface is never continued beyond its samples. What a raster claims to cover beyond
//! the centres of its outermost samples is lost likewise.
//!
//! Nothing is held whole. The builder of the store asks for the posts of a tile; a tile
//! asks its inputs for the samples it needs; inputs keep a bounded cache.

mod color;
mod grid;
mod measure;
mod mosaic;
mod photo;
mod place;
mod plan;
pub mod request;
mod run;
mod sample;
mod step;
mod surface;
mod warp;

pub use request::{ImportError, ImportRequest, ImportSettings, ImportSummary, Progress, Stage};
pub use run::{Sources, import, import_rasters};
pub use surface::MAX_FILL_POSTS;
