//! Scenes that are not about a method: flights, hillshades, tiles that are not there.

use super::Cell;
use super::scenes::{look, view};
use crate::commands::bench::land::{Land, Rule, height_layer};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::flight::{Flight, Keyframe};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::Shading;
use terrafarm_raycast::{Progress, Unfit, Unseen, View, depths, render};
use terrafarm_terrain::hillshade::hillshade;
use terrafarm_terrain::layout::PostWindow;
use terrafarm_terrain::resident::Resident;

/// Poses looked at along a flight.
const POSES: u32 = 2000;

/// Their cells.
pub fn cells() -> anyhow::Result<Vec<Cell>> {
    let mut cells = vec![odd_times()?, through_the_zenith()?];
    cells.extend(odd_light()?);
    cells.extend(missing_tiles()?);
    Ok(cells)
}

fn keyframe(t_s: f64, x: f64, pitch_deg: f64, heading_deg: f64) -> Keyframe {
    Keyframe::from_angles(t_s, DVec3::new(x, 0.0, 100.0), heading_deg, pitch_deg, 0.0, 60.0)
}

/// Duplicate keyframes, cuts and hovers: no pose may be NaN.
fn odd_times() -> anyhow::Result<Cell> {
    let times =
        [(0.0, 0.0), (1.0, 5.0), (1.0, 5.0), (1.0, 9.0), (2.0, 9.0), (3.0, 9.0), (4.0, 1.0)];
    let flight = Flight::new(times.map(|(t, x)| keyframe(t, x, -10.0, 30.0)).to_vec())?;
    let odd = (0..=POSES).filter(|step| {
        let pose = flight.pose_at(4.0 * f64::from(*step) / f64::from(POSES));
        !(pose.position.is_finite() && pose.attitude.is_finite() && pose.hfov_deg.is_finite())
    });
    let odd = odd.count() as f64;
    Ok(Cell::measured("duplicate keyframes and hovers", "flight", odd, 0.0, "poses that are NaN"))
}

/// From one horizon to the other by way of straight down: 180 degrees in 2 seconds, turned
/// evenly. An interpolation of angles would spin at the nadir.
fn through_the_zenith() -> anyhow::Result<Cell> {
    let keyframes = vec![
        keyframe(0.0, 0.0, 0.0, 0.0),
        keyframe(1.0, 0.0, -90.0, 0.0),
        keyframe(2.0, 0.0, 0.0, 180.0),
    ];
    let roll = keyframes[2].attitude;
    let flight = Flight::new(keyframes)?;
    let pose = |step: u32| flight.pose_at(2.0 * f64::from(step) / f64::from(POSES)).attitude;
    let steps = (0..POSES).map(|step| pose(step).angle_between(pose(step + 1)).to_degrees());
    let largest = steps.fold(0.0, f64::max);
    // The whole turn, shortest way, spread evenly; easing may double it.
    let turn = pose(0).angle_between(pose(POSES / 2)) + pose(POSES / 2).angle_between(roll);
    let bound = 2.0 * turn.to_degrees() / f64::from(POSES) * 2.0;
    Ok(Cell::measured("flight through straight down", "flight", largest, bound, "degrees a step"))
}

/// A sun below the horizon, on it and in the zenith: a hillshade has a grey for every post.
fn odd_light() -> anyhow::Result<Vec<Cell>> {
    let spec = height_layer([10.0; 2], [100; 2], Some(1.0));
    let land = Land::made("light", None, spec, &Rule(|i, j| ((i * 37 + j * 91) % 40) as f32))?;
    let window = PostWindow { i0: 1, j0: 1, width: 98, height: 98 };
    let mut cells = Vec::new();
    for (name, altitude) in [
        ("light on the horizon", 0.0),
        ("light in the zenith", 90.0),
        ("light below the horizon", -20.0),
    ] {
        let cell = match hillshade(&land.store, 0, window, 315.0, altitude) {
            // 0 means no data; GDAL's formula leaves 1 to 255 for ground.
            Ok(grey) => {
                let none = grey.iter().filter(|&&grey| grey == 0).count() as f64;
                Cell::measured(name, "hillshade", none, 0.0, "posts without a grey")
            }
            Err(why) => Cell::refused(name, "hillshade", why.to_string()),
        };
        cells.push(cell);
    }
    Ok(cells)
}

/// Tiles that have not come: every method must name what it misses, and what it shows
/// without must be what it shows with them.
fn missing_tiles() -> anyhow::Result<Vec<Cell>> {
    let mut cells = no_tile()?;
    cells.extend(late_tiles()?);
    Ok(cells)
}

/// A region waits for its tiles, however late: in parts of it that can be done before there
/// is nothing made up, no coarser tile, no hole.
fn late_tiles() -> anyhow::Result<Vec<Cell>> {
    let land = Land::noise(1025)?;
    let name = "tiles that are late";
    let frame = Region::whole(97, 55);
    let middle = land.at(0.5);
    let high = land.highest_around(middle, 100.0)? + 300.0;
    let cell = |method: Method| {
        let mut view = view(look([middle[0], middle[1], high], 45.0, -20.0), (97, 55), None);
        view.quality = Quality { method, samples_per_side: 1, ..Quality::default() };
        let refused = |why: Unfit| Cell::refused(name, method.name(), why.to_string());
        let whole = match render(&land.resident, &land.pyramid, &view, frame) {
            Ok(whole) => whole.pixels,
            Err(why) => return refused(why),
        };
        let mut late = land.resident.clone();
        for key in land.resident.loaded() {
            // Nor any coarser one that might stand in for them.
            if key.level > 0 || (key.tx + key.ty) % 2 == 1 {
                late.remove(key);
            }
        }
        let mut progress = Progress::new(frame);
        let missing = match progress.advance(&late, &land.pyramid, &view) {
            Ok(missing) => missing,
            Err(why) => return refused(why),
        };
        let early = progress.clone().into_rendered(missing.clone());
        let pairs = |pixels: &[u8]| {
            let other = |(was, is): &(&[u8], &[u8])| *was != [0; 3] && was != is;
            pixels.chunks_exact(3).zip(whole.chunks_exact(3)).filter(other).count()
        };
        let made_up = pairs(&early.pixels);
        // The tiles come, all at once: the region ends as if it had never waited.
        let left = progress.advance(&land.resident, &land.pyramid, &view).map(|left| left.len());
        let end = progress.into_rendered(Vec::new());
        let differs = end.pixels != whole || left != Ok(0) || missing.is_empty();
        let wrong = made_up + if differs { whole.len() / 3 } else { 0 };
        Cell::measured(name, method.name(), wrong as f64, 0.0, "pixels made up")
            .with_note(format!("{} tiles named", missing.len()))
    };
    Ok(Method::ALL.into_iter().map(cell).collect())
}

/// No tile loaded.
fn no_tile() -> anyhow::Result<Vec<Cell>> {
    let land = Land::noise(257)?;
    let empty = Resident::new(land.resident.index().clone());
    let size = (33, 19);
    let shading = Shading::default();
    let camera =
        Camera::from_angles(DVec3::new(1280.0, 300.0, 4000.0), 0.0, -60.0, 0.0, 60.0, size);
    let cells = Method::ALL.map(|method| {
        let quality = Quality { method, ..Quality::default() };
        let view = View { camera, shading: shading.clone(), quality };
        match depths(&empty, &land.pyramid, &view, Region::whole(size.0, size.1)) {
            Err(Unseen::Missing(tiles)) => {
                let why = format!("it names {} tiles that it misses", tiles.len());
                Cell::refused("no tile in memory", method.name(), why)
            }
            Err(Unseen::Unfit(unfit)) => {
                Cell::refused("no tile in memory", method.name(), unfit.to_string())
            }
            Ok(seen) => {
                let pixels = seen.inverse_depth.len() as f64;
                Cell::measured("no tile in memory", method.name(), pixels, 0.0, "pixels made up")
            }
        }
    });
    Ok(cells.to_vec())
}
