//! What the scene switches on: light, air, sky, and the shape of the Earth.
//!
//! Angles are resolved to vectors here, once, by the side that reads the scene file;
//! workers only add and multiply, so that every PC computes the same bytes.

use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// Linear-light RGB, 0 to 1.
pub type LinearRgb = [f32; 3];

/// Everything about a picture that is neither terrain nor camera. Plain values; it
/// travels to the workers as it is. By default the photo is shown as it is, on a flat Earth
/// under a clear sky.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Shading {
    /// Direct light; without it the photo is shown as it is.
    pub sun: Option<Sun>,
    /// Haze that thickens with distance.
    pub haze: Option<Haze>,
    /// Colour of the sky at the zenith and at the horizon.
    pub sky: Sky,
    /// Curvature of the Earth and refraction of the air.
    pub earth: Option<Earth>,
    /// Colour of everything when the camera is below the ground.
    pub below_ground: LinearRgb,
    /// Colour of terrain that no photo covers: height tints if `None`.
    pub bare_ground: Option<LinearRgb>,
}

/// The sun: a direction, and how light is shared between it and the sky.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sun {
    /// Unit vector towards the sun, grid frame.
    pub direction: DVec3,
    /// Light from all of the sky, as a share of full sunlight, 0 to 1.
    pub ambient: f32,
    /// How strongly the sun shades the photo: 0 leaves it as it is, 1 is full Lambert
    /// shading. Photos carry shading of their own, so 1 is for bare terrain.
    pub strength: f32,
}

impl Sun {
    /// A sun at an azimuth clockwise from grid north and an elevation above the horizon.
    pub fn at(azimuth_deg: f64, elevation_deg: f64, ambient: f32, strength: f32) -> Self {
        let (azimuth, elevation) = (azimuth_deg.to_radians(), elevation_deg.to_radians());
        let level = libm::cos(elevation);
        Sun {
            direction: DVec3::new(
                libm::sin(azimuth) * level,
                libm::cos(azimuth) * level,
                libm::sin(elevation),
            ),
            ambient,
            strength,
        }
    }
}

/// Haze after Koschmieder: contrast falls as exp(-3.912 d / visibility).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Haze {
    /// Meteorological visibility, metres: where contrast has fallen to 2 %.
    pub visibility_m: f64,
    /// Height over which the haze thins to 1/e, metres; 0 means the same everywhere.
    pub scale_height_m: f64,
    /// Colour of an infinitely thick layer of it.
    pub color: LinearRgb,
}

/// A clear sky: a gradient from the horizon to the zenith.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sky {
    /// Colour at the horizon.
    pub horizon: LinearRgb,
    /// Colour at the zenith.
    pub zenith: LinearRgb,
}

impl Default for Sky {
    fn default() -> Self {
        Sky { horizon: [0.64, 0.76, 0.90], zenith: [0.10, 0.24, 0.56] }
    }
}

/// The Earth under the grid: rays are straight lines over a sphere of the effective
/// radius R / (1 - k), which stands for curvature and refraction together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Earth {
    /// Radius of curvature of the ground, metres.
    pub radius_m: f64,
    /// Coefficient of refraction k: 0 for none, 0.13 for light in ordinary air.
    pub refraction: f64,
}

impl Earth {
    /// Radii that are taken, metres: from small moons to far beyond planets.
    pub const RADII_M: RangeInclusive<f64> = 1e5..=1e8;
    /// Coefficients of refraction that are taken: beyond, rays bend more than air ever does,
    /// and at 1 they would follow the ground.
    pub const REFRACTIONS: RangeInclusive<f64> = -1.0..=0.9;

    /// R / (1 - k), metres.
    pub fn effective_radius_m(&self) -> f64 {
        self.radius_m / (1.0 - self.refraction)
    }
}
