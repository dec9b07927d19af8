//! Two pictures and how far they are apart, against other programs.

use crate::support::{Dir, run, succeed, terrafarm};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Whether a program we compare with is here. Where the tests must not skip
/// (`TERRAFARM_REQUIRE_ORACLES`), its absence is a failure.
fn oracle(program: &str) -> bool {
    let mut command = Command::new(program);
    let here = command.arg("-version").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok();
    if !here {
        let required = std::env::var_os("TERRAFARM_REQUIRE_ORACLES").is_some();
        assert!(!required, "{program} is not on PATH");
        println!("skipped: {program} is not on PATH");
    }
    here
}

/// Writes a PNG of bytes or of 16-bit values, most significant byte first.
fn write(dir: &Dir, name: &str, size: [u32; 2], color: png::ColorType, bytes: &[u8]) -> PathBuf {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, size[0], size[1]);
    encoder.set_color(color);
    let samples = size[0] as usize * size[1] as usize * color.samples();
    let sixteen = bytes.len() == 2 * samples;
    encoder.set_depth(if sixteen { png::BitDepth::Sixteen } else { png::BitDepth::Eight });
    let mut writer = encoder.write_header().unwrap();
    writer.write_image_data(bytes).unwrap();
    writer.finish().unwrap();
    dir.write(name, file)
}

/// Hills under a sky, one byte a channel, moved and roughened by so much.
fn hills([width, height]: [u32; 2], shift: u32, rough: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let top = 60 + ((x + shift) * 7 / 5 % 90).abs_diff(45);
            let noise = (x * 7919 + y * 104_729) % 31 * rough / 31;
            let ground = 90 + (x + shift) % 40 + y % 23 + noise;
            bytes.push(if y < top { 200 } else { ground as u8 });
        }
    }
    bytes
}

fn json(one: &Path, other: &Path) -> serde_json::Value {
    let mut compare = terrafarm();
    let text = succeed(compare.arg("compare").arg(one).arg(other).arg("--json"));
    serde_json::from_str(&text).unwrap()
}

fn three_channels(grey: &[u8]) -> Vec<u8> {
    let tint = |level: &u8| [*level, level.saturating_sub(9), level / 2 + 30];
    grey.iter().flat_map(tint).collect()
}

#[test]
fn psnr_and_ssim_agree_with_imagemagick() {
    if !oracle("compare") {
        return;
    }
    let dir = Dir::new();
    let size = [256, 160];
    let ask = |metric: &str, paths: [&Path; 2]| -> Option<f64> {
        let mut compare = Command::new("compare");
        let said = compare.args(["-metric", metric]).args(paths).arg("null:").output().unwrap();
        let said = String::from_utf8(said.stderr).unwrap();
        if said.contains("unrecognized metric") {
            println!("skipped: this ImageMagick does not know {metric}");
            return None;
        }
        Some(said.split_whitespace().next().unwrap().parse().unwrap())
    };
    for (number, (shift, rough)) in [(0, 30), (2, 0), (1, 8)].into_iter().enumerate() {
        let (plain, changed) = (hills(size, 0, 0), hills(size, shift, rough));
        let grey = png::ColorType::Grayscale;
        let one = write(&dir, "one.png", size, grey, &plain);
        let other = write(&dir, "other.png", size, grey, &changed);
        let found = json(&one, &other);
        let psnr = ask("PSNR", [&one, &other]).unwrap();
        let off = found["psnr_db"].as_f64().unwrap() - psnr;
        assert!(off.abs() < 0.01, "{number}: PSNR {found}, not {psnr}");
        // The window at the border is cut here and filled with the border's pixels there.
        if let Some(ssim) = ask("SSIM", [&one, &other]) {
            let off = found["ssim"].as_f64().unwrap() - ssim;
            assert!(off.abs() < 0.005, "{number}: SSIM {found}, not {ssim}");
        }
        let rgb = png::ColorType::Rgb;
        let one = write(&dir, "one.png", size, rgb, &three_channels(&plain));
        let other = write(&dir, "other.png", size, rgb, &three_channels(&changed));
        let (found, psnr) = (json(&one, &other), ask("PSNR", [&one, &other]).unwrap());
        let off = found["psnr_db"].as_f64().unwrap() - psnr;
        assert!(off.abs() < 0.01, "{number}: PSNR {found}, not {psnr}");
    }
}

#[test]
fn psnr_and_ssim_agree_with_ffmpeg() {
    if !oracle("ffmpeg") {
        return;
    }
    let dir = Dir::new();
    let size = [128, 96];
    let rgb = png::ColorType::Rgb;
    let one = write(&dir, "one.png", size, rgb, &three_channels(&hills(size, 0, 0)));
    let other = write(&dir, "other.png", size, rgb, &three_channels(&hills(size, 3, 12)));
    let ask = |filter: &str, mark: &str, paths: [&Path; 2]| -> f64 {
        let mut ffmpeg = Command::new("ffmpeg");
        ffmpeg.args(["-hide_banner", "-i"]).arg(paths[0]).arg("-i").arg(paths[1]);
        let said = ffmpeg.args(["-lavfi", filter, "-f", "null", "-"]).output().unwrap();
        let said = String::from_utf8_lossy(&said.stderr).into_owned();
        let number = said.split(mark).nth(1).unwrap_or_else(|| panic!("{said}"));
        number.split_whitespace().next().unwrap().parse().unwrap()
    };
    let filter = "[0]format=gbrp[a];[1]format=gbrp[b];[a][b]psnr";
    let truth = ask(filter, "average:", [&one, &other]);
    let found = json(&one, &other)["psnr_db"].as_f64().unwrap();
    assert!((found - truth).abs() < 0.01, "{found}, not {truth}");
    // That one has flat windows of 8 x 8 pixels, which see the same loss differently.
    for (shift, rough) in [(0, 30), (2, 0), (1, 8)] {
        let grey = png::ColorType::Grayscale;
        let one = write(&dir, "one.png", size, grey, &hills(size, 0, 0));
        let other = write(&dir, "other.png", size, grey, &hills(size, shift, rough));
        let filter = "[0]format=gray[a];[1]format=gray[b];[a][b]ssim";
        let truth = ask(filter, "All:", [&one, &other]);
        let found = json(&one, &other)["ssim"].as_f64().unwrap();
        println!("SSIM {found}, ffmpeg {truth}");
        assert!((found - truth).abs() < 0.02, "{found}, not {truth}");
    }
}

#[test]
fn pictures_of_8_and_16_bits_compare_and_the_difference_can_be_looked_at() {
    let dir = Dir::new();
    let size = [64, 80];
    let eight = hills(size, 0, 0);
    let sixteen: Vec<u8> = eight.iter().flat_map(|byte| [*byte, *byte]).collect();
    let grey = png::ColorType::Grayscale;
    let one = write(&dir, "one.png", size, grey, &eight);
    let deep = write(&dir, "deep.png", size, grey, &sixteen);
    let same = json(&one, &deep);
    assert_eq!((&same["identical"], &same["psnr_db"]), (&true.into(), &serde_json::Value::Null));
    let other = write(&dir, "other.png", size, grey, &hills(size, 3, 0));
    let difference = dir.path("difference.png");
    let mut compare = terrafarm();
    compare.arg("compare").arg(&one).arg(&other).arg("--difference").arg(&difference);
    let said = succeed(&mut compare);
    for word in ["PSNR", "SSIM", "11 x 11 Gaussian", "silhouettes", "differences times "] {
        assert!(said.contains(word), "{word} is not in {said}");
    }
    assert_eq!(json(&difference, &difference)["ssim"], 1.0);
}

#[test]
fn sequences_compare_by_number_and_name_their_worst() {
    let dir = Dir::new();
    let size = [64, 80];
    let rgb = png::ColorType::Rgb;
    for folder in ["a", "b"] {
        std::fs::create_dir(dir.path(folder)).unwrap();
    }
    for number in 0..3 {
        let picture = |shift| three_channels(&hills(size, shift, 0));
        write(&dir, &format!("a/frame_{number:05}.png"), size, rgb, &picture(0));
        write(&dir, &format!("b/x{number}.png"), size, rgb, &picture(number % 2 * 5));
    }
    write(&dir, "b/x77.png", size, rgb, &three_channels(&hills(size, 0, 0)));
    dir.write("a/manifest.json", "{}");
    let found = json(&dir.path("a/manifest.json"), &dir.path("b"));
    assert_eq!((&found["pictures"], &found["unpaired"]), (&3.into(), &1.into()), "{found}");
    assert_eq!(found["worst_number"], 1);
    assert!(found["worst"]["psnr_db"].as_f64() < found["mean"]["psnr_db"].as_f64());
}

#[test]
fn what_cannot_be_compared_is_named_with_the_reason() {
    let dir = Dir::new();
    let rgb = png::ColorType::Rgb;
    let good = write(&dir, "good.png", [4, 3], rgb, &[7; 36]);
    let large = write(&dir, "large.png", [5, 3], rgb, &[7; 45]);
    let clear = write(&dir, "clear.png", [4, 3], png::ColorType::Rgba, &[7; 48]);
    let text = dir.write("text.png", "no picture at all");
    let whole = std::fs::read(&good).unwrap();
    let damaged = dir.write("damaged.png", &whole[..whole.len() / 2]);
    std::fs::create_dir(dir.path("empty")).unwrap();
    let before = dir.names();
    for (other, said) in [
        (large, "4 x 3 pixels, the other 5 x 3"),
        (clear, "transparent"),
        (text, "no PNG"),
        (damaged, "damaged"),
        (dir.path("nowhere.png"), "nowhere.png"),
        (dir.path("empty"), "give two pictures or two folders"),
    ] {
        let mut compare = terrafarm();
        compare.arg("compare").arg(&good).arg(&other);
        let (_, stderr) = run(compare.arg("--difference").arg(dir.path("d.png")), 2);
        assert!(stderr.contains(said), "{said:?} is not in: {stderr}");
    }
    let mut compare = terrafarm();
    compare.arg("compare").arg(dir.path("empty")).arg(dir.path("empty"));
    let (_, stderr) = run(&mut compare, 2);
    assert!(stderr.contains("no numbered PNG"), "{stderr}");
    assert_eq!(dir.names(), before, "something was left behind");
}
