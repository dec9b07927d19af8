//! What a frame of a flight takes on one core, stage by stage: `frame STORE [RUNS [pieces]]`.
//!
//! ```sh
//! terrafarm terrain synth --size 2049 --spacing 15 --seed 3 --photo-scale 2 -o demo.terrain
//! cargo run --release -p terrafarm-raycast --example frame demo.terrain
//! ```
//!
//! The store is that of `terrafarm demo`, the views are three of its flight, 1920 x 1080, by
//! the method `auto`. A line a view, nanoseconds a pixel that one thread has on a core, the best
//! of RUNS (9) runs: finding depths alone, shading alone, the whole frame, and if asked for depths and
//! the whole in pieces of several sides. At the end a hash of the bytes.

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
use terrafarm_raycast::{Pyramid, View, depths, render, shade};
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::store::StoreReader;
use tests_support::keys;

const SIZE: (u32, u32) = (1920, 1080);
/// Easting, northing, height, heading, pitch and roll: metres and degrees.
const POSES: [[f64; 6]; 3] = [
    [22_300.0, 3600.0, 1853.0, 14.0, -8.0, 0.0],
    [23_000.0, 7200.0, 1815.0, 8.0, -7.0, -6.0],
    [24_000.0, 13_500.0, 2152.0, 22.0, -4.0, 0.0],
];
/// Sides of pieces, pixels.
const PIECES: [[usize; 2]; 7] =
    [[32, 32], [64, 64], [128, 128], [256, 256], [64, 32], [128, 32], [256, 32]];

fn main() {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().expect("the first argument is a store");
    let runs = arguments.next().map_or(9, |text| text.parse().expect("a number of runs"));
    let pieces = if arguments.next().is_some() { &PIECES[..] } else { &[] };
    let resident = loaded(Path::new(&path));
    let pyramid = Pyramid::new(resident.index());
    let frame = Region::whole(SIZE.0, SIZE.1);
    for pose in POSES {
        let view = view(pose);
        let (trace, found) =
            timed(runs, || depths(&resident, &pyramid, &view, frame).expect("the store fits"));
        let distances = distances(&view, &found.inverse_depth);
        let mut pixels = vec![0; distances.len() * 3];
        let (shading, _) =
            timed(runs, || shade(&resident, &pyramid, &view, frame, &distances, &mut pixels));
        let (whole, rendered) =
            timed(runs, || render(&resident, &pyramid, &view, frame).expect("the store fits"));
        assert!(rendered.missing.is_empty());
        let sky = distances.iter().filter(|s| s.is_infinite()).count();
        print!(
            "trace {trace:6.2}   shade {shading:6.2}   frame {whole:6.2}   beside the trace {:6.2}   \
             sky {:4.1} %",
            whole - trace,
            100.0 * sky as f64 / distances.len() as f64
        );
        for &[width, height] in pieces {
            let regions: Vec<Region> = (0..SIZE.1)
                .step_by(height)
                .flat_map(|y| (0..SIZE.0).step_by(width).map(move |x| (x, y)))
                .map(|(x, y)| Region {
                    x,
                    y,
                    width: (width as u32).min(SIZE.0 - x),
                    height: (height as u32).min(SIZE.1 - y),
                })
                .collect();
            let (trace, _) = timed(runs, || {
                for &region in &regions {
                    depths(&resident, &pyramid, &view, region).expect("the store fits");
                }
            });
            let (time, _) = timed(runs, || {
                for &region in &regions {
                    render(&resident, &pyramid, &view, region).expect("the store fits");
                }
            });
            print!("   {width}x{height} {trace:.2} {time:.2}");
        }
        println!("   {:016x}", digest(&rendered.pixels));
    }
}

/// FNV-1a of bytes.
fn digest(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xCBF2_9CE4_8422_2325, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3)
    })
}

/// As [`best`], in nanoseconds a pixel of the frame.
fn timed<T>(runs: usize, call: impl FnMut() -> T) -> (f64, T) {
    let (time_s, result) = best(runs, call);
    (time_s * 1e9 / (f64::from(SIZE.0) * f64::from(SIZE.1)), result)
}

fn loaded(path: &Path) -> Resident {
    let store = StoreReader::open(path).expect("the first argument is a store");
    let mut resident = Resident::new(store.index().clone());
    for key in keys(store.index()) {
        let tile = store.read_tile(key).expect("the tile can be read");
        assert!(resident.insert(key, tile.expect("the tile is not empty")));
    }
    resident
}

/// Distances along the map of what the pixels show.
fn distances(view: &View, inverse_depth: &[f32]) -> Vec<f32> {
    let at = |n: usize| (n as u32 % SIZE.0, n as u32 / SIZE.0);
    let distance = |(n, &inverse): (usize, &f32)| {
        let (x, y) = at(n);
        let ray = view.camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
        ray.truncate().length() as f32 / inverse
    };
    inverse_depth.iter().enumerate().map(distance).collect()
}

fn view([x, y, z, heading, pitch, roll]: [f64; 6]) -> View {
    let sky = Sky::default();
    let haze = Haze { visibility_m: 160_000.0, scale_height_m: 3000.0, color: sky.horizon };
    View {
        camera: Camera::from_angles(DVec3::new(x, y, z), heading, pitch, roll, 60.0, SIZE),
        shading: Shading {
            sun: Some(Sun::at(255.0, 34.0, 0.2, 1.0)),
            haze: Some(haze),
            sky,
            earth: Some(Earth { radius_m: 6_371_000.0, refraction: 0.13 }),
            below_ground: [0.05, 0.03, 0.02],
            bare_ground: None,
        },
        quality: Quality { method: Method::Auto, ..Quality::default() },
    }
}
