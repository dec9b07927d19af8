//! The `lod` method: every pixel has a ray of its own over the level-of-detail surface.

use crate::View;
use crate::beam::Beams;
use crate::field::Field;
use crate::lanes::{Floats, Ints, Kernel, Lanes, MOST};
use crate::painter::squares;
use crate::path::Ground;
use crate::relief::Relief;
use crate::seen::Seen;
use crate::walk::{Lines, Rows, Walk};
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;

/// The least part of a ray along the map, for one along the axis: straight down has no
/// direction on the map.
const STRAIGHT_DOWN: f64 = 1e-6;

/// Blocks of `1 << FIRST_BLOCK` cells are looked at first.
const FIRST_BLOCK: i32 = 2;
/// Share of a depth that single precision may add to it.
const ROUNDING: f64 = 1e-5;

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
            beams.narrow(square, &mut |x, y, free| {
                let at = (y - region.y) * region.width + (x - region.x);
                pixels.push(Alone { at, free: (free * (1.0 - ROUNDING)) as f32 });
            });
            seen.rays += pixels.len() as u64;
            seen.steps +=
                cast_pixels::<L>(relief, &view.camera, region, &pixels, &mut seen.inverse_depth);
        }
        seen.steps += beams.steps;
        seen
    }
}

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
    let mut steps = 0;
    for pixels in pixels.chunks(L::N) {
        let mut values = [[0.0f32; MOST]; 5];
        let mut places = [0; MOST];
        for lane in 0..L::N {
            // What is left over of the last lanes repeats the last pixel.
            let Alone { at, free } = pixels[lane.min(pixels.len() - 1)];
            let [x, y] = [region.x + at % region.width, region.y + at / region.width];
            let ray = camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let length = (ray.x * ray.x + ray.y * ray.y).sqrt();
            let (along_x, along_y, length) = if length < STRAIGHT_DOWN {
                (1.0, 0.0, STRAIGHT_DOWN)
            } else {
                (ray.x / length, ray.y / length, length)
            };
            for (value, part) in values.iter_mut().zip([along_x, along_y, length, ray.z]) {
                value[lane] = part as f32;
            }
            values[4][lane] = free * length as f32;
            places[lane] = at as i32;
            inverse_depth[at as usize] = 0.0;
        }
        let zero = L::F::splat(0.0);
        let rows = Rows {
            rise: L::F::load(&values[3]),
            higher: zero,
            length: L::F::load(&values[2]),
            longer: zero,
            first: 0.0,
            step: 0.0,
            count: 1,
            at: L::I::load(&places),
            pitch: 0,
        };
        let direction = [L::F::load(&values[0]), L::F::load(&values[1])];
        let lines = Lines::<L>::new(relief, direction);
        let mut walk = Walk::new(relief, lines, rows, L::F::load(&values[4]), FIRST_BLOCK);
        walk.run(inverse_depth);
        steps += walk.looked;
    }
    steps
}
