//! The ray caster as a bench asks it: distances, and how far one of them is off.

use super::land::Land;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_raycast::meter::measure;
use terrafarm_raycast::{Missing, Unfit, Unseen, View, cast, depths, render};

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

impl From<Unfit> for Refusal {
    fn from(unfit: Unfit) -> Self {
        Refusal(unfit.to_string())
    }
}

impl From<Unseen> for Refusal {
    fn from(unseen: Unseen) -> Self {
        match unseen {
            Unseen::Missing(tiles) => Missing(tiles).into(),
            Unseen::Unfit(unfit) => unfit.into(),
        }
    }
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
    let rendered = render(&land.resident, &land.pyramid, view, region)?;
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
    /// How many of them show another cell, or sky instead of ground, or ground instead of sky.
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
            let (x, y) = (region.x + column, region.y + row);
            let claimed = answer.distance_m(view, x, y);
            let pixel = measure(&land.resident, &land.pyramid, view, x, y, claimed)?;
            errors.error_px.push(pixel.error_px());
            errors.mismatched += usize::from(pixel.mismatch);
        }
    }
    Ok(errors)
}

/// Compares an answer with that of the reference, every pixel: errors along the ray as
/// pixels of the picture, infinite where sky and ground are confused.
pub fn from_reference(land: &Land, view: &View, answer: &Depths) -> Result<Vec<f64>, Refusal> {
    let quality = Quality { method: Method::Reference, ..view.quality };
    let truth = View { quality, ..view.clone() };
    let focal_px = view.camera.focal_px();
    let mut errors = Vec::with_capacity(answer.inverse_depth.len());
    for [x, y] in answer.region.pixels() {
        let place = [x, y].map(|pixel| f64::from(pixel) + 0.5);
        let seen = cast(&land.resident, &land.pyramid, &truth, place[0], place[1])?;
        let claimed = answer.distance_m(view, x, y);
        errors.push(match seen {
            None if claimed.is_infinite() => 0.0,
            Some(hit) if claimed.is_finite() => {
                (hit.distance_m - claimed).abs() / hit.distance_m * focal_px
            }
            _ => f64::INFINITY,
        });
    }
    Ok(errors)
}
