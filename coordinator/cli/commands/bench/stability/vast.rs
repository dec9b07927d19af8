//! More posts than 32 bits count: ground at the far corner of an index of 65 536 x 65 536
//! cells, all else void, is the same ground as in a store of its own.

use super::Cell;
use super::judge;
use super::scenes::{Scene, Truth, look, view};
use crate::commands::bench::kernel::{self, Refusal};
use crate::commands::bench::land::{Land, Rule, height_layer};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_raycast::View;
use terrafarm_terrain::build::LayerSpec;

/// Cells along a side of the vast store ...
const CELLS: u64 = 65_536;
/// ... and of the ground.
const GROUND: u64 = 256;
/// A power of two: every post has the same coordinates in both stores, to the bit.
const SPACING_M: f64 = 8.0;

/// A cell for every method. The long form builds the store post by post, which takes
/// minutes; the short form makes up its index.
pub fn cells(size: (u32, u32), short: bool) -> anyhow::Result<Vec<Cell>> {
    let first = CELLS - GROUND;
    let origin = [first as f64 * SPACING_M; 2];
    let height = |i: u64, j: u64| (500 + (i * 7919 + j * 104_729) % 97) as f32;
    let layer = |side: u64| height_layer([SPACING_M; 2], [side + 1; 2], Some(1.0));
    let alone = || {
        let spec = LayerSpec { origin, ..layer(GROUND) };
        Land::made("corner", None, spec, &Rule(height))
    };
    let vast = if short {
        alone()?.moved_to_far_corner([CELLS; 2])?
    } else {
        let rule = move |i: u64, j: u64| {
            if i.min(j) >= first { height(i - first, j - first) } else { f32::NAN }
        };
        Land::made("vast", None, layer(CELLS), &Rule(rule))?
    };
    let alone = alone()?;
    let name = "far corner of more than 2^31 posts";
    let [x, y] = origin.map(|from| from + 0.4 * GROUND as f64 * SPACING_M);
    let view = view(look([x, y, 900.0], 45.0, -25.0), size, None);
    let scene = Scene { name, land: vast, view, truth: Truth::Surface };
    let cell = |method: Method| {
        let quality = Quality { method, samples_per_side: 1, ..Quality::default() };
        match differing(&scene, &alone, quality) {
            // It sees coarser levels, which differ: the vast ones have voids.
            _ if method == Method::Voxel => judge::cell(&scene, quality),
            Ok(pixels) => {
                Cell::measured(name, method.name(), pixels as f64, 0.0, "pixels that differ")
            }
            Err(Refusal(why)) => Cell::refused(name, method.name(), why),
        }
    };
    Ok(Method::ALL.into_iter().map(cell).collect())
}

/// Pixels whose distance differs between a scene and the same over another land by more than
/// the last bit: places are counted in cells from the first post, so that a number of this
/// size has nine bits less behind the point.
fn differing(scene: &Scene, other: &Land, quality: Quality) -> Result<usize, Refusal> {
    let view = View { quality, ..scene.view.clone() };
    let [a, b] = [kernel::answer(&scene.land, &view)?, kernel::answer(other, &view)?];
    let ground = a.inverse_depth.iter().filter(|inverse| **inverse > 0.0).count();
    let apart = a.inverse_depth.iter().zip(&b.inverse_depth);
    let apart = apart.filter(|(a, b)| a.to_bits().abs_diff(b.to_bits()) > 1).count();
    // No ground at all would agree, too.
    Ok(if ground == 0 { a.inverse_depth.len() } else { apart })
}
