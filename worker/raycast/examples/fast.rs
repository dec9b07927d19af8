//! Development bench.
use glam::DVec3;
use std::path::Path;
use std::time::Instant;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Shading, Sky};
use terrafarm_raycast::{Pyramid, View, depths};
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::store::StoreReader;

#[allow(dead_code)]
#[path = "../src/tests_support.rs"]
mod tests_support;

fn cpu_s() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").expect("linux");
    text.split(' ').next().expect("a").parse::<f64>().expect("b") * 1e-9
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let store = StoreReader::open(Path::new(&arguments[1])).expect("store");
    let mut resident = Resident::new(store.index().clone());
    for key in tests_support::keys(store.index()) {
        resident.insert(key, store.read_tile(key).expect("tile").expect("not empty"));
    }
    let pyramid = Pyramid::new(resident.index());
    let tolerance: f64 = arguments.get(2).map_or(0.5, |t| t.parse().expect("tolerance"));
    let runs: usize = arguments.get(3).map_or(5, |t| t.parse().expect("runs"));
    let methods: Vec<Method> = arguments
        .get(4)
        .map_or("exact,column", |t| t)
        .split(',')
        .map(|m| m.parse().expect("method"))
        .collect();
    let cameras = [
        ("low", DVec3::new(504096.0, 5004096.0, 2854.300049), 50.0, -5.0, 0.0),
        ("mid", DVec3::new(510240.0, 5010240.0, 3552.300049), 50.0, -30.0, 0.0),
        ("steep", DVec3::new(520480.0, 5020480.0, 4926.299805), 50.0, -80.0, 0.0),
        ("rolled", DVec3::new(510240.0, 5010240.0, 3552.300049), 50.0, -30.0, 45.0),
    ];
    for (name, eye, heading, pitch, roll) in cameras {
        if std::env::var("CAM").is_ok_and(|cam| cam != name) {
            continue;
        }
        let view = |method| View {
            camera: Camera::from_angles(eye, heading, pitch, roll, 60.0, (1920, 1080)),
            shading: Shading {
                sun: None,
                haze: None,
                sky: Sky::default(),
                earth: None,
                below_ground: [0.0; 3],
                bare_ground: None,
            },
            quality: Quality { method, tolerance_px: tolerance, samples_per_side: 1 },
        };
        let frame = Region::whole(1920, 1080);
        let truth = depths(&resident, &pyramid, &view(Method::Exact), frame).expect("loaded");
        for &method in &methods {
            let view = view(method);
            let mut times = Vec::new();
            let mut answer = None;
            for _ in 0..runs {
                let (start, wall) = (cpu_s(), Instant::now());
                answer = Some(depths(&resident, &pyramid, &view, frame).expect("loaded"));
                let _ = start;
                times.push(wall.elapsed().as_secs_f64());
            }
            let time = times.iter().copied().fold(f64::INFINITY, f64::min);
            let answer = answer.expect("ran");
            let mut errors: Vec<f64> = Vec::new();
            let (mut sky, mut nan) = (0, 0);
            for y in (3..1080u32).step_by(7) {
                for x in (2..1920u32).step_by(5) {
                    let (a, t) = (
                        answer.distance_m(&view, x, y) as f32,
                        truth.distance_m(&view, x, y) as f32,
                    );
                    if a.is_nan() {
                        nan += 1;
                    } else if a.is_finite() != t.is_finite() {
                        sky += 1;
                        errors.push(99.0);
                    } else if a.is_finite() {
                        let ray =
                            view.camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5).normalize();
                        let p = eye + ray * f64::from(a);
                        let ground = height(&resident, p.x, p.y);
                        errors.push(((p.z - ground).abs() * view.camera.focal_px()) / f64::from(a));
                    }
                }
            }
            errors.sort_by(f64::total_cmp);
            let at = |share: f64| errors[((errors.len() - 1) as f64 * share) as usize];
            println!(
                "{name:6} {:9} {:7.2} Mpix/s {:6.2} ns/px {:5.2} steps {:5.2} rays {:5.3} fallen error p50 {:.4} p99 {:.4} max {:.2}  sky {sky} nan {nan}",
                method.name(),
                1920.0 * 1080.0 / time / 1e6,
                time * 1e9 / (1920.0 * 1080.0),
                answer.stats.steps as f64 / (1920.0 * 1080.0),
                answer.stats.rays as f64 / (1920.0 * 1080.0),
                answer.stats.fallbacks as f64 / (1920.0 * 1080.0),
                at(0.5),
                at(0.99),
                at(1.0),
            );
        }
    }
}

fn height(resident: &Resident, x: f64, y: f64) -> f64 {
    use terrafarm_terrain::layout::TileKey;
    use terrafarm_terrain::resident::Lookup;
    let layer = &resident.index().layers[0];
    let px = ((x - layer.origin[0]) / layer.spacing[0]).clamp(0.0, layer.posts[0] as f64 - 1.001);
    let py = ((y - layer.origin[1]) / layer.spacing[1]).clamp(0.0, layer.posts[1] as f64 - 1.001);
    let (i, j) = (px as u32, py as u32);
    let key = TileKey { layer: 0, level: 0, tx: i / 256, ty: j / 256 };
    let Lookup::Found(tile) = resident.height(key) else { return f64::NAN };
    let c = tile.corners(i as usize % 256, j as usize % 256).map(f64::from);
    let (u, v) = (px - f64::from(i), py - f64::from(j));
    (c[0] * (1.0 - u) + c[1] * u) * (1.0 - v) + (c[2] * (1.0 - u) + c[3] * u) * v
}
