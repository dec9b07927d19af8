//! The `lod` method: every pixel has a ray of its own over the level-of-detail surface.

use crate::lanes::{Floats, Ints, Lanes, MOST};
use crate::relief::Relief;
use crate::walk::{Lines, Rows, Walk};
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;

/// The least part of a ray along the map, for one along the axis: straight down has no
/// direction on the map.
const STRAIGHT_DOWN: f64 = 1e-6;

/// How much closer than the nearest ground seen around a pixel its own ray begins to
/// look: a ridge comes closer along its line.
const SHARE_FREE: f32 = 0.9;

/// A pixel that is to have a ray of its own.
#[derive(Clone, Copy)]
pub(crate) struct Alone {
    /// Its place in the region.
    pub at: u32,
    /// One over the least depth at which there may be ground: infinite if not known.
    pub nearest: f32,
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
            let Alone { at, nearest } = pixels[lane.min(pixels.len() - 1)];
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
            values[4][lane] = if nearest > 0.0 { SHARE_FREE * (length as f32 / nearest) } else { 0.0 };
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
        let mut walk = Walk::new(relief, lines, rows, L::F::load(&values[4]), 2);
        walk.run(inverse_depth);
        steps += walk.looked;
    }
    steps
}
