//! Does a level of detail pop when it changes?
//!
//! The camera and the tolerance stand still. At first the coarser levels claim to be twice as
//! far from level 0 as they are, which is as true; over an octave of small steps they come to
//! claim what is so. At each step some plots of ground go towards a coarser level, and
//! nothing else changes. A pixel moves if what it shows of such a plot has another colour.
//! The claim is about the film, not about a picture: either picture is within its tolerance.

use super::Cell;
use crate::commands::bench::kernel::Refusal;
use crate::commands::bench::land::Land;
use crate::commands::bench::report::quantile;
use glam::DVec3;
use std::sync::Arc;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Haze, Shading, Sky, Sun};
use terrafarm_raycast::{Missing, Pyramid, View, depths, render};
use terrafarm_terrain::layout::{StoreIndex, TileKey};
use terrafarm_terrain::resident::{Resident, Tile};

/// Tolerances, pixels.
const TOLERANCES_PX: [f64; 2] = [0.5, 1.0];
/// Steps to the octave: what is allowed grows by a fiftieth at each.
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
    let mut cases = Vec::new();
    for tolerance_px in TOLERANCES_PX {
        for method in [Method::Lod, Method::Column] {
            let quality = Quality { method, samples_per_side: 1, tolerance_px };
            let views = CAMERAS.map(|stand| view(land, stand, size, quality));
            let views = views.into_iter().collect::<anyhow::Result<Vec<View>>>()?;
            let before = views.iter().map(|_| None).collect();
            cases.push(Case { views, before, moved: Vec::new() });
        }
    }
    let tiles = land.tiles()?;
    for step in 0..=STEPS {
        let octave = f64::from(STEPS - step) / f64::from(STEPS);
        let (resident, pyramid) = claiming(land, &tiles, libm::exp2(octave) as f32);
        for case in &mut cases {
            case.look(&resident, &pyramid)
                .map_err(|Refusal(why)| anyhow::anyhow!("{}: {why}", land.name))?;
        }
    }
    Ok(cases.into_iter().map(Case::cell).collect())
}

/// Ground whose coarser levels claim so many times their deviation.
fn claiming(land: &Land, tiles: &[(TileKey, Tile)], factor: f32) -> (Resident, Pyramid) {
    let mut index = StoreIndex::clone(land.store.index());
    let levels = index.layers.iter_mut().flat_map(|layer| &mut layer.levels);
    for entry in levels.flat_map(|level| &mut level.entries) {
        entry.deviation *= factor;
    }
    let mut resident = Resident::new(Arc::new(index));
    for (key, tile) in tiles {
        resident.insert(*key, tile.clone());
    }
    let pyramid = Pyramid::new(resident.index());
    (resident, pyramid)
}

/// A method with a tolerance.
struct Case {
    /// By camera, as what it saw last.
    views: Vec<View>,
    before: Vec<Option<Look>>,
    /// By how much each pixel of a plot that switched has moved, steps of 8-bit sRGB.
    moved: Vec<f64>,
}

/// Colours, and what the same levels are seen at ray by ray.
struct Look {
    pixels: Vec<u8>,
    seen: Vec<f32>,
}

impl Case {
    /// Looks again, and compares with what was seen before.
    fn look(&mut self, resident: &Resident, pyramid: &Pyramid) -> Result<(), Refusal> {
        for (view, before) in self.views.iter().zip(&mut self.before) {
            let frame = Region::whole(view.camera.width, view.camera.height);
            let rendered = render(resident, pyramid, view, frame)?;
            if !rendered.missing.is_empty() {
                return Err(Missing(rendered.missing).into());
            }
            let mut levels = view.clone();
            levels.quality.method = Method::Lod;
            if view.quality.method == Method::Column {
                levels.quality.tolerance_px *= COLUMN_LEVELS;
            }
            let seen = depths(resident, pyramid, &levels, frame)?.inverse_depth;
            let after = Look { pixels: rendered.pixels, seen };
            if let Some(before) = before {
                // Where rays have another answer, a plot has switched.
                let colors = before.pixels.chunks_exact(3).zip(after.pixels.chunks_exact(3));
                for (seen, (was, is)) in before.seen.iter().zip(&after.seen).zip(colors) {
                    if seen.0.to_bits() != seen.1.to_bits() {
                        let apart = was.iter().zip(is).map(|(was, is)| was.abs_diff(*is)).max();
                        self.moved.push(f64::from(apart.unwrap_or(0)));
                    }
                }
            }
            *before = Some(after);
        }
        Ok(())
    }

    fn cell(mut self) -> Cell {
        let Quality { method, tolerance_px, .. } = self.views[0].quality;
        let scene = format!("switch of levels, camera at rest, {tolerance_px} px");
        let note = format!(
            "max {:.0} of 255 in {} pixels of plots that switched",
            self.moved.iter().copied().fold(0.0, f64::max),
            self.moved.len()
        );
        let value = quantile(&mut self.moved, SHARE);
        Cell::claimed(&scene, method.name(), value, BOUND, "steps of 255, p99.9").with_note(note)
    }
}

/// Photo, sun and haze, as in an ordinary film.
fn view(
    land: &Land,
    (share, above_m, pitch_deg): (f64, f64, f64),
    size: (u32, u32),
    quality: Quality,
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
    Ok(View { camera, shading, quality })
}
