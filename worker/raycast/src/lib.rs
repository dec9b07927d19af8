//! The ray-casting core: resident tiles and a view to pixels.
//!
//! [`render`] knows no network, no thread pool and no log. A pixel is a function of the
//! store, the camera, the shading and the quality alone: not of the region that is asked
//! for, nor of how a frame is split, nor of which tiles happen to be in memory. Where a
//! tile is needed but not loaded, the tile is named and the pixel left for later; the
//! caller loads what is missing and goes on with [`Progress::advance`] until nothing is.
//!
//! **The surface.** Over each height layer it is the bilinear interpolant of level 0 in
//! every cell whose four posts are valid; later layers lie on top of earlier ones over
//! the rectangle of their posts. The ground is solid: a ray hits at the first point of
//! its way that is at or below the surface of a cell which it is in for a positive
//! length. So the edge of the terrain, the border of a layer and the rim of a void are
//! walls when a ray comes upon them from below, and rays pass over voids. A camera that
//! is at or below the surface sees the colour `below_ground` everywhere.
//!
//! Read in this order: `path` is the way of a ray over flat or round ground, `grid` where it
//! crosses the lines of a layer, `cell` where it meets the surface; `reference` walks from
//! cell to cell, `exact` finds the same contacts by skipping what lies below the ray, with
//! maxima from [`Pyramid`], and `beam` spares it the way that all rays through a square of
//! pixels clear; `field` says which layer holds where.
//!
//! The fast methods, of which `fast` picks one: `claims` is what they believe, `relief` is the surface that they see,
//! `walk` their rays over it, many at a time in the `lanes` of the processor; `lod` casts a
//! ray for each pixel, `column` along the lines of `lattice`. `frustum` and `voxel` stand
//! alone. `progress` turns a region into pixels and `shade` what was seen into colours;
//! `sight` answers without colours, `at_hand` without waiting for tiles, `scout` names tiles early, and [`meter`] measures how far an answer is from that
//! of `exact`.
//!
//! Every PC computes the same bytes: no platform sine, exponential or power and no fused
//! multiplication is used in anything that ends in a pixel.

mod at_hand;
mod beam;
mod cell;
mod claims;
mod column;
mod exact;
mod fast;
mod field;
mod frustum;
mod grid;
mod lanes;
mod lattice;
mod lod;
pub mod meter;
#[cfg(test)]
mod oracle;
mod painter;
mod path;
mod progress;
mod pyramid;
mod reference;
mod relief;
mod scout;
mod seen;
mod shade;
mod sight;
mod srgb;
#[cfg(test)]
mod tests_support;
mod voxel;
mod walk;

pub use at_hand::{Glimpse, render_at_hand};
pub use lanes::Width;
pub use progress::{Progress, Rendered, Stats};
pub use pyramid::Pyramid;
pub use scout::scout;
pub use seen::Unfit;
pub use shade::shade;
pub use sight::{AtHand, Depths, Hit, Missing, Unseen, cast, depths, depths_at_hand, trace};

use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::Shading;
use terrafarm_terrain::resident::Resident;

/// What is to be seen, and how well.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Where from; must be [`Camera::is_valid`].
    pub camera: Camera,
    /// Light, air and the shape of the Earth.
    pub shading: Shading,
    /// Method and samples a pixel.
    pub quality: Quality,
}

/// Renders a region with the tiles at hand. `pyramid` is that of the resident's index.
///
/// Pixels that depend on tiles which are not loaded stay black, and the tiles are named;
/// use [`Progress`] to go on without repeating what is done.
///
/// # Errors
/// If the method is not made for the view.
pub fn render(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
) -> Result<Rendered, Unfit> {
    let mut progress = Progress::new(region);
    let missing = progress.advance(resident, pyramid, view)?;
    Ok(progress.into_rendered(missing))
}
