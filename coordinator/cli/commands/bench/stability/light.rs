//! Light and photos where formulas divide by little: a sun at or below the horizon and in
//! the zenith, a checkerboard at the horizon.

use super::Cell;
use super::scenes::{look, view};
use crate::commands::bench::kernel::{self, Refusal};
use crate::commands::bench::land::{Land, Paint};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::Sun;
use terrafarm_raycast::View;

/// Distance between the pixels of the checkerboard, metres, their number, and how many a
/// field has.
const SPACING_M: f64 = 10.0;
const PIXELS: u64 = 1500;
const FIELD: u64 = 8;
/// Dark and bright fields, sRGB.
const FIELDS: [u8; 2] = [63, 231];
/// The picture of the checkerboard: small, since the truth has 64 samples a pixel.
const SIZE: (u32, u32) = (112, 63);
/// Looks at it: heading and pitch in degrees, height in metres.
const LOOKS: [(f64, f64, f64); 3] = [(0.0, -2.0, 120.0), (33.0, -4.0, 300.0), (45.0, -15.0, 900.0)];
/// Least signal to noise against the truth. A picture that takes the colour at the centre of
/// each pixel was measured at 15 dB, one that is smoothed over 3 x 3 pixels at 22.
const LEAST_DB: f64 = 28.0;
const TRUTH_SAMPLES: u32 = 8;

/// Their cells, the sun at a size of the picture in pixels.
pub fn cells(size: (u32, u32)) -> anyhow::Result<Vec<Cell>> {
    let mut cells = suns(size)?;
    cells.extend(checkerboard()?);
    Ok(cells)
}

/// Rough ground under an odd sun: every pixel has a colour. What lies in the shadow of other
/// ground is lit all the same: no shadows are cast, so there is nothing to leak.
fn suns(size: (u32, u32)) -> anyhow::Result<Vec<Cell>> {
    let land = Land::noise(257)?;
    let high = land.highest_around([1280.0; 2], 30.0)? + 500.0;
    let mut cells = Vec::new();
    for (name, altitude) in [
        ("sun below the horizon", -20.0),
        ("sun on the horizon", 0.0),
        ("sun at 0.001 degrees", 0.001),
        ("sun in the zenith", 90.0),
    ] {
        for method in Method::ALL {
            let mut view = view(look([1280.0, 600.0, high], 20.0, -25.0), size, None);
            view.shading.sun = Some(Sun::at(90.0, altitude, 0.35, 1.0));
            view.quality = Quality { method, samples_per_side: 1, ..Quality::default() };
            cells.push(match kernel::picture(&land, &view, Region::whole(size.0, size.1)) {
                Ok(pixels) => {
                    // What has no number for its light stays black.
                    let black = pixels.chunks_exact(3).filter(|pixel| **pixel == [0; 3]).count();
                    Cell::measured(name, method.name(), black as f64, 0.0, "pixels without light")
                        .with_note("no cast shadows".to_owned())
                }
                Err(Refusal(why)) => Cell::refused(name, method.name(), why),
            });
        }
    }
    Ok(cells)
}

/// The checkerboard by every method against 64 samples a pixel.
fn checkerboard() -> anyhow::Result<Vec<Cell>> {
    let color = |i: u64, j: u64| [FIELDS[((i / FIELD + j / FIELD) % 2) as usize]; 3];
    let land = Land::photo("checkerboard", SPACING_M, PIXELS, &Paint(color))?;
    let looks = LOOKS.map(|(heading, pitch, height)| {
        view(look([1203.0, 1207.0, height], heading, pitch), SIZE, None)
    });
    let mut truths = Vec::new();
    for view in &looks {
        let truth = pictures(&land, view, Method::Reference, TRUTH_SAMPLES);
        truths.push(truth.map_err(|Refusal(why)| anyhow::anyhow!("{}: {why}", land.name))?);
    }
    let name = "checkerboard at the horizon";
    let worst = |method| -> Result<f64, Refusal> {
        let mut worst = f64::INFINITY;
        for (view, truth) in looks.iter().zip(&truths) {
            worst = worst.min(psnr(&pictures(&land, view, method, 1)?, truth));
        }
        Ok(worst)
    };
    // The reference itself is meant to be sampled.
    let methods = Method::ALL.into_iter().filter(|method| *method != Method::Reference);
    let cell = |method: Method| match worst(method) {
        Ok(db) => Cell::reached(name, method.name(), db, LEAST_DB, "dB, at least"),
        Err(Refusal(why)) => Cell::refused(name, method.name(), why),
    };
    Ok(methods.map(cell).collect())
}

fn pictures(
    land: &Land,
    view: &View,
    method: Method,
    samples_per_side: u32,
) -> Result<Vec<u8>, Refusal> {
    let quality = Quality { method, samples_per_side, ..Quality::default() };
    let view = View { quality, ..view.clone() };
    kernel::picture(land, &view, Region::whole(SIZE.0, SIZE.1))
}

/// Peak signal to noise, decibels.
fn psnr(a: &[u8], b: &[u8]) -> f64 {
    let squares = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2));
    let mean = squares.sum::<f64>() / a.len().max(1) as f64;
    10.0 * libm::log10(255.0 * 255.0 / mean.max(1e-9))
}
