//! Haze between the camera and the ground, and the sky behind.

use glam::DVec3;
use terrafarm_common::shading::{Haze, LinearRgb, Shading, Sun};

/// Contrast falls to 2 % at the visibility: 3.912 = -ln 0.02 (Koschmieder).
const KOSCHMIEDER: f64 = 3.912;
/// Depth of the layer of haze that the sky is seen through if it has no scale height.
const UNIFORM_LAYER_M: f64 = 1500.0;
/// Sine of the elevation that is added so that the layer is not infinitely deep at the
/// horizon.
const HORIZON_SINE: f64 = 0.01;
/// 1 - cosine of the apparent radius of the sun, 0.267 degrees.
const SUN_DISC: f64 = 1.086e-5;
/// Light of the sun's disc and of the two glows around it, as shares of full light.
const SUN_COLOR: [f32; 3] = [1.0, 0.93, 0.80];

/// The air of a scene as seen from one place.
pub(crate) struct Air<'s> {
    shading: &'s Shading,
    /// Extinction at the height of the camera, per metre.
    extinction: f64,
    camera_z: f64,
    haze: Option<Haze>,
}

impl<'s> Air<'s> {
    /// `lowest_z` is the height at which the visibility holds: the lowest ground.
    pub(crate) fn new(shading: &'s Shading, lowest_z: f64, camera_z: f64) -> Self {
        let haze = shading.haze.filter(|haze| haze.visibility_m > 0.0);
        let extinction = haze.map_or(0.0, |haze| {
            let above = if haze.scale_height_m > 0.0 {
                (camera_z - lowest_z) / haze.scale_height_m
            } else {
                0.0
            };
            KOSCHMIEDER / haze.visibility_m * libm::exp(-above.clamp(-50.0, 700.0))
        });
        Air { shading, extinction, camera_z, haze }
    }

    /// Light from ground at a distance and height, after the air between.
    pub(crate) fn veil(
        &self,
        ground: LinearRgb,
        view: DVec3,
        distance_m: f64,
        z: f64,
    ) -> LinearRgb {
        let Some(haze) = self.haze else { return ground };
        // The integral of exp(-h / H) along a line is its length times the mean of
        // exp over the two ends' exponents, (1 - exp(-x)) / x for their difference x.
        let mean = if haze.scale_height_m > 0.0 {
            let x = ((z - self.camera_z) / haze.scale_height_m).clamp(-700.0, 700.0);
            if x.abs() < 1e-5 { 1.0 - 0.5 * x } else { (1.0 - libm::exp(-x)) / x }
        } else {
            1.0
        };
        let clear = libm::exp(-(self.extinction * distance_m * mean).min(700.0)) as f32;
        let glow = self.glow(view);
        let veiled = |c: usize| ground[c] * clear + (haze.color[c] + glow[c]) * (1.0 - clear);
        [veiled(0), veiled(1), veiled(2)]
    }

    /// The sky in a direction. Below the horizon it is what the horizon is.
    pub(crate) fn sky(&self, view: DVec3) -> LinearRgb {
        let sine = view.z.max(0.0);
        let sky = &self.shading.sky;
        let up = sine.sqrt() as f32;
        let mut color = [0, 1, 2].map(|c| sky.horizon[c] + (sky.zenith[c] - sky.horizon[c]) * up);
        if let Some(haze) = self.haze {
            let layer =
                if haze.scale_height_m > 0.0 { haze.scale_height_m } else { UNIFORM_LAYER_M };
            let depth = self.extinction * layer / (sine + HORIZON_SINE);
            // Just below the horizon all is haze, just above it nearly so.
            let clear = if view.z > 0.0 { libm::exp(-depth.min(700.0)) as f32 } else { 0.0 };
            color = [0, 1, 2].map(|c| color[c] * clear + haze.color[c] * (1.0 - clear));
        }
        let glow = self.glow(view);
        let disc = self.disc(view);
        [0, 1, 2].map(|c| color[c] + glow[c] + disc * SUN_COLOR[c])
    }

    /// Light scattered around the sun: a narrow and a wide glow.
    fn glow(&self, view: DVec3) -> LinearRgb {
        let Some(sun) = self.sun_above() else { return [0.0; 3] };
        let away = 1.0 - view.dot(sun.direction);
        let light = (0.35 / (1.0 + 900.0 * away) + 0.08 / (1.0 + 15.0 * away)) as f32;
        SUN_COLOR.map(|color| color * light)
    }

    fn disc(&self, view: DVec3) -> f32 {
        let Some(sun) = self.sun_above().filter(|_| view.z > 0.0) else { return 0.0 };
        let away = 1.0 - view.dot(sun.direction);
        let edge = ((1.25 * SUN_DISC - away) / (0.5 * SUN_DISC)).clamp(0.0, 1.0) as f32;
        edge * edge * (3.0 - 2.0 * edge)
    }

    fn sun_above(&self) -> Option<Sun> {
        self.shading.sun.filter(|sun| sun.direction.z > 0.0)
    }
}
