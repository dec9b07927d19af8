//! A farm of unlike PCs: strips of one picture by processors with one, eight and sixteen
//! lanes must fit together without a seam.

use super::Cell;
use super::scenes::{look, view};
use crate::commands::bench::kernel::{self, Refusal};
use crate::commands::bench::land::Land;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Haze, Sky, Sun};
use terrafarm_raycast::{View, Width};

/// Width of a strip, pixels: no multiple of any number of lanes.
const STRIP_PX: u32 = 13;

/// A cell for every method and camera.
pub fn cells(land: &Land, size: (u32, u32)) -> anyhow::Result<Vec<Cell>> {
    let [x, y] = land.at(0.2);
    let low = land.highest_around([x, y], 100.0)? + 30.0;
    let mut cells = Vec::new();
    for (name, pose) in [
        ("strips by unlike processors, grazing", look([x, y, low], 45.0, -3.0)),
        ("strips by unlike processors, steep", look([x, y, low + 2500.0], 45.0, -75.0)),
    ] {
        let mut view = view(pose, size, None);
        let color = Sky::default().horizon;
        view.shading.sun = Some(Sun::at(315.0, 35.0, 0.35, 0.5));
        view.shading.haze = Some(Haze { visibility_m: 40_000.0, scale_height_m: 2000.0, color });
        for method in Method::ALL {
            view.quality = Quality { method, samples_per_side: 1, ..Quality::default() };
            cells.push(match differing(land, &view) {
                Ok(bytes) => {
                    let widths: Vec<&str> =
                        Width::available().into_iter().map(Width::name).collect();
                    Cell::measured(name, method.name(), bytes as f64, 0.0, "bytes that differ")
                        .with_note(widths.join(", "))
                }
                Err(Refusal(why)) => Cell::refused(name, method.name(), why),
            });
        }
    }
    Ok(cells)
}

/// Bytes in which a picture of strips by all widths in turn differs from the whole picture
/// by one lane.
fn differing(land: &Land, view: &View) -> Result<usize, Refusal> {
    let (width, height) = (view.camera.width, view.camera.height);
    let whole = Width::One.at_most(|| kernel::picture(land, view, Region::whole(width, height)))?;
    let widths = Width::available();
    let mut differing = 0;
    for (number, x) in (0..width).step_by(STRIP_PX as usize).enumerate() {
        let strip = Region { x, y: 0, width: STRIP_PX.min(width - x), height };
        let lanes = widths[number % widths.len()];
        let pixels = lanes.at_most(|| kernel::picture(land, view, strip))?;
        let row = 3 * strip.width as usize;
        for (strip_row, whole_row) in
            pixels.chunks_exact(row).zip(whole.chunks_exact(3 * width as usize))
        {
            let there = &whole_row[3 * x as usize..][..row];
            differing += strip_row.iter().zip(there).filter(|(a, b)| a != b).count();
        }
    }
    Ok(differing)
}
