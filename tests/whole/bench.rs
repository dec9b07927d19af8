//! Short runs of every bench: what is reported, and that nothing is wrong.

use crate::support::{Dir, World, run, succeed, terrafarm};
use serde_json::Value;
use std::path::Path;

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

#[test]
fn the_core_bench_reports_every_method_and_camera_and_checks_them() {
    let dir = Dir::new();
    let report = dir.path("core.json");
    let text = succeed(
        terrafarm()
            .args(["bench", "core", "--posts", "129,257", "--size", "96x54", "--repeats", "1"])
            .args(["--methods", "exact,reference", "--json"])
            .arg(&report),
    );
    assert!(text.contains("rolled45"), "{text}");
    let report = json(&report);
    let cases = report["cases"].as_array().unwrap();
    assert_eq!(cases.len(), 2 * 4 * 2);
    for case in cases {
        assert_eq!(case["outcome"], "timed", "{case}");
        for key in ["mpix_per_cpu_s", "steps_per_pixel", "ns_per_pixel", "bytes_per_post"] {
            assert!(case[key].as_f64().unwrap() > 0.0, "{key} in {case}");
        }
        assert!(case["error_px_max"].as_f64().unwrap() <= 0.01, "{case}");
    }
}

#[test]
fn the_core_bench_takes_its_cameras_from_a_flight_and_its_terrain_from_a_store() {
    let world = World::new(100);
    let report = world.dir.path("core.json");
    succeed(
        terrafarm()
            .args(["bench", "core", "--size", "32x18", "--repeats", "2", "--methods", "exact"])
            .arg("--terrain")
            .arg(world.dir.path("land.terrain"))
            .arg("--flight")
            .arg(&world.flight)
            .arg("--json")
            .arg(&report),
    );
    let report = json(&report);
    let cameras: Vec<_> =
        report["cases"].as_array().unwrap().iter().map(|case| case["camera"].as_u64()).collect();
    assert_eq!(cameras, [Some(0), Some(1)]);
    assert_eq!(report["cases"][0]["posts"], 100);
    run(terrafarm().args(["bench", "core", "--tolerance", "0"]), 2);
}
