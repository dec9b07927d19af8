//! Speed of the ray caster on one core: `bench [RUNS] [STORE.terrain]`.
//!
//! Run it with `cargo run --release -p terrafarm-raycast --example bench`.
//!
//! Without a store it makes 4097 x 4097 posts of noise, 10 m apart, with 2 km of relief
//! and a photo as fine as that, and looks at it in 1920 x 1080 through the three cameras
//! that ray casters for terrain are compared with: `low` (300 m above the ground around,
//! 5 degrees down), `mid` (1500 m, 30 degrees) and `steep` (3000 m, 80 degrees), all with
//! a horizontal field of view of 60 degrees. With a store it looks at that one in
//! 1280 x 720, over a round Earth.
//!
//! A line a camera: tracing alone in millions of rays a second and in milliseconds a
//! frame, blocks and cells looked at per ray, then tracing with shading; the best of RUNS
//! (5) runs of one thread, by the time that it had on a core where the system tells. With a store, also in how many rounds a frame finds the tiles
//! that it needs when none is loaded.
//! A sample of the hits is compared with the `reference` method first: nothing wrong is
//! timed.

#[path = "time/best.rs"]
mod best;
#[allow(dead_code)]
#[path = "../src/tests_support.rs"]
mod tests_support;

use best::best;
use glam::DVec3;
use std::path::Path;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Earth, Haze, Shading, Sky, Sun};
use terrafarm_raycast::{Progress, Pyramid, View, cast, render, trace};
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::{Lookup, Resident};
use terrafarm_terrain::store::StoreReader;
use tests_support::{Plan, keys, mountains, noise, resident};

const POSTS: u64 = 4097;
const SPACING_M: f64 = 10.0;
/// Name, share of the side of the land at which the camera stands, height above the
/// highest ground around, and pitch.
const CAMERAS: [(&str, f64, f64, f64); 3] =
    [("low", 0.10, 300.0, -5.0), ("mid", 0.25, 1500.0, -30.0), ("steep", 0.5, 3000.0, -80.0)];
/// Every so many pixels along x and y one is compared with the reference.
const CHECKED_PX: u32 = 97;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let runs = arguments.get(1).map_or(5, |text| text.parse().expect("a number of runs"));
    let store = arguments
        .get(2)
        .map(|path| StoreReader::open(Path::new(path)).expect("the second argument is a store"));
    let (resident, size) = match &store {
        Some(store) => (loaded(store), (1280, 720)),
        None => (noise_land(), (1920, 1080)),
    };
    let pyramid = Pyramid::new(resident.index());
    println!("{} MB of tiles", resident.bytes() / 1_000_000);
    for (name, share, above, pitch) in CAMERAS {
        let view = view(&resident, store.is_some(), share, above, pitch, size);
        let wrong = check(&resident, &pyramid, &view);
        assert_eq!(wrong, 0, "{name}: hits differ from the reference");
        let frame = Region::whole(size.0, size.1);
        let (trace_s, stats) = best(runs, || {
            let mut sum = 0.0;
            let traced = trace(&resident, &pyramid, &view, frame, |_, _, hit| {
                sum += hit.map_or(0.0, |hit| hit.distance_m);
            });
            assert!(sum.is_finite());
            traced.expect("all tiles are loaded")
        });
        let (frame_s, rendered) =
            best(runs, || render(&resident, &pyramid, &view, frame).expect("exact fits"));
        assert!(rendered.missing.is_empty());
        let pixels = f64::from(size.0) * f64::from(size.1);
        println!(
            "{name:6} trace {:7.2} Mrays/s {:7.1} ms {:6.1} steps/ray   frame {:6.2} Mpixel/s \
             {:7.1} ms   sky {:4.1} %",
            stats.rays as f64 / trace_s / 1e6,
            trace_s * 1e3,
            stats.steps as f64 / stats.rays as f64,
            pixels / frame_s / 1e6,
            frame_s * 1e3,
            100.0 - 100.0 * stats.hits as f64 / stats.rays as f64,
        );
        if let Some(store) = &store {
            let (rounds, asked) = cold(store, &pyramid, &view, frame, &rendered.pixels);
            println!("{name:6} cold: {asked} tiles asked for in {rounds} rounds");
        }
    }
}

fn noise_land() -> Resident {
    let height = |i, j| (1800.0 + mountains(i, j, 1024, 1000.0, 12)).clamp(0.0, 6500.0);
    let photo = |i: u64, j: u64| {
        let fleck = 1.0 + 0.1 * noise(i, j, 77) + 0.1 * noise(i / 4, j / 4, 78);
        let meadow = noise(i / 24, j / 24, 81) > 0.0;
        let color = if meadow { [0.03, 0.08, 0.015] } else { [0.17, 0.18, 0.04] };
        let [r, g, b] = color.map(|c: f32| (c * fleck).clamp(0.0, 1.0));
        [r, g, b, 1.0]
    };
    let heights = Plan::heights([0.0; 2], [SPACING_M; 2], [POSTS; 2], height);
    let colors = Plan::photo([0.0; 2], [SPACING_M; 2], [POSTS; 2], photo);
    resident(vec![heights, colors])
}

fn loaded(store: &StoreReader) -> Resident {
    let mut resident = Resident::new(store.index().clone());
    for key in keys(store.index()) {
        let tile = store.read_tile(key).expect("the tile can be read");
        assert!(resident.insert(key, tile.expect("the tile is not empty")));
    }
    resident
}

fn view(
    resident: &Resident,
    round: bool,
    share: f64,
    above: f64,
    pitch: f64,
    size: (u32, u32),
) -> View {
    let layer = &resident.index().layers[0];
    let far = layer.far_corner();
    let at = [0, 1].map(|axis| layer.origin[axis] + share * (far[axis] - layer.origin[axis]));
    let around = (-30..=30).flat_map(|dj| (-30..=30).map(move |di| (di, dj)));
    let heights = around.filter_map(|(di, dj)| {
        let post = |axis: usize, d: i64| {
            let index = (share * (layer.posts[axis] - 1) as f64) as i64 + d;
            index.clamp(0, layer.posts[axis] as i64 - 2) as u32
        };
        let (i, j) = (post(0, di), post(1, dj));
        let key = TileKey { layer: 0, level: 0, tx: i / 256, ty: j / 256 };
        match resident.height(key) {
            Lookup::Found(tile) => Some(tile.post((i % 256) as isize, (j % 256) as isize)),
            _ => None,
        }
    });
    let ground = heights.filter(|height| !height.is_nan()).fold(0.0, f32::max);
    let eye = DVec3::new(at[0], at[1], f64::from(ground) + above);
    let haze = Haze { visibility_m: 50_000.0, scale_height_m: 0.0, color: [0.6, 0.7, 0.82] };
    View {
        camera: Camera::from_angles(eye, 50.0, pitch, 0.0, 60.0, size),
        shading: Shading {
            sun: Some(Sun::at(320.0, 30.0, 0.25, 0.9)),
            haze: Some(haze),
            sky: Sky::default(),
            earth: round.then_some(Earth { radius_m: 6_371_000.0, refraction: 0.13 }),
            below_ground: [0.05, 0.03, 0.02],
            bare_ground: None,
        },
        quality: Quality::default(),
    }
}

/// Number of pixels, out of a coarse net of them, in which the methods disagree.
fn check(resident: &Resident, pyramid: &Pyramid, view: &View) -> usize {
    let quality = Quality { method: Method::Reference, ..view.quality };
    let truth = View { quality, ..view.clone() };
    let mut wrong = 0;
    let frame = Region::whole(view.camera.width, view.camera.height);
    let traced = trace(resident, pyramid, view, frame, |x, y, hit| {
        if !(x + 31).is_multiple_of(CHECKED_PX) || !(y + 17).is_multiple_of(CHECKED_PX) {
            return;
        }
        let (x, y) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
        let expected = cast(resident, pyramid, &truth, x, y).expect("all tiles are loaded");
        let same = match (hit, expected) {
            (None, None) => true,
            (Some(a), Some(b)) => {
                (a.layer, a.i, a.j) == (b.layer, b.i, b.j)
                    && (a.distance_m - b.distance_m).abs() < 1e-5
            }
            _ => false,
        };
        wrong += usize::from(!same);
    });
    traced.expect("all tiles are loaded");
    wrong
}

/// Renders with no tile at first; rounds, and tiles asked for.
fn cold(
    store: &StoreReader,
    pyramid: &Pyramid,
    view: &View,
    frame: Region,
    expected: &[u8],
) -> (usize, usize) {
    let mut resident = Resident::new(store.index().clone());
    let mut progress = Progress::new(frame);
    let (mut rounds, mut asked) = (0, 0);
    loop {
        let missing = progress.advance(&resident, pyramid, view).expect("exact fits");
        if missing.is_empty() {
            break;
        }
        rounds += 1;
        asked += missing.len();
        for key in missing {
            let tile = store.read_tile(key).expect("the tile can be read");
            assert!(resident.insert(key, tile.expect("no empty tile is asked for")));
        }
    }
    assert!(progress.into_rendered(Vec::new()).pixels == expected, "a cold frame differs");
    (rounds, asked)
}
