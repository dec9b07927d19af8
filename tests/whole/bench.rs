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

#[test]
fn the_flight_bench_finishes_the_frames_of_the_demo_and_checks_them() {
    let dir = Dir::new();
    let report = dir.path("flight.json");
    let mut command = terrafarm();
    command.args(["bench", "flight", "--short", "--threads", "3", "--json"]).arg(&report);
    let text = succeed(&mut command);
    assert!(text.contains("6 frames of 320 x 180") && text.contains("3 threads"), "{text}");
    let report = json(&report);
    assert_eq!((&report["frames"], &report["kept"]), (&6.into(), &true.into()), "{report}");
    assert_eq!(report["checked"], serde_json::json!([0, 2, 5]));
    for key in ["frames_per_s", "ns_per_pixel", "error_px_p99"] {
        assert!(report[key].as_f64().unwrap() > 0.0, "{key} in {report}");
    }
}

#[test]
fn the_flight_bench_flies_over_any_scene() {
    let world = World::new(100);
    let [scene, flight] = [&world.scene, &world.flight];
    let mut command = terrafarm();
    command.args(["bench", "flight", "--size", "64x36", "--frames", "4", "--repeats", "2"]);
    let text = succeed(command.args(["--method", "exact"]).arg(scene).arg("--flight").arg(flight));
    assert!(text.contains("4 frames of 64 x 36, finished, by exact"), "{text}");
    run(terrafarm().args(["bench", "flight"]).arg(scene), 2);
    run(terrafarm().args(["bench", "flight", "--tolerance", "0"]), 2);
}

#[test]
fn the_chart_of_speed_and_accuracy_has_every_method_and_both_forms() {
    let dir = Dir::new();
    let [report, svg, png] = ["sa.json", "sa.svg", "sa.png"].map(|name| dir.path(name));
    let mut command = terrafarm();
    command.args(["bench", "speed-accuracy", "--short", "--json"]).arg(&report);
    let ended = command.arg("--svg").arg(&svg).arg("--png").arg(&png).output().unwrap();
    let text = String::from_utf8(ended.stdout).unwrap();
    assert!(text.contains("on the Pareto front"), "{text}");
    let report = json(&report);
    let points = report["points"].as_array().unwrap();
    let refused = report["refused"].as_array().unwrap();
    assert_eq!(points.len() + refused.len(), 4 * (4 * 7 + 2 + 3));
    let broken = points.iter().filter(|point| point["kept"] == false).count();
    assert_eq!(ended.status.code(), Some(i32::from(broken > 0)), "{text}");
    for point in points.iter().filter(|point| point["method"] == "exact") {
        assert!(point["error_px_max"].as_f64().unwrap() <= 0.01, "{point}");
    }
    let truth: Vec<_> = points.iter().filter(|point| point["setting"] == "64 samples").collect();
    assert_eq!(truth.len(), 4);
    assert!(truth.iter().all(|point| point["image_error"] == 0.0), "{truth:?}");
    assert!(std::fs::read_to_string(&svg).unwrap().contains("reference"));
    let picture = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(&png).unwrap()));
    assert!(picture.read_info().unwrap().info().width > 1000);
}

#[test]
fn larger_terrain_is_flown_through_a_cache_of_a_few_tiles_and_its_stores_are_kept() {
    let dir = Dir::new();
    let (report, stores) = (dir.path("size.json"), dir.path("stores"));
    let fly = |cache: &str| {
        let mut command = terrafarm();
        command.args(["bench", "terrain-size", "--short", "--repeats", "1", "--cache", cache]);
        command.arg("--stores").arg(&stores).arg("--json").arg(&report);
        command
    };
    let text = succeed(&mut fly("64"));
    assert!(text.contains("largest ratio"), "{text}");
    let first = json(&report);
    let cases = first["cases"].as_array().unwrap();
    assert_eq!(cases.len(), 3 * 2 * 2);
    for case in cases {
        assert_eq!(case["right"], true, "{case}");
        assert!(case["peak_cache_bytes"].as_u64().unwrap() <= 64 << 20, "{case}");
        for key in ["rays_ms", "picture_ms", "ratio_rays", "load_s", "tiles", "ground"] {
            assert!(case[key].as_f64().unwrap() > 0.0, "{key} in {case}");
        }
    }
    let built = |report: &Value| {
        report["stores"].as_array().unwrap().iter().filter(|s| s["built_s"].is_f64()).count()
    };
    assert_eq!(built(&first), 3);
    succeed(&mut fly("64"));
    assert_eq!(built(&json(&report)), 0);
    let (_, refused) = run(&mut fly("1"), 2);
    assert!(refused.contains("limit is 1 MB"), "{refused}");
}

#[test]
fn no_method_is_silently_wrong_in_any_scene_of_the_stability_suite() {
    let dir = Dir::new();
    let report = dir.path("stability.json");
    let mut command = terrafarm();
    let ended = command.args(["bench", "stability", "--short", "--json"]).arg(&report);
    let ended = ended.output().unwrap();
    let report = json(&report);
    let cells = report["cells"].as_array().unwrap();
    let scenes: std::collections::BTreeSet<_> =
        cells.iter().map(|cell| cell["scene"].as_str().unwrap()).collect();
    assert!(scenes.len() >= 45, "{scenes:?}");
    for cell in cells {
        assert_ne!(cell["outcome"], "silent", "{cell}");
        let share = cell["fallback_share"].as_f64().unwrap_or(0.0);
        assert_eq!(cell["outcome"] == "fallback", share > 0.0, "{cell}");
    }
    // Between lines `column` chooses anew which ground is in front; rays of their own do not.
    let pops = |cell: &&Value| {
        cell["scene"].as_str().unwrap().starts_with("switch of levels") && cell["method"] == "lod"
    };
    let switches: Vec<_> = cells.iter().filter(pops).collect();
    assert_eq!(switches.len(), 2);
    assert!(switches.iter().all(|cell| cell["outcome"] == "in-bound"), "{switches:?}");
    assert!(cells.iter().any(|cell| cell["outcome"] == "fallback"));
    assert_eq!(ended.status.code(), Some(0));
}

#[test]
fn more_workers_give_the_same_bytes_and_an_account_of_all_their_time() {
    let dir = Dir::new();
    let [report, svg] = ["scale.json", "scale.svg"].map(|name| dir.path(name));
    let mut command = terrafarm();
    command.args(["bench", "scale-out", "--short", "--json"]).arg(&report);
    let text = succeed(command.arg("--svg").arg(&svg));
    assert!(text.contains("the same bytes from all"), "{text}");
    let report = json(&report);
    assert_eq!(report["sha256"].as_str().unwrap().len(), 64);
    let runs = report["runs"].as_array().unwrap();
    let crews: Vec<_> =
        runs.iter().map(|run| (run["workers"].as_u64(), run["threads"].as_u64())).collect();
    assert_eq!(crews, [(1, 1), (2, 1), (1, 2)].map(|(w, t)| (Some(w), Some(t))));
    for run in runs {
        let account = run["account"].as_object().unwrap();
        let total: f64 = account.values().map(|part| part.as_f64().unwrap()).sum();
        assert!((total - 1.0).abs() < 1e-6, "{run}");
        for part in ["render", "terrain", "unpack"] {
            assert!(account[part].as_f64().unwrap() > 0.0, "{part} in {run}");
        }
        // What is not named is little: clocks of worker and coordinator agree.
        assert!(account["other"].as_f64().unwrap().abs() < 0.25, "{run}");
    }
    assert!(std::fs::read_to_string(&svg).unwrap().contains("render"));
}

#[test]
fn sleeping_workers_answer_every_job_and_say_how_long_they_waited() {
    let dir = Dir::new();
    let report = dir.path("fake.json");
    let mut command = terrafarm();
    command.args(["bench", "scale-out", "--fake", "--short", "--job-ms", "1"]);
    succeed(command.args(["--workers", "3,40", "--json"]).arg(&report));
    let report = json(&report);
    let runs = report["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 2);
    for run in runs {
        assert!(run["jobs"].as_u64().unwrap() >= 2000, "{run}");
        assert!(run["jobs_per_s"].as_f64().unwrap() > 0.0, "{run}");
        let busy = run["busy"].as_f64().unwrap();
        assert!(0.0 < busy && busy <= 1.0, "{run}");
        assert!(!cfg!(target_os = "linux") || run["coordinator_cores"].is_f64(), "{run}");
    }
    run(terrafarm().args(["bench", "scale-out", "--workers", "65"]), 2);
    run(terrafarm().args(["bench", "scale-out", "--job-ms", "5"]), 2);
}
