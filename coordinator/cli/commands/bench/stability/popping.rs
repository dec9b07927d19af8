//! Does a level of detail pop when it changes?
//!
//! The camera stands still and the tolerance grows by a fiftieth at a time, over an octave:
//! at each step some plots of ground go to a coarser level, and nothing else changes. A
//! pixel moves if what it shows of such a plot has another colour. The claim is about the
//! film, not about a picture: either picture is within its tolerance.

use super::Cell;
use crate::commands::bench::kernel::{self, Refusal};
use crate::commands::bench::land::Land;
use crate::commands::bench::report::quantile;
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Haze, Shading, Sky, Sun};
use terrafarm_raycast::View;

/// Tolerances at which the octave begins, pixels.
const FIRST_PX: [f64; 2] = [0.5, 1.0];
/// How much the tolerance grows at a step; so many steps make an octave.
const GROWTH: f64 = 1.02;
const STEPS: u32 = 35;
/// What a switch may change, steps of 8-bit sRGB, in 999 of 1000 pixels.
const BOUND: f64 = 2.0;
const SHARE: f64 = 0.999;
/// Levels of `column` are chosen for this share of its tolerance.
const COLUMN_LEVELS: f64 = 0.5;
/// Cameras: share of the side of the land at which they stand, height above the highest
/// ground around in metres, and pitch in degrees.
const CAMERAS: [(f64, f64, f64); 2] = [(0.1, 300.0, -6.0), (0.25, 1200.0, -25.0)];
const CLEARED_M: f64 = 200.0;

/// The cells of the methods that have levels.
pub fn cells(land: &Land, size: (u32, u32)) -> anyhow::Result<Vec<Cell>> {
    let mut cells = Vec::new();
    for first_px in FIRST_PX {
        for method in [Method::Lod, Method::Column] {
            let mut moved = Vec::new();
            for stand in CAMERAS {
                let view = view(land, stand, size)?;
                switch(land, &view, method, first_px, &mut moved)
                    .map_err(|Refusal(why)| anyhow::anyhow!("{}: {why}", land.name))?;
            }
            cells.push(cell(method, first_px, moved));
        }
    }
    Ok(cells)
}

fn cell(method: Method, first_px: f64, mut moved: Vec<f64>) -> Cell {
    let scene = format!("switch of levels, camera at rest, {first_px} px");
    let note = format!(
        "max {:.0} of 255 in {} pixels of plots that switched",
        moved.iter().copied().fold(0.0, f64::max),
        moved.len()
    );
    let value = quantile(&mut moved, SHARE);
    Cell::claimed(&scene, method.name(), value, BOUND, "steps of 255, p99.9").with_note(note)
}

/// Photo, sun and haze, as in an ordinary film.
fn view(
    land: &Land,
    (share, above_m, pitch_deg): (f64, f64, f64),
    size: (u32, u32),
) -> anyhow::Result<View> {
    let [x, y] = land.at(share);
    let z = land.highest_around([x, y], CLEARED_M)? + above_m;
    let camera = Camera::from_angles(DVec3::new(x, y, z), 45.0, pitch_deg, 0.0, 60.0, size);
    let color = Sky::default().horizon;
    let shading = Shading {
        sun: Some(Sun::at(315.0, 35.0, 0.35, 0.5)),
        haze: Some(Haze { visibility_m: 60_000.0, scale_height_m: 0.0, color }),
        sky: Sky::default(),
        earth: land.earth(),
        below_ground: [0.0; 3],
        bare_ground: None,
    };
    Ok(View { camera, shading, quality: Quality::default() })
}

/// Goes through an octave of tolerances and adds how much each pixel of a plot that switches
/// has moved, steps of 8-bit sRGB.
fn switch(
    land: &Land,
    view: &View,
    method: Method,
    first_px: f64,
    moved: &mut Vec<f64>,
) -> Result<(), Refusal> {
    let frame = Region::whole(view.camera.width, view.camera.height);
    let at = |method, tolerance_px| View {
        quality: Quality { method, samples_per_side: 1, tolerance_px },
        ..view.clone()
    };
    let levels = if method == Method::Column { COLUMN_LEVELS } else { 1.0 };
    let look = |tolerance_px: f64| -> Result<_, Refusal> {
        let pixels = kernel::picture(land, &at(method, tolerance_px), frame)?;
        // Where the same levels, seen ray by ray, give another answer, a plot has switched.
        let seen = kernel::answer(land, &at(Method::Lod, levels * tolerance_px))?.inverse_depth;
        Ok((pixels, seen))
    };
    let mut before = look(first_px)?;
    for step in 1..=STEPS {
        let after = look(first_px * libm::pow(GROWTH, f64::from(step)))?;
        let colors = before.0.chunks_exact(3).zip(after.0.chunks_exact(3));
        for (seen, (was, is)) in before.1.iter().zip(&after.1).zip(colors) {
            if seen.0.to_bits() != seen.1.to_bits() {
                let apart = was.iter().zip(is).map(|(was, is)| was.abs_diff(*is)).max();
                moved.push(f64::from(apart.unwrap_or(0)));
            }
        }
        before = after;
    }
    Ok(())
}
