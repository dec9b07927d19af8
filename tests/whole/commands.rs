//! Commands that write files: what they leave, and what it says.

use crate::support::{Dir, World, run, shared_data, succeed, terrafarm};
use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

/// Whether a program we compare with is here. Where the tests must not skip
/// (`TERRAFARM_REQUIRE_ORACLES`), its absence is a failure.
fn oracle(program: &str) -> bool {
    let here = Command::new(program)
        .arg("--version")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok();
    if !here {
        assert!(
            std::env::var_os("TERRAFARM_REQUIRE_ORACLES").is_none(),
            "{program} is not on PATH"
        );
        println!("skipped: {program} is not on PATH");
    }
    here
}

#[test]
fn a_png_sequence_is_numbered_and_has_a_manifest() {
    let world = World::new(60);
    let output = world.dir.path("pictures");
    succeed(
        world
            .render()
            .args(["--size", "64x36", "--frames", "0..3", "--workers", "1", "-o"])
            .arg(&output),
    );
    let mut names: Vec<_> = fs::read_dir(&output)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(names, ["frame_00000.png", "frame_00001.png", "frame_00002.png", "manifest.json"]);
    let manifest: serde_json::Value =
        serde_json::from_slice(&fs::read(output.join("manifest.json")).unwrap()).unwrap();
    assert_eq!(manifest["size"], serde_json::json!([64, 36]));
    assert_eq!(manifest["method"], "auto");
    assert_eq!(manifest["tolerance_px"], 0.5);
    assert_eq!(manifest["frames"].as_array().unwrap().len(), 3);
    let picture = read_png(&output.join("frame_00001.png"));
    assert_eq!(
        manifest["frames"][1]["sha256"].as_str().unwrap(),
        hex(&<sha2::Sha256 as sha2::Digest>::digest(&picture.2))
    );
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn read_png(path: &Path) -> (u32, u32, Vec<u8>) {
    let decoder = png::Decoder::new(std::io::BufReader::new(fs::File::open(path).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    pixels.truncate(info.buffer_size());
    (info.width, info.height, pixels)
}

#[test]
fn a_check_measures_the_same_pixels_however_frames_are_split() {
    let world = World::new(60);
    let render = |name: &str, more: &[&str]| {
        let output = world.dir.path(name);
        let arguments = ["--size", "96x54", "--frames", "0..2", "--method", "exact"];
        let mut command = world.render();
        let said = succeed(command.args(arguments).args(more).arg("-o").arg(&output));
        let manifest = fs::read(output.join("manifest.json")).unwrap();
        (said, serde_json::from_slice::<serde_json::Value>(&manifest).unwrap())
    };
    let (said, plain) = render("plain", &["--workers", "1"]);
    assert!(!said.contains("checked"), "{said}");
    assert!(plain["frames"][0].get("error_px_p99").is_none());
    let (said, columns) = render("columns", &["--workers", "2", "--check", "20%"]);
    assert!(said.contains("against exact: error p50 0.000, p99 0.000, max 0.000 pixels"), "{said}");
    let tiles = ["--workers", "1", "--check", "20%", "--split", "tiles:16"];
    let (_, tiles) = render("tiles", &tiles);
    for index in 0..2 {
        let [plain, columns, tiles] = [&plain, &columns, &tiles].map(|m| &m["frames"][index]);
        assert_eq!((&plain["sha256"], &plain["sha256"]), (&columns["sha256"], &tiles["sha256"]));
        for key in ["error_px_p99", "error_px_max", "mismatch"] {
            assert_eq!((&columns[key], &tiles[key]), (&0.0.into(), &0.0.into()), "{key}");
        }
        let count = columns["checked_pixels"].as_u64().unwrap();
        assert!((850..1250).contains(&count), "{count} of 5184");
        assert_eq!(tiles["checked_pixels"], count);
    }
    let (said, all) = render("all", &["--workers", "1", "--check", "100%", "--json"]);
    assert_eq!(all["frames"][0]["checked_pixels"], 96 * 54);
    let said: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!(said["check"]["checked_pixels"], 2 * 96 * 54);
    assert_eq!(said["check"]["error_px"]["max"], 0.0);
}

#[test]
fn the_manifest_counts_the_fallbacks_of_a_frame_however_it_is_split() {
    let world = World::new(200);
    let render = |name: &str, more: &[&str]| {
        let output = world.dir.path(name);
        let mut command = world.render();
        let arguments = ["--size", "96x54", "--frames", "0..2", "--workers", "1", "--samples", "2"];
        let said = succeed(command.args(arguments).args(more).arg("-o").arg(&output));
        let manifest = fs::read(output.join("manifest.json")).unwrap();
        (said, serde_json::from_slice::<serde_json::Value>(&manifest).unwrap())
    };
    let (said, columns) = render("columns", &["--method", "column"]);
    assert!(said.contains("% of the pixels were not done the method's own way"), "{said}");
    let (_, tiles) = render("tiles", &["--method", "column", "--split", "tiles:16"]);
    let mut sum = 0;
    for index in 0..2 {
        let [columns, tiles] = [&columns, &tiles].map(|manifest| &manifest["frames"][index]);
        let count = columns["fallbacks"].as_u64().unwrap();
        assert_eq!(tiles["fallbacks"], count);
        assert_eq!(columns["fallback_share"], count as f64 / (4 * 96 * 54) as f64);
        assert!((1..4 * 96 * 54).contains(&count), "{count}");
        sum += count;
    }
    assert_eq!(columns["fallbacks"], sum);
    assert_eq!(columns["fallback_share"], sum as f64 / (2 * 4 * 96 * 54) as f64);
    let (said, exact) = render("exact", &["--method", "exact", "--json"]);
    assert_eq!((&exact["fallbacks"], &exact["fallback_share"]), (&0.into(), &0.0.into()));
    let said: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!(said["fallbacks"], 0);
}

#[test]
fn the_slow_twin_makes_the_same_picture() {
    let world = World::new(60);
    let render = |method: &str| {
        let output = world.dir.path(method);
        succeed(
            world
                .render()
                .args(["--size", "96x54", "--frames", "0..2", "--workers", "1", "--samples", "1"])
                .args(["--method", method, "-o"])
                .arg(&output),
        );
        crate::support::frame_hashes(&output.join("manifest.json"))
    };
    assert_eq!(render("exact"), render("reference"));
}

#[test]
fn mp4_and_y4m_hold_the_frames_and_their_colours() {
    if !oracle("ffmpeg") {
        return;
    }
    let world = World::new(120);
    let pictures = world.dir.path("pictures");
    let arguments = ["--size", "192x108", "--frames", "0..5", "--workers", "1", "-o"];
    succeed(world.render().args(arguments).arg(&pictures));
    for name in ["film.mp4", "film.y4m"] {
        let film = world.dir.path(name);
        succeed(world.render().args(arguments).arg(&film));
        let raw = Command::new("ffmpeg")
            .args(["-v", "warning", "-i"])
            .arg(&film)
            .args(["-f", "rawvideo", "-pix_fmt", "rgb24", "-"])
            .output()
            .unwrap();
        assert_eq!(String::from_utf8_lossy(&raw.stderr), "", "{name}");
        let frame_bytes = 192 * 108 * 3;
        assert_eq!(raw.stdout.len(), 5 * frame_bytes, "{name}");
        for index in 0..5 {
            let (_, _, truth) = read_png(&pictures.join(format!("frame_{index:05}.png")));
            let shown = &raw.stdout[index * frame_bytes..][..frame_bytes];
            let squares: f64 =
                truth.iter().zip(shown).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
            let psnr = 10.0 * (255.0f64.powi(2) * frame_bytes as f64 / squares.max(1.0)).log10();
            assert!(psnr > 28.0, "{name} frame {index}: {psnr:.1} dB");
        }
    }
}

#[test]
fn sampling_reads_columns_in_any_order_and_leaves_voids_empty() {
    let dir = Dir::new();
    let grid = dir.write(
        "g.asc",
        "ncols 3\nnrows 2\nxllcenter 500000\nyllcenter 5000000\ncellsize 10\nNODATA_value -1\n\
         1 2 -1\n4 6 8\n",
    );
    let store = dir.path("g.terrain");
    succeed(
        terrafarm()
            .args(["terrain", "import", "--source-crs", "EPSG:32633"])
            .arg(&grid)
            .arg("-o")
            .arg(&store),
    );
    let points = dir.write(
        "p.csv",
        "name,y,x\nsw,5000000,500000\nmid,5000005,500005\nvoid,5000010,500020\nfar,0,0\n",
    );
    let csv =
        succeed(terrafarm().args(["terrain", "sample"]).arg(&store).arg("--points").arg(&points));
    let lines: Vec<_> = csv.lines().collect();
    assert_eq!(lines[0], "name,y,x,height_m");
    assert_eq!(lines[1], "sw,5000000,500000,4");
    assert_eq!(lines[2], "mid,5000005,500005,3.25");
    assert_eq!(lines[3], "void,5000010,500020,");
    assert_eq!(lines[4], "far,0,0,");
}

#[test]
fn info_is_readable_by_people_and_scripts() {
    let world = World::new(300);
    let store = world.dir.path("land.terrain");
    let text = succeed(terrafarm().args(["terrain", "info"]).arg(&store));
    for word in ["LOCAL", "300", "levels", "bytes per post"] {
        assert!(text.contains(word), "{word} is not in\n{text}");
    }
    let json = succeed(terrafarm().args(["terrain", "info", "--json"]).arg(&store));
    let info: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert!(info["layers"].as_array().unwrap().len() >= 2, "{json}");
}

#[test]
fn the_same_seed_makes_the_same_store() {
    let dir = Dir::new();
    for name in ["a.terrain", "b.terrain"] {
        succeed(
            terrafarm()
                .args(["terrain", "synth", "--size", "130", "--seed", "3", "-o"])
                .arg(dir.path(name)),
        );
    }
    assert!(fs::read(dir.path("a.terrain")).unwrap() == fs::read(dir.path("b.terrain")).unwrap());
}

#[test]
fn the_simulator_keeps_its_promises_for_a_few_seeds() {
    let dir = Dir::new();
    for seed in 1..=3 {
        let json = dir.path("sim.json");
        succeed(
            terrafarm()
                .args(["simulate", "--workers", "31", "--frames", "60", "--faults", "--seed"])
                .arg(seed.to_string())
                .arg("--json")
                .arg(&json),
        );
        let report: serde_json::Value = serde_json::from_slice(&fs::read(&json).unwrap()).unwrap();
        let broken: Vec<_> = report["invariants"]
            .as_object()
            .unwrap()
            .iter()
            .filter(|(_, n)| n.as_u64() != Some(0))
            .collect();
        assert!(broken.is_empty(), "seed {seed}: {broken:?}");
        for key in ["efficiency", "makespan_s", "jobs"] {
            assert!(report[key].as_f64().is_some_and(|value| value > 0.0), "{key}");
        }
    }
}

#[test]
fn a_simulated_night_replays_from_its_journal_and_a_damaged_one_is_refused() {
    let dir = Dir::new();
    let journal = dir.path("night");
    let faults = ["--churn", "--partitions", "--slow-links", "--lost-messages", "--skew"];
    succeed(
        terrafarm()
            .args(["simulate", "--frames", "60", "--shots", "3"])
            .args(faults)
            .arg("--journal")
            .arg(&journal),
    );
    let replay = |file: &Path| {
        let output = terrafarm().args(["simulate", "--replay"]).arg(file).output().unwrap();
        let words = [output.stdout, output.stderr].concat();
        (output.status.code(), String::from_utf8(words).unwrap())
    };
    let (code, words) = replay(&journal);
    assert!(code == Some(0) && words.contains("the same"), "{words}");
    let whole = fs::read(&journal).unwrap();
    fs::write(&journal, &whole[..whole.len() / 2 + 1]).unwrap();
    let (code, words) = replay(&journal);
    assert!(code == Some(0) && words.contains("cut off"), "{words}");
    let mut damaged = whole;
    damaged[500] ^= 1;
    fs::write(&journal, &damaged).unwrap();
    let (code, words) = replay(&journal);
    assert!(code == Some(2) && words.contains("damaged at byte"), "{words}");
}

/// Heights of `gdallocationinfo` at lon/lat points, bilinear between samples.
fn gdal_heights(file: &Path, points: &[[f64; 2]]) -> Vec<Option<f64>> {
    let mut child = Command::new("gdallocationinfo")
        .args(["-valonly", "-wgs84", "-r", "bilinear"])
        .arg(file)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let text: String = points.iter().map(|[lon, lat]| format!("{lon} {lat}\n")).collect();
    std::thread::spawn(move || stdin.write_all(text.as_bytes()));
    let output = child.wait_with_output().unwrap();
    String::from_utf8(output.stdout).unwrap().lines().map(|line| line.trim().parse().ok()).collect()
}

#[test]
fn real_terrain_imports_and_agrees_with_gdal_within_the_reported_error() {
    let Some(data) = shared_data() else { return };
    if !oracle("gdallocationinfo") {
        return;
    }
    let bilinear = Command::new("gdallocationinfo").arg("--help").output().unwrap();
    let help = [bilinear.stdout, bilinear.stderr].concat();
    let bilinear = String::from_utf8_lossy(&help).contains("-r ");
    let cases = [
        ("zion/srtm.tif", [-113.23, -112.86, 37.14, 37.50], 1.0),
        ("rmnp/rmnp-dem.tif", [-105.9, -105.5, 40.17, 40.54], 1.0),
        ("rmnp/SRTMGL3_40.09_-105.55.asc", [-105.54, -105.36, 40.10, 40.20], 1.0),
    ];
    let dir = Dir::new();
    for (name, [west, east, south, north], _) in cases {
        let store = dir.path("x.terrain");
        succeed(
            terrafarm()
                .args(["terrain", "import", "--force", "--source-crs", "EPSG:4326"])
                .arg(data.join(name))
                .arg("-o")
                .arg(&store),
        );
        let info: serde_json::Value = serde_json::from_str(&succeed(
            terrafarm().args(["terrain", "info", "--json"]).arg(&store),
        ))
        .unwrap();
        let reported = info["report"]["max_resampling_error_m"].as_f64().unwrap();
        assert!(reported > 0.0, "{name}: a reprojection has an error");
        if !bilinear {
            println!("skipped: this gdallocationinfo does not interpolate");
            continue;
        }
        let points: Vec<_> = (0..400)
            .map(|n| {
                let (a, b) = (f64::from(n % 20) / 19.0, f64::from(n / 20) / 19.0);
                [
                    west + (east - west) * (0.013 + 0.97 * a),
                    south + (north - south) * (0.017 + 0.96 * b),
                ]
            })
            .collect();
        let truth = gdal_heights(&data.join(name), &points);
        let csv: String = points.iter().map(|[lon, lat]| format!("{lon},{lat}\n")).collect();
        let list = dir.write("points.csv", format!("lon,lat\n{csv}"));
        let sampled =
            succeed(terrafarm().args(["terrain", "sample"]).arg(&store).arg("--points").arg(&list));
        let mut compared = 0;
        for (line, truth) in sampled.lines().skip(1).zip(&truth) {
            let height: Option<f64> = line.rsplit(',').next().unwrap().parse().ok();
            if let (Some(height), Some(truth)) = (height, truth) {
                assert!(
                    (height - truth).abs() <= reported,
                    "{name}: {line}, gdal says {truth}, reported {reported}"
                );
                compared += 1;
            }
        }
        assert!(compared > 200, "{name}: only {compared} points compared");
    }
}

#[test]
fn a_hillshade_can_be_looked_at() {
    let world = World::new(100);
    let picture = world.dir.path("shade.png");
    succeed(
        terrafarm()
            .args(["terrain", "hillshade"])
            .arg(world.dir.path("land.terrain"))
            .arg("-o")
            .arg(&picture),
    );
    let (width, height, pixels) = read_png(&picture);
    assert_eq!((width, height), (100, 100));
    let inner: Vec<_> = pixels.iter().filter(|&&grey| grey > 0).collect();
    assert!(inner.len() > 9000);
}

#[test]
fn help_and_version_end_well() {
    for arguments in
        [&["--help"][..], &["--version"], &["render", "--help"], &["terrain", "import", "--help"]]
    {
        succeed(terrafarm().args(arguments));
    }
    run(terrafarm().arg("fly-me-to-the-moon"), 2);
}

/// The import command that stands at the top of an example scene, without its output.
fn import_command(scene: &str) -> Vec<String> {
    let comment: String = scene
        .lines()
        .skip_while(|line| !line.contains("terrafarm terrain import"))
        .take_while(|line| line.starts_with('#'))
        .map(|line| line.trim_start_matches('#').trim().trim_end_matches('\\'))
        .collect::<Vec<_>>()
        .join(" ");
    let words = comment.split_whitespace().skip(1).map(str::to_owned);
    words.take_while(|word| word != "-o").collect()
}

#[test]
fn the_example_scenes_of_real_terrain_can_be_imported_and_rendered() {
    if shared_data().is_none() {
        return;
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let dir = Dir::new();
    for name in ["zion", "santa_barbara", "helens", "fuji", "rmnp"] {
        let scene = fs::read_to_string(root.join(format!("deploy/scenes/{name}.toml"))).unwrap();
        let store = dir.path(&format!("{name}.terrain"));
        succeed(terrafarm().current_dir(root).args(import_command(&scene)).arg("-o").arg(&store));
        let here = scene.replace(&format!("../../out/{name}.terrain"), &format!("{name}.terrain"));
        let scene = dir.write(&format!("{name}.toml"), here);
        let picture = dir.path(&format!("{name}.png"));
        succeed(
            terrafarm()
                .arg("render")
                .arg(&scene)
                .arg("--flight")
                .arg(root.join(format!("deploy/scenes/{name}.csv")))
                .args(["--frames", "300..301", "--size", "160x90", "--workers", "1", "-o"])
                .arg(&picture),
        );
        let (_, _, pixels) = read_png(&picture);
        let shades: std::collections::BTreeSet<_> = pixels.chunks_exact(3).collect();
        assert!(shades.len() > 500, "{name}: only {} colours", shades.len());
    }
}

#[test]
fn whoever_reads_only_the_first_line_ends_nothing() {
    let mut command = terrafarm();
    command.args(["simulate", "--workers", "2", "--frames", "3"]);
    let mut running = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // Gone before there is anything to read.
    drop(running.stdout.take());
    let ended = running.wait_with_output().unwrap();
    let said = String::from_utf8(ended.stderr).unwrap();
    assert_eq!((ended.status.code(), said.as_str()), (Some(0), ""));
}
