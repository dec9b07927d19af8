//! Speed of shading alone on one core: `shading [RUNS]`.
//!
//! Run it with `cargo run --release -p terrafarm-raycast --example shading`.
//!
//! The land, the photo and the cameras are those of `bench`, over a round Earth. What the
//! rays meet is found first, untimed. A line a camera: nanoseconds a pixel, sRGB bytes
//! included, of the whole picture, and of it without photo, sun or haze; the best of RUNS
//! (9) runs of one thread, by the time that it had on a core where the system tells.

#[allow(dead_code)]
#[path = "../src/tests_support.rs"]
mod tests_support;

use glam::DVec3;
use std::time::Instant;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Earth, Haze, Shading, Sky, Sun};
use terrafarm_raycast::{Pyramid, View, shade, trace};
use terrafarm_terrain::resident::Resident;
use tests_support::{Plan, mountains, noise, resident};

const POSTS: u64 = 4097;
const SPACING_M: f64 = 10.0;
const SIZE: (u32, u32) = (1920, 1080);
/// Name, share of the side of the land at which the camera stands, its height, and pitch.
const CAMERAS: [(&str, f64, f64, f64); 3] =
    [("low", 0.10, 2800.0, -5.0), ("mid", 0.25, 3900.0, -30.0), ("steep", 0.5, 5200.0, -80.0)];

fn main() {
    let runs = std::env::args().nth(1).map_or(9, |text| text.parse().expect("a number of runs"));
    let with_photo = land(true);
    let without = land(false);
    for camera in CAMERAS {
        let whole = view(camera);
        let dark = View { shading: Shading { sun: None, ..whole.shading.clone() }, ..whole.clone() };
        let clear =
            View { shading: Shading { haze: None, ..whole.shading.clone() }, ..whole.clone() };
        let distances = distances(&with_photo, &whole);
        let sky = distances.iter().filter(|distance| distance.is_infinite()).count();
        let no_ground = vec![f32::INFINITY; distances.len()];
        let times = [
            time(runs, &with_photo, &whole, &distances),
            time(runs, &without, &whole, &distances),
            time(runs, &with_photo, &dark, &distances),
            time(runs, &with_photo, &clear, &distances),
            time(runs, &with_photo, &whole, &no_ground),
        ];
        println!(
            "{:6} {:6.2} ns/pixel   no photo {:6.2}   no sun {:6.2}   no haze {:6.2}   \
             sky alone {:6.2}   sky {:4.1} %",
            camera.0,
            times[0],
            times[1],
            times[2],
            times[3],
            times[4],
            100.0 * sky as f64 / distances.len() as f64,
        );
    }
}

/// A store and its pyramid.
struct Land {
    resident: Resident,
    pyramid: Pyramid,
}

fn land(photo: bool) -> Land {
    let height = |i, j| (1800.0 + mountains(i, j, 1024, 1000.0, 12)).clamp(0.0, 6500.0).round();
    let color = |i: u64, j: u64| {
        let fleck = 1.0 + 0.1 * noise(i, j, 77) + 0.1 * noise(i / 4, j / 4, 78);
        let meadow = noise(i / 24, j / 24, 81) > 0.0;
        let color = if meadow { [0.03, 0.08, 0.015] } else { [0.17, 0.18, 0.04] };
        let [r, g, b] = color.map(|c: f32| (c * fleck).clamp(0.0, 1.0));
        [r, g, b, 1.0]
    };
    let mut plans = vec![Plan::heights([0.0; 2], [SPACING_M; 2], [POSTS; 2], height)];
    if photo {
        plans.push(Plan::photo([0.0; 2], [SPACING_M; 2], [POSTS; 2], color));
    }
    let resident = resident(plans);
    let pyramid = Pyramid::new(resident.index());
    Land { resident, pyramid }
}

fn view((_, share, height, pitch): (&str, f64, f64, f64)) -> View {
    let side = (POSTS - 1) as f64 * SPACING_M;
    let eye = DVec3::new(share * side, share * side, height);
    let haze = Haze { visibility_m: 50_000.0, scale_height_m: 2000.0, color: [0.6, 0.7, 0.82] };
    View {
        camera: Camera::from_angles(eye, 50.0, pitch, 0.0, 60.0, SIZE),
        shading: Shading {
            sun: Some(Sun::at(320.0, 30.0, 0.25, 0.9)),
            haze: Some(haze),
            sky: Sky::default(),
            earth: Some(Earth { radius_m: 6_371_000.0, refraction: 0.13 }),
            below_ground: [0.05, 0.03, 0.02],
            bare_ground: None,
        },
        quality: Quality::default(),
    }
}

/// Distances along the map to what the pixels show.
fn distances(land: &Land, view: &View) -> Vec<f32> {
    let mut distances = vec![f32::INFINITY; SIZE.0 as usize * SIZE.1 as usize];
    let frame = Region::whole(SIZE.0, SIZE.1);
    let traced = trace(&land.resident, &land.pyramid, view, frame, |x, y, hit| {
        if let Some(hit) = hit {
            let away = hit.position - view.camera.position;
            distances[(y * SIZE.0 + x) as usize] = away.truncate().length() as f32;
        }
    });
    traced.expect("all tiles are loaded");
    distances
}

/// The shortest time of shading a frame, nanoseconds a pixel.
fn time(runs: usize, land: &Land, view: &View, distances: &[f32]) -> f64 {
    let frame = Region::whole(SIZE.0, SIZE.1);
    let mut pixels = vec![0; 3 * distances.len()];
    let mut best = f64::INFINITY;
    for _ in 0..runs.max(1) {
        let (start, start_cpu) = (Instant::now(), cpu_s());
        let missing = shade(&land.resident, &land.pyramid, view, frame, distances, &mut pixels);
        let taken = cpu_s().zip(start_cpu).map(|(end, start)| end - start);
        best = best.min(taken.unwrap_or(start.elapsed().as_secs_f64()));
        assert!(missing.is_empty());
    }
    best * 1e9 / distances.len() as f64
}

/// Time that this thread has had on a core, seconds, where the system tells (Linux).
fn cpu_s() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split(' ').next()?.parse::<f64>().ok()? * 1e-9)
}
