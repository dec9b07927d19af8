//! The photo under a pixel: filtered over its footprint.
//!
//! The level of the photo's pyramid follows from the short axis of the footprint; along
//! the long axis several samples are taken. So the photo neither swims at the horizon,
//! where footprints are long and narrow, nor blurs across.

use super::footprint::{Axes, Footprint, level_of};
use super::stack::Stack;
use crate::field::{Field, Wanted};
use terrafarm_terrain::layout::LayerKind;
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::tile::PhotoTile;

/// The most samples along a footprint; longer ones take a coarser level.
const MAX_SAMPLES: f64 = 16.0;
/// Coverage from which on a photo hides what lies below it.
const OPAQUE: f32 = 0.999;

/// Reads the photos of a store.
pub(crate) struct Photos<'a> {
    /// Topmost first.
    stacks: Vec<Stack<'a, PhotoTile>>,
}

impl<'a> Photos<'a> {
    pub(crate) fn new(field: Field<'a>) -> Self {
        let layers = field.index().layers_of(LayerKind::Photo);
        let mut stacks: Vec<_> =
            layers.map(|(number, _)| Stack::new(field, number, Resident::photo)).collect();
        stacks.reverse();
        Photos { stacks }
    }

    /// Colour (premultiplied) and coverage at a place of the map. Tiles that are not
    /// loaded are added to `wanted` and count as bare.
    pub(crate) fn sample(
        &mut self,
        place: [f64; 2],
        footprint: &Footprint,
        wanted: &mut Wanted,
    ) -> [f32; 4] {
        let mut sum = [0.0; 4];
        for stack in &mut self.stacks {
            let texel = stack.posts_at(place);
            let inside = |axis: usize| {
                texel[axis] >= -0.5 && texel[axis] <= stack.layer.posts[axis] as f64 - 0.5
            };
            if !inside(0) || !inside(1) {
                continue;
            }
            let axes = footprint.axes(stack.layer.spacing);
            let below = filtered(stack, texel, &axes, wanted);
            let uncovered = 1.0 - sum[3];
            for channel in 0..4 {
                sum[channel] += uncovered * below[channel];
            }
            if sum[3] >= OPAQUE {
                break;
            }
        }
        sum
    }
}

/// The mean over a footprint, blended from the two levels whose texels are at most as
/// wide as it, and at least.
fn filtered(
    stack: &mut Stack<PhotoTile>,
    texel: [f64; 2],
    axes: &Axes,
    wanted: &mut Wanted,
) -> [f32; 4] {
    let width = axes.minor_length.max(axes.major_length * (1.0 / MAX_SAMPLES)).max(1.0);
    let (level, share) = level_of(width, stack.top());
    let samples = (axes.major_length / width).clamp(1.0, MAX_SAMPLES);
    let fine = mean(stack, level, samples, texel, axes, wanted);
    if share == 0.0 {
        return fine;
    }
    // Texels twice as wide need half as many samples.
    let coarse = mean(stack, level + 1, (0.5 * samples).max(1.0), texel, axes, wanted);
    let mut sum = fine;
    for channel in 0..4 {
        sum[channel] += (coarse[channel] - fine[channel]) * share;
    }
    sum
}

/// The mean of samples of one level along the long axis of a footprint; their number is
/// rounded up.
#[inline]
fn mean(
    stack: &mut Stack<PhotoTile>,
    level: usize,
    samples: f64,
    texel: [f64; 2],
    axes: &Axes,
    wanted: &mut Wanted,
) -> [f32; 4] {
    let below = samples as u32;
    let count = below + u32::from(samples > f64::from(below));
    let share = 1.0 / f64::from(count);
    let step = [axes.major.x * share, axes.major.y * share];
    let first = 0.5 - 0.5 * f64::from(count);
    let mut sum = [0.0; 4];
    for sample in 0..count {
        let along = first + f64::from(sample);
        let place = [texel[0] + step[0] * along, texel[1] + step[1] * along];
        let color = bilinear(stack, level, place, wanted);
        for channel in 0..4 {
            sum[channel] += color[channel];
        }
    }
    let scale = share as f32 * (1.0 / 65535.0);
    [sum[0] * scale, sum[1] * scale, sum[2] * scale, sum[3] * scale]
}

/// Colour at a place of level 0, from a level of the pyramid, 65535 = 1.
#[inline]
fn bilinear(
    stack: &mut Stack<PhotoTile>,
    level: usize,
    place: [f64; 2],
    wanted: &mut Wanted,
) -> [f32; 4] {
    let Some(spot) = stack.spot(level, place, wanted) else { return [0.0; 4] };
    let ([i, j], [x, y]) = (spot.cell, spot.share);
    let (sw, se) = (spot.tile.texel(i, j), spot.tile.texel(i + 1, j));
    let (nw, ne) = (spot.tile.texel(i, j + 1), spot.tile.texel(i + 1, j + 1));
    let mut color = [0.0; 4];
    for channel in 0..4 {
        let from = f32::from(sw[channel]);
        let south = from + (f32::from(se[channel]) - from) * x;
        let from = f32::from(nw[channel]);
        let north = from + (f32::from(ne[channel]) - from) * x;
        color[channel] = south + (north - south) * y;
    }
    color
}
