//! Reads the raster files that GIS people own: elevation and photos.
//!
//! [`open`] looks at the bytes, not only at the name, and gives a [`Raster`]: a grid with
//! a place on the map from which windows can be read. Files are never loaded whole
//! unless their format leaves no choice, and nothing is allocated for before the declared
//! size has been checked against the file's length and a named limit.
//!
//! One module per format, each with an `open` that takes a [`Source`], which may be a
//! piece of memory: [`tiff`], [`hgt`], [`esri_ascii`], [`usgs_dem`], [`png_file`],
//! [`jpeg_file`].

mod blocks;
pub mod esri_ascii;
pub mod hgt;
pub mod info;
pub mod jpeg_file;
pub mod limits;
mod open;
pub mod options;
pub mod png_file;
mod sidecar;
pub mod source;
pub mod tiff;
pub mod usgs_dem;
mod whole;

pub use info::{Content, GeoTransform, Raster, RasterError, RasterInfo, Vertical, Window};
pub use open::{open, open_source};
pub use options::{HeightUnit, OpenOptions, PngEncoding};
pub use source::{Sidecars, Source};
