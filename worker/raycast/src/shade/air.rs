//! Haze between the camera and the ground, and the sky behind.

use super::exp::exp;
use super::slope::lerp;
use crate::lanes::{Floats, Lanes};
use terrafarm_common::shading::{LinearRgb, Shading};

/// Contrast falls to 2 % at the visibility: 3.912 = -ln 0.02 (Koschmieder).
const KOSCHMIEDER: f64 = 3.912;
/// Depth of the layer of haze that the sky is seen through if it has no scale height.
const UNIFORM_LAYER_M: f64 = 1500.0;
/// Sine of the elevation that is added so that the layer is not infinitely deep at the
/// horizon.
const HORIZON_SINE: f32 = 0.01;
/// 1 - cosine of the apparent radius of the sun, 0.267 degrees.
const SUN_DISC: f32 = 1.086e-5;
/// Light of the sun's disc and of the two glows around it, as shares of full light.
const SUN_COLOR: [f32; 3] = [1.0, 0.93, 0.80];
/// Of the narrow and the wide glow around the sun: light at its middle, and how fast it
/// falls.
const GLOWS: [(f32, f32); 2] = [(0.35, 900.0), (0.08, 15.0)];
/// Exponents below which the mean over a slanted way is a series.
const FLAT_WAY: f32 = 0.05;

/// The air of a scene as seen from one place.
pub(crate) struct Air {
    horizon: LinearRgb,
    /// Zenith less horizon.
    higher: LinearRgb,
    haze: Option<Haze>,
    /// Direction of the sun, if it is up.
    sun: Option<[f32; 3]>,
}

struct Haze {
    color: LinearRgb,
    /// Extinction at the height of the camera, per metre.
    extinction: f32,
    /// Extinction of the whole layer above the camera.
    layer: f32,
    /// 1 / scale height, per metre; 0 for a haze that is the same everywhere.
    thinning: f32,
}

impl Air {
    /// `lowest_z` is the height at which the visibility holds: the lowest ground.
    pub(crate) fn new(shading: &Shading, lowest_z: f64, camera_z: f64) -> Self {
        let haze = shading.haze.filter(|haze| haze.visibility_m > 0.0).map(|haze| {
            let thins = haze.scale_height_m > 0.0;
            let above = if thins { (camera_z - lowest_z) / haze.scale_height_m } else { 0.0 };
            let extinction =
                KOSCHMIEDER / haze.visibility_m * libm::exp(-above.clamp(-50.0, 700.0));
            let depth = if thins { haze.scale_height_m } else { UNIFORM_LAYER_M };
            Haze {
                color: haze.color,
                extinction: extinction as f32,
                layer: (extinction * depth) as f32,
                thinning: if thins { (1.0 / haze.scale_height_m) as f32 } else { 0.0 },
            }
        });
        let sky = &shading.sky;
        let sun = shading.sun.filter(|sun| sun.direction.z > 0.0);
        Air {
            horizon: sky.horizon,
            higher: [0, 1, 2].map(|c| sky.zenith[c] - sky.horizon[c]),
            haze,
            sun: sun.map(|sun| sun.direction.as_vec3().to_array()),
        }
    }

    /// Light from ground at a distance and a height over the camera, after the air between.
    #[inline(always)]
    pub(crate) fn veil<L: Lanes>(
        &self,
        ground: [L::F; 3],
        view: [L::F; 3],
        distance_m: L::F,
        over: L::F,
    ) -> [L::F; 3] {
        let Some(haze) = &self.haze else { return ground };
        let mut depth = L::F::splat(-haze.extinction) * distance_m;
        if haze.thinning > 0.0 {
            // The integral of exp(-h / H) along a line is its length times the mean of exp
            // over the two ends' exponents: (1 - exp(-x)) / x for their difference x, by way
            // of exp(-|x|), which cannot be too large.
            let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
            let rise = over * L::F::splat(haze.thinning);
            let x = rise.abs();
            let fall = exp::<L>(-x);
            let long = (one - fall).div(L::F::select(rise.lt(zero), x * fall, x));
            let series = one
                - rise
                    * (L::F::splat(0.5)
                        - rise * (L::F::splat(1.0 / 6.0) - rise * L::F::splat(1.0 / 24.0)));
            depth = depth * L::F::select(x.lt(L::F::splat(FLAT_WAY)), series, long);
        }
        let clear = exp::<L>(depth);
        let glow = self.glow::<L>(view);
        let mut veiled = ground;
        for c in 0..3 {
            let air = L::F::splat(haze.color[c]) + glow * L::F::splat(SUN_COLOR[c]);
            veiled[c] = lerp::<L>(air, ground[c], clear);
        }
        veiled
    }

    /// The sky in a direction. Below the horizon it is what the horizon is.
    #[inline(always)]
    pub(crate) fn sky<L: Lanes>(&self, view: [L::F; 3]) -> [L::F; 3] {
        let zero = L::F::splat(0.0);
        let sine = view[2].max(zero);
        let up = sine.sqrt();
        let mut clear = L::F::splat(1.0);
        if let Some(haze) = &self.haze {
            let depth = L::F::splat(-haze.layer).div(sine + L::F::splat(HORIZON_SINE));
            // Just below the horizon all is haze, just above it nearly so.
            clear = L::F::select(zero.lt(view[2]), exp::<L>(depth), zero);
        }
        let sun = self.glow::<L>(view) + self.disc::<L>(view);
        let mut color = [zero; 3];
        for c in 0..3 {
            let bare = L::F::splat(self.horizon[c]) + L::F::splat(self.higher[c]) * up;
            let veil = self.haze.as_ref().map_or(0.0, |haze| haze.color[c]);
            color[c] = lerp::<L>(L::F::splat(veil), bare, clear) + sun * L::F::splat(SUN_COLOR[c]);
        }
        color
    }

    /// Light scattered around the sun: a narrow and a wide glow.
    #[inline(always)]
    fn glow<L: Lanes>(&self, view: [L::F; 3]) -> L::F {
        let Some(sun) = self.sun else { return L::F::splat(0.0) };
        let away = away::<L>(sun, view);
        let one = L::F::splat(1.0);
        let [(near, steep), (wide, flat)] = GLOWS;
        let steep = one + L::F::splat(steep) * away;
        let flat = one + L::F::splat(flat) * away;
        (L::F::splat(near) * flat + L::F::splat(wide) * steep).div(steep * flat)
    }

    #[inline(always)]
    fn disc<L: Lanes>(&self, view: [L::F; 3]) -> L::F {
        let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
        let Some(sun) = self.sun else { return zero };
        let edge = L::F::splat(1.25 * SUN_DISC) - away::<L>(sun, view);
        let edge = (edge * L::F::splat(2.0 / SUN_DISC)).max(zero).min(one);
        let disc = edge * edge * (L::F::splat(3.0) - edge - edge);
        L::F::select(zero.lt(view[2]), disc, zero)
    }
}

/// 1 - the cosine of the angle to the sun, exact also close to it.
#[inline(always)]
fn away<L: Lanes>(sun: [f32; 3], view: [L::F; 3]) -> L::F {
    let x = view[0] - L::F::splat(sun[0]);
    let y = view[1] - L::F::splat(sun[1]);
    let z = view[2] - L::F::splat(sun[2]);
    (x * x + y * y + z * z) * L::F::splat(0.5)
}
