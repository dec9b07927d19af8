//! The terrain store: one file of hashed tiles, and what is built from it in memory.
//!
//! Read in this order: [`layout`] says what a store contains, [`tile`] what one tile is
//! in memory and [`codec`] as bytes; [`store`] is the file, [`build`] makes one (with the
//! coarser levels and their error bounds), [`cache`] keeps blobs of it on a worker's disk,
//! [`resident`] holds decoded tiles for the ray caster. [`sample`] answers "how high is it
//! here" and holds the definition of the surface; [`rounding`] has the steps of computed
//! heights; [`hillshade`] and [`info`] show people what a store is.
//!
//! Terminology: a *post* is one sample at a grid point; a *cell* lies between four
//! posts; a *tile* is [`layout::TILE_CELLS`] cells a side; a *layer* is a pyramid of
//! grids of one kind; level 0 of a layer is its finest grid.

pub mod build;
pub mod cache;
pub mod codec;
pub mod color;
#[cfg(test)]
mod fixture;
pub mod hillshade;
pub mod info;
pub mod layout;
mod planes;
mod positioned;
mod pyramid;
pub mod resident;
pub mod rounding;
pub mod sample;
pub mod store;
pub mod tile;
