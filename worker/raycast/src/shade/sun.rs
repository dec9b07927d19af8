//! Sunlight on slopes.
//!
//! It is shared out so that flat ground keeps the brightness that the photo gives it: with n
//! the normal and l the direction of the sun,
//!
//! `light = 1 + strength (min(ambient + (1 - ambient) max(0, n.l) / max(l.z, 0.05), 2) - 1)`.
//!
//! On flat ground n.l = l.z and the light is 1, until the sun is within 3 degrees of the
//! horizon; from there it fades to the ambient share, which is all there is at night.

use crate::lanes::{Floats, Lanes};
use terrafarm_common::shading::Sun;

/// Sine of the sun's elevation below which flat ground grows dark: 2.9 degrees.
const LOW_SUN_SINE: f64 = 0.05;
/// The most light that a slope facing a low sun gets, flat ground being 1.
const MAX_LIGHT: f64 = 2.0;

/// Sunlight on ground: `min(ambient + direct max(0, n.l), most)`.
#[derive(Clone, Copy)]
pub(super) struct Sunlight {
    pub(super) direction: [f32; 3],
    pub(super) ambient: f32,
    pub(super) direct: f32,
    pub(super) most: f32,
}

impl Sunlight {
    pub(super) fn new(sun: &Sun) -> Self {
        let (ambient, strength) = (f64::from(sun.ambient), f64::from(sun.strength));
        let z = sun.direction.z;
        let direct = if z > 0.0 { (1.0 - ambient) / z.max(LOW_SUN_SINE) } else { 0.0 };
        let of = |share: f64| (1.0 + strength * (share - 1.0)) as f32;
        Sunlight {
            direction: sun.direction.as_vec3().to_array(),
            ambient: of(ambient),
            direct: (strength * direct) as f32,
            most: of(MAX_LIGHT),
        }
    }

    /// Light on ground of the given slopes.
    #[inline(always)]
    pub(super) fn light<L: Lanes>(&self, slopes: [L::F; 2], steepness: L::F) -> L::F {
        let [x, y, z] = self.direction;
        let facing = L::F::splat(z) - slopes[0] * L::F::splat(x) - slopes[1] * L::F::splat(y);
        let facing = facing.max(L::F::splat(0.0)).div(steepness);
        let light = L::F::splat(self.ambient) + L::F::splat(self.direct) * facing;
        light.min(L::F::splat(self.most))
    }
}
