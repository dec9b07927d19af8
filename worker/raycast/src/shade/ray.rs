//! Where rays through places of the picture go, from their map distance.
//!
//! All is relative to the camera. Heights are those of `path`, by its formula with phi the
//! arc of the way, its series cut where the next term is below 1e-8 at 300 km:
//!
//! `z - z0 = (1 + z0/R) n / (1 - n/R)`,
//! `n = s tan(elevation) (1 - phi^2/6) + s phi (1/2 - phi^2/24)`.

use crate::lanes::{Floats, Lanes};
use crate::path::Ground;
use terrafarm_common::camera::Camera;
use terrafarm_common::shading::Earth;

/// The least share of a ray's direction along the map: a ray straight down counts as one
/// that moves by this much a metre.
pub(crate) const STEEPEST: f64 = 1e-6;

/// The camera as kernels use it.
pub(crate) struct Lens {
    forward: [f32; 3],
    /// Change of a ray's direction a pixel to the right, and down.
    across: [f32; 3],
    down: [f32; 3],
    /// Middle of the picture, pixels.
    middle: [f32; 2],
    pub right: [f32; 3],
    pub up: [f32; 3],
    /// 1 / effective radius of the Earth, per metre; 0 for flat ground.
    curvature: f32,
    /// 1 + height of the camera / radius.
    grown: f32,
    /// Height of the camera, metres.
    pub eye_z: f32,
}

/// Rays: unit vectors along which they set out.
pub(crate) struct Ray<L: Lanes> {
    pub view: [L::F; 3],
    /// Their directions where the part along the camera's axis is 1: the length, 1 / length,
    /// and the square of the length along the map.
    direction: [L::F; 3],
    length: L::F,
    shortening: L::F,
    across: L::F,
}

/// Where rays end.
pub(crate) struct End<L: Lanes> {
    /// Metres east and north of the camera.
    pub along: [L::F; 2],
    /// Metres over the camera.
    pub over: L::F,
    /// Straight distance from the camera, metres.
    pub distance: L::F,
    /// The same along the camera's axis.
    pub depth: L::F,
    /// How much flatter the ray comes in than it set out, over a round Earth: what is to
    /// be added to the upward part of its direction.
    pub falls: L::F,
}

impl Lens {
    pub(crate) fn new(camera: &Camera, earth: Option<Earth>) -> Self {
        let step = 1.0 / camera.focal_px();
        let curvature = Ground::new(earth).curvature();
        Lens {
            forward: camera.forward.as_vec3().to_array(),
            across: (camera.right * step).as_vec3().to_array(),
            down: (camera.up * -step).as_vec3().to_array(),
            middle: [0.5 * camera.width as f32, 0.5 * camera.height as f32],
            right: camera.right.as_vec3().to_array(),
            up: camera.up.as_vec3().to_array(),
            curvature: curvature as f32,
            grown: (1.0 + curvature * camera.position.z) as f32,
            eye_z: camera.position.z as f32,
        }
    }
}

impl<L: Lanes> Ray<L> {
    /// The rays through places of the picture, pixels from its top left corner.
    #[inline(always)]
    pub(crate) fn new(lens: &Lens, x: L::F, y: L::F) -> Self {
        let x = x - L::F::splat(lens.middle[0]);
        let y = y - L::F::splat(lens.middle[1]);
        let mut view = [L::F::splat(0.0); 3];
        for n in 0..3 {
            let sideways = L::F::splat(lens.across[n]) * x + L::F::splat(lens.down[n]) * y;
            view[n] = L::F::splat(lens.forward[n]) + sideways;
        }
        let direction = view;
        let across = view[0] * view[0] + view[1] * view[1];
        let length = (across + view[2] * view[2]).sqrt();
        let shortening = L::F::splat(1.0).div(length);
        for part in &mut view {
            *part = *part * shortening;
        }
        Ray { view, direction, length, shortening, across }
    }

    /// The part along the camera's axis of the way to a map distance; the ways here are as
    /// long as if the ground were flat.
    #[inline(always)]
    pub(crate) fn depth_of_map(&self, s: L::F) -> L::F {
        let least = self.length * L::F::splat(STEEPEST as f32);
        s.div(self.across.sqrt().max(least))
    }

    /// The same to where one over it is known.
    #[inline(always)]
    pub(crate) fn depth_of_inverse(&self, inverse: L::F) -> L::F {
        L::F::splat(1.0).div(inverse)
    }

    /// Their ends at such a depth.
    #[inline(always)]
    pub(crate) fn end(&self, lens: &Lens, depth: L::F) -> End<L> {
        let [x, y, z] = self.direction;
        let along = [x * depth, y * depth];
        let straight = z * depth;
        let way = depth * self.length;
        if lens.curvature == 0.0 {
            let falls = L::F::splat(0.0);
            return End { along, over: straight, distance: way, depth, falls };
        }
        let one = L::F::splat(1.0);
        let k = L::F::splat(lens.curvature);
        // The square of the way along the map, over the radius: s phi.
        let bent = self.across * depth * depth * k;
        let square = bent * k;
        let lift = straight * (one - square * L::F::splat(1.0 / 6.0))
            + bent * (L::F::splat(0.5) - square * L::F::splat(1.0 / 24.0));
        let grown = L::F::splat(lens.grown);
        let over = (grown * lift).div(one - k * lift);
        // By the law of sines: the end is (1 + z/R) sin(phi) / cos(elevation) radii away.
        let longer = (grown + k * over) * (one - square * L::F::splat(1.0 / 6.0));
        let falls = self.across * self.shortening * depth * k;
        End { along, over, distance: way * longer, depth: depth * longer, falls }
    }
}
