//! The ray caster as a bench asks it: distances, and how far one of them is off.

use super::land::Land;
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::Shading;
use terrafarm_raycast::{Missing, View, cast, depths, render};

pub use terrafarm_raycast::Depths;

/// Pixels of a picture that are compared with the truth, about.
const CHECKED_PIXELS: f64 = 20_000.0;

/// Why there is no answer: a method that does not do this view says so.
#[derive(Debug, Clone)]
pub struct Refusal(pub String);

impl From<Missing> for Refusal {
    fn from(missing: Missing) -> Self {
        Refusal(format!("{} tiles are not loaded", missing.0.len()))
    }
}

/// How far one distance is off.
pub struct PixelError {
    /// Distance on the picture between the point that is claimed and the surface, pixels.
    pub surface_px: f64,
    /// Whether one is sky and the other ground.
    pub mismatch: bool,
}

impl PixelError {
    /// The error as one number, pixels.
    pub fn error_px(&self) -> f64 {
        self.surface_px
    }
}

/// How far a claimed distance is off: the height of the ray there above or below the
/// surface, as pixels of the picture. A ray cast straight down tells the surface.
fn measure(
    land: &Land,
    view: &View,
    place: [u32; 2],
    claimed_m: f32,
) -> Result<PixelError, Missing> {
    let [x_px, y_px] = place.map(|pixel| f64::from(pixel) + 0.5);
    // Nothing is compared with itself.
    let method = match view.quality.method {
        Method::Exact => Method::Reference,
        _ => Method::Exact,
    };
    let quality = Quality { method, ..view.quality };
    let truth = View { quality, ..view.clone() };
    let seen = cast(&land.resident, &land.pyramid, &truth, x_px, y_px)?;
    let claimed_m = f64::from(claimed_m);
    if !claimed_m.is_finite() {
        return Ok(PixelError { surface_px: 0.0, mismatch: seen.is_some() });
    }
    let point = at_distance(view, x_px, y_px, claimed_m);
    let above = DVec3::new(point.x, point.y, land.pyramid.highest() + 1000.0);
    let down = View {
        camera: Camera::from_angles(above, 0.0, -90.0, 0.0, 1.0, (1, 1)),
        shading: Shading { earth: None, ..view.shading.clone() },
        quality,
    };
    let below = cast(&land.resident, &land.pyramid, &down, 0.5, 0.5)?;
    let scale = view.camera.focal_px() / claimed_m.max(f64::MIN_POSITIVE);
    // Without ground below, what is claimed may still be a wall at the edge of the land.
    let off_m = match (below, seen) {
        (Some(below), _) => (below.height - point.z).abs(),
        (None, Some(seen)) => (seen.distance_m - claimed_m).abs(),
        (None, None) => 0.0,
    };
    let wall_m = seen.map_or(f64::INFINITY, |seen| (seen.distance_m - claimed_m).abs());
    Ok(PixelError { surface_px: off_m.min(wall_m) * scale, mismatch: seen.is_none() })
}

/// The point of a pixel's ray at a distance, on the map and above the sphere if there is
/// one.
fn at_distance(view: &View, x_px: f64, y_px: f64, distance_m: f64) -> DVec3 {
    let (eye, ray) = (view.camera.position, view.camera.ray(x_px, y_px).normalize());
    let Some(earth) = view.shading.earth else { return eye + ray * distance_m };
    let radius = earth.effective_radius_m();
    let level = DVec3::new(ray.x, ray.y, 0.0);
    let (out, up) = (distance_m * level.length(), radius + eye.z + distance_m * ray.z);
    let arc_m = radius * libm::atan2(out, up);
    let on_map = level.normalize_or_zero() * arc_m;
    // The rise above the sphere without the difference of two large numbers.
    let climb = distance_m * (distance_m + 2.0 * (radius + eye.z) * ray.z);
    let rise = climb / (libm::hypot(out, up) + radius + eye.z);
    DVec3::new(eye.x + on_map.x, eye.y + on_map.y, eye.z + rise)
}

/// The distances of a whole picture.
pub fn answer(land: &Land, view: &View) -> Result<Depths, Refusal> {
    answer_in(land, view, Region::whole(view.camera.width, view.camera.height))
}

/// The distances of a region.
pub fn answer_in(land: &Land, view: &View, region: Region) -> Result<Depths, Refusal> {
    Ok(depths(&land.resident, &land.pyramid, view, region)?)
}

/// The pixels of a region, shaded: three bytes of sRGB each.
pub fn picture(land: &Land, view: &View, region: Region) -> Result<Vec<u8>, Refusal> {
    let rendered = render(&land.resident, &land.pyramid, view, region);
    if rendered.missing.is_empty() {
        Ok(rendered.pixels)
    } else {
        Err(Missing(rendered.missing).into())
    }
}

/// Errors of an answer over a net of its pixels.
pub struct Errors {
    /// One a pixel looked at, pixels.
    pub error_px: Vec<f64>,
    /// How many of them are sky instead of ground or ground instead of sky.
    pub mismatched: usize,
}

impl Errors {
    /// Share of the pixels that are mismatched.
    pub fn mismatch(&self) -> f64 {
        self.mismatched as f64 / self.error_px.len().max(1) as f64
    }
}

/// Compares the answer for a region with the surface, over a net of about 20 000 pixels.
pub fn errors(
    land: &Land,
    view: &View,
    region: Region,
    answer: &Depths,
) -> Result<Errors, Refusal> {
    let step = (region.area() as f64 / CHECKED_PIXELS).sqrt().ceil().max(1.0) as u32;
    let along = |side: u32| (((step - 1) / 2).min(side - 1)..side).step_by(step as usize);
    let mut errors = Errors { error_px: Vec::new(), mismatched: 0 };
    for row in along(region.height) {
        for column in along(region.width) {
            let claimed = answer.distance_m[row as usize * region.width as usize + column as usize];
            let (x, y) = (region.x + column, region.y + row);
            let pixel = measure(land, view, [x, y], claimed)?;
            errors.error_px.push(pixel.error_px());
            errors.mismatched += usize::from(pixel.mismatch);
        }
    }
    Ok(errors)
}
