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
    /// 1 / length of a ray whose part along the camera's axis is 1.
    shortening: L::F,
    /// Direction on the map, and length of `view` along it.
    heading: [L::F; 2],
    level: L::F,
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
    /// Unit vector along which the ray comes in: over a round Earth it is flatter.
    pub view: [L::F; 3],
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
        let one = L::F::splat(1.0);
        let level = view[0] * view[0] + view[1] * view[1];
        let shortening = one.div((level + view[2] * view[2]).sqrt());
        for part in &mut view {
            *part = *part * shortening;
        }
        let level = view[0] * view[0] + view[1] * view[1];
        let level = level.sqrt().max(L::F::splat(STEEPEST as f32));
        let inverse = one.div(level);
        let heading = [view[0] * inverse, view[1] * inverse];
        Ray { view, shortening, heading, level }
    }

    /// Their ends at a map distance.
    #[inline(always)]
    pub(crate) fn end(&self, lens: &Lens, s: L::F) -> End<L> {
        let along = [self.heading[0] * s, self.heading[1] * s];
        let [x, y, z] = self.view;
        if lens.curvature == 0.0 {
            let distance = s.div(self.level);
            let depth = distance * self.shortening;
            return End { along, over: z * distance, distance, depth, view: self.view };
        }
        let one = L::F::splat(1.0);
        let k = L::F::splat(lens.curvature);
        let phi = s * k;
        let square = phi * phi;
        let straight = s.div(self.level) * z;
        let lift = straight * (one - square * L::F::splat(1.0 / 6.0))
            + s * phi * (L::F::splat(0.5) - square * L::F::splat(1.0 / 24.0));
        let grown = L::F::splat(lens.grown);
        let over = (grown * lift).div(one - k * lift);
        // The chord between two points of heights z0 and z, an arc of phi apart.
        let chord = s * s * grown * (grown + k * over);
        let chord = chord * (one - square * L::F::splat(1.0 / 12.0));
        let distance = (over * over + chord).sqrt();
        let depth = distance * self.shortening;
        End { along, over, distance, depth, view: [x, y, z + self.level * phi] }
    }
}
