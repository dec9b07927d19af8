//! Positions against PROJ, through `gdaltransform` where it is installed.

#![allow(clippy::unwrap_used, missing_docs)]

use std::io::Write;
use std::process::{Command, Stdio};

use terrafarm_geo::Crs;

/// EPSG code, the area in which to compare (west, south, east, north, degrees), and the
/// tolerance in metres: a millimetre where no datum shift is needed, else what is lost
/// without datum grids.
const AREAS: [(u16, [f64; 4], f64); 28] = [
    (32612, [-114.0, 0.0, -108.0, 84.0], 1e-3),
    (32733, [10.0, -79.0, 20.0, 0.0], 1e-3),
    (32601, [178.0, -10.0, 182.0, 10.0], 1e-3),
    (26912, [-114.0, 30.0, -108.0, 50.0], 1e-3),
    (25832, [4.0, 40.0, 14.0, 70.0], 1e-3),
    (3857, [-179.0, -84.0, 179.0, 84.0], 1e-3),
    (3395, [-179.0, -84.0, 179.0, 84.0], 1e-3),
    (2154, [-5.0, 41.0, 9.0, 51.0], 1e-3),
    (27700, [-6.0, 50.0, 1.5, 58.0], 8.0),
    (3035, [-10.0, 35.0, 40.0, 70.0], 1e-3),
    (3413, [-179.0, 61.0, 179.0, 89.99], 1e-3),
    (3031, [-179.0, -89.99, 179.0, -61.0], 1e-3),
    (5041, [-179.0, 80.0, 179.0, 90.0], 1e-3),
    (5042, [-179.0, -90.0, 179.0, -80.0], 1e-3),
    (26710, [-123.0, 35.0, -120.0, 48.0], 25.0),
    (26715, [-96.0, 30.0, -90.0, 48.0], 25.0),
    (2056, [6.0, 45.9, 10.4, 47.7], 2.0),
    (21781, [6.0, 45.9, 10.4, 47.7], 2.0),
    (31370, [2.6, 49.6, 6.3, 51.4], 1.0),
    (31467, [7.6, 47.4, 10.4, 54.0], 5.0),
    (5514, [12.2, 48.6, 18.0, 51.0], 20.0),
    (28992, [3.5, 50.8, 7.1, 53.4], 2.0),
    (5070, [-120.0, 25.0, -70.0, 48.0], 1e-3),
    (3338, [-165.0, 55.0, -135.0, 70.0], 1e-3),
    (2193, [167.0, -46.0, 178.0, -35.0], 1e-3),
    (28355, [144.0, -43.0, 150.0, -10.0], 1e-3),
    (3978, [-130.0, 45.0, -60.0, 75.0], 1e-3),
    (2180, [14.2, 49.0, 24.1, 54.8], 1e-3),
];
const STEPS: usize = 6;

#[test]
fn positions_agree_with_proj() {
    if Command::new("gdaltransform").arg("--version").output().is_err() {
        println!("skipped: gdaltransform is not installed");
        return;
    }
    let mut failures = Vec::new();
    for (code, [west, south, east, north], tolerance_m) in AREAS {
        let crs = Crs::parse(&format!("EPSG:{code}")).unwrap();
        let step = |low: f64, high: f64, n: usize| low + (high - low) * n as f64 / STEPS as f64;
        let places: Vec<[f64; 2]> = (0..=STEPS)
            .flat_map(|i| (0..=STEPS).map(move |j| (i, j)))
            .map(|(i, j)| [step(west, east, i), step(south, north, j)])
            .collect();
        let expected = gdaltransform(code, &places);
        let mut worst: f64 = 0.0;
        for (place, expected) in places.iter().zip(&expected) {
            let found = crs.from_lonlat(*place).unwrap();
            let off = (found[0] - expected[0]).hypot(found[1] - expected[1]);
            worst = worst.max(off * crs.unit_m().unwrap());
        }
        println!("EPSG:{code}: at most {worst:.6} m from PROJ");
        if worst > tolerance_m {
            failures.push(format!("EPSG:{code}: {worst} m"));
        }
    }
    assert!(failures.is_empty(), "{failures:?}");
}

fn gdaltransform(code: u16, places: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let target = format!("EPSG:{code}");
    let mut child = Command::new("gdaltransform")
        .args(["-s_srs", "EPSG:4326", "-t_srs", &target, "-output_xy"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let lines: String = places.iter().map(|p| format!("{:?} {:?}\n", p[0], p[1])).collect();
    child.stdin.take().unwrap().write_all(lines.as_bytes()).unwrap();
    let output = String::from_utf8(child.wait_with_output().unwrap().stdout).unwrap();
    let points: Vec<[f64; 2]> = output
        .lines()
        .map(|line| {
            let mut numbers = line.split_whitespace().map(|word| word.parse().unwrap());
            [numbers.next().unwrap(), numbers.next().unwrap()]
        })
        .collect();
    assert_eq!(points.len(), places.len());
    points
}
