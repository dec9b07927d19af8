//! The ray caster as a bench asks it: distances, and how far one of them is off.

use super::land::Land;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_raycast::{Missing, Pyramid, Stats, View, cast, render, trace};
use terrafarm_terrain::resident::Resident;

/// Pixels of a picture that are compared with the truth, about.
const CHECKED_PIXELS: f64 = 20_000.0;

/// Distances to the ground through the centres of the pixels of a region.
pub struct Depths {
    /// Metres, row by row; infinite where there is no ground.
    pub distance_m: Vec<f32>,
    /// What it took.
    pub stats: Stats,
}

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

fn depths(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
) -> Result<Depths, Missing> {
    let mut distance_m = vec![f32::INFINITY; region.area() as usize];
    let width = region.width as usize;
    let stats = trace(resident, pyramid, view, region, |x, y, hit| {
        let (column, row) = ((x - region.x) as usize, (y - region.y) as usize);
        distance_m[row * width + column] = hit.map_or(f32::INFINITY, |hit| hit.distance_m as f32);
    })?;
    Ok(Depths { distance_m, stats })
}

fn measure(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    x: u32,
    y: u32,
    claimed_distance_m: f32,
) -> Result<PixelError, Missing> {
    let quality = Quality { method: Method::Exact, ..view.quality };
    let truth = View { quality, ..view.clone() };
    let hit = cast(resident, pyramid, &truth, f64::from(x) + 0.5, f64::from(y) + 0.5)?;
    let distance = hit.map_or(f64::INFINITY, |hit| hit.distance_m);
    let claimed = f64::from(claimed_distance_m);
    let mismatch = distance.is_finite() != claimed.is_finite();
    let off = match (distance.is_finite(), claimed.is_finite()) {
        (true, true) => (distance - claimed).abs() / distance.max(f64::MIN_POSITIVE),
        (false, false) => 0.0,
        _ => f64::INFINITY,
    };
    Ok(PixelError { surface_px: off * view.camera.focal_px(), mismatch })
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
            let pixel = measure(&land.resident, &land.pyramid, view, x, y, claimed)?;
            errors.error_px.push(pixel.error_px());
            errors.mismatched += usize::from(pixel.mismatch);
        }
    }
    Ok(errors)
}
