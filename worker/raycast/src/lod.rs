//! The `lod` method: every pixel has a ray of its own over the level-of-detail surface.

use crate::View;
use crate::beam::Beams;
use crate::field::Field;
use crate::lanes::{Floats, Ints, Kernel, Lanes, MOST};
use crate::lattice::Frame;
use crate::painter::squares;
use crate::path::Ground;
use crate::relief::Relief;
use crate::seen::Seen;
use crate::walk::{Fineness, Lines, Places, Rows, Walk};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;

/// The least part of a ray along the map, for one along the axis: straight down has no
/// direction on the map.
const STRAIGHT_DOWN: f32 = 1e-6;

/// Blocks of `1 << FIRST_BLOCK` cells are looked at first.
const FIRST_BLOCK: i32 = 2;
/// Depth at which a ray began, as a share of that at which it ended, from which on the two
/// are the same but for rounding.
const STARTED_BELOW: f32 = 1.0 - 1e-4;
/// Share of a depth that single precision may add to it.
const ROUNDING: f64 = 1e-5;

/// Share of the surface's tolerance by which it may be off the straight lines that rays see.
const STRAIGHT: f64 = 0.1;

/// A pixel that is to have a ray of its own.
#[derive(Clone, Copy)]
pub(crate) struct Alone {
    /// Its place in the region.
    pub at: u32,
    /// The depth up to which there is no ground, metres.
    pub free: f32,
}

/// The method for a region of a view.
pub(crate) struct Lod<'r, 'a> {
    pub field: Field<'a>,
    pub relief: &'r Relief<'a>,
    pub view: &'r View,
    pub region: Region,
    /// How far the surface may be above that of level 0, metres for each metre away.
    pub slack: f64,
}

impl Kernel for Lod<'_, '_> {
    type Output = Seen;

    #[inline(always)]
    fn run<L: Lanes>(self) -> Seen {
        let Lod { field, relief, view, region, slack } = self;
        let mut seen = Seen::new(region);
        let ground = Ground::new(view.shading.earth);
        let mut beams = Beams::with_slack(field, &view.camera, ground, slack);
        let mut pixels = Vec::new();
        for square in squares(region) {
            pixels.clear();
            beams.narrow(square, &mut |part, free| {
                let free = (free * (1.0 - ROUNDING)) as f32;
                pixels.extend(part.pixels().map(|[x, y]| {
                    let at = (y - region.y) * region.width + (x - region.x);
                    Alone { at, free }
                }));
            });
            seen.rays += pixels.len() as u64;
            seen.steps +=
                cast_pixels::<L>(relief, &view.camera, region, &pixels, &mut seen.inverse_depth);
        }
        seen.steps += beams.steps;
        seen
    }
}

/// How much more the next ray of a line would rise, for a depth of 1: so little that ground
/// never counts as equally far.
const NEXT_RAY: f32 = 1e-6;

/// Casts the rays of some pixels, by their place in the region, and writes one over their
/// depths: 0 for the sky, NaN where a tile is missing. Returns the steps that it took.
#[inline(always)]
pub(crate) fn cast_pixels<L: Lanes>(
    relief: &Relief,
    camera: &Camera,
    region: Region,
    pixels: &[Alone],
    inverse_depth: &mut [f32],
) -> u64 {
    let mut again = Vec::new();
    let mut steps = cast_from::<L>(relief, camera, region, pixels, inverse_depth);
    for &Alone { at, free } in pixels {
        // Ground where the ray began: it may have begun below.
        if free > 0.0 && inverse_depth[at as usize] * free > STARTED_BELOW {
            again.push(Alone { at, free: 0.0 });
        }
    }
    if !again.is_empty() {
        steps += cast_from::<L>(relief, camera, region, &again, inverse_depth);
    }
    steps
}

#[inline(always)]
fn cast_from<L: Lanes>(
    relief: &Relief,
    camera: &Camera,
    region: Region,
    pixels: &[Alone],
    inverse_depth: &mut [f32],
) -> u64 {
    let mut steps = 0;
    let fineness = Fineness { straight: (STRAIGHT * relief.tolerance) as f32, apart: 0.0 };
    let frame = Frame::new(camera, true);
    let part = |vector: DVec3| vector.as_vec3().to_array();
    let (corner, right, down) = (part(frame.corner), part(frame.minor), part(frame.major));
    let zero = L::F::splat(0.0);
    for pixels in pixels.chunks(L::N) {
        let mut values = [[0.0f32; MOST]; 3];
        let mut places = [0; MOST];
        for lane in 0..L::N {
            // What is left over of the last lanes repeats the last pixel.
            let Alone { at, free } = pixels[lane.min(pixels.len() - 1)];
            values[0][lane] = (region.x + at % region.width) as f32 + 0.5;
            values[1][lane] = (region.y + at / region.width) as f32 + 0.5;
            values[2][lane] = free;
            places[lane] = at as i32;
            inverse_depth[at as usize] = 0.0;
        }
        let (x, y) = (L::F::load(&values[0]), L::F::load(&values[1]));
        let mut ray = [zero; 3];
        for n in 0..3 {
            ray[n] = L::F::splat(corner[n]) + x * L::F::splat(right[n]) + y * L::F::splat(down[n]);
        }
        let across = (ray[0] * ray[0] + ray[1] * ray[1]).sqrt();
        let across = across.max(L::F::splat(STRAIGHT_DOWN));
        let inverse = L::F::splat(1.0).div(across);
        let rows = Rows::new([ray[2], L::F::splat(NEXT_RAY)], [across, zero], 0, 0);
        let places = Places { at: L::I::load(&places), pitch: 0, behind: None };
        let lines = Lines::<L>::new(relief, [ray[0] * inverse, ray[1] * inverse]);
        let free = L::F::load(&values[2]) * across;
        let mut walk = Walk::new(relief, lines, rows, places, free, FIRST_BLOCK, fineness);
        walk.run(inverse_depth);
        steps += walk.looked;
    }
    steps
}
