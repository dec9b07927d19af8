#![allow(clippy::unwrap_used)]
use super::manifest::{FrameEntry, Manifest, place};
use super::video::Mp4Sink;
use super::*;
use std::fs;
use std::process::Command;

fn spec(width: u32, height: u32, frames: u32) -> Spec {
    Spec { width, height, fps: 25.0, first: 0, frames }
}

/// A picture that differs from frame to frame: smooth ramps, as terrain under haze has.
fn picture(spec: Spec, frame: u32) -> Rgb8 {
    let (width, height) = (spec.width, spec.height);
    let pixel = |i: u32| {
        let (x, y) = (i % width, i / width);
        let shade = frame % 32;
        [x * 200 / width + shade, y * 220 / height + shade, 255 - x * 150 / width - shade]
            .map(|value| value as u8)
    };
    let pixels = (0..width * height).flat_map(pixel).collect();
    Rgb8::from_pixels(width, height, pixels).unwrap()
}

fn fill(sink: &mut dyn FrameSink, spec: Spec) {
    for frame in 0..spec.frames {
        sink.put(frame, &picture(spec, frame)).unwrap();
    }
}

fn write(output: &Path, spec: Spec, encoder: Encoder) -> Result<Finished, SinkError> {
    let mut sink = open(output, spec, encoder)?;
    fill(sink.as_mut(), spec);
    sink.finish()
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

/// Output of a program, or `None`, said aloud, where it is not installed.
fn ask(program: &str, arguments: &[&str]) -> Option<Vec<u8>> {
    let Ok(output) = Command::new(program).args(arguments).output() else {
        println!("skipped: {program} is not on the path");
        return None;
    };
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.trim().is_empty(), "{program}: {said}");
    Some(output.stdout)
}

/// Every frame as ffmpeg shows it, RGB8.
fn decoded(path: &Path, matrix: &str) -> Option<Vec<u8>> {
    let path = path.to_str().unwrap();
    let filter = format!("scale=flags=accurate_rnd+full_chroma_int+bilinear{matrix}");
    ask(
        "ffmpeg",
        &["-v", "warning", "-i", path, "-vf", &filter, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"],
    )
}

/// Largest and mean difference of two lists of samples.
fn differences(one: &[u8], other: &[u8]) -> (u8, f64) {
    assert_eq!(one.len(), other.len());
    let each = || one.iter().zip(other).map(|(a, b)| a.abs_diff(*b));
    (each().max().unwrap(), each().map(f64::from).sum::<f64>() / one.len() as f64)
}

fn originals(spec: Spec) -> Vec<u8> {
    (0..spec.frames).flat_map(|frame| picture(spec, frame).into_pixels()).collect()
}

#[test]
fn a_folder_gets_one_numbered_picture_a_frame_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("new/shot/");
    let finished = write(&output, spec(31, 17, 3), Encoder::BuiltIn).unwrap();
    assert_eq!(finished.frames, 3);
    assert_eq!(names(&output), ["frame_00000.png", "frame_00001.png", "frame_00002.png"]);
    let file = fs::File::open(output.join("frame_00002.png")).unwrap();
    let mut reader = ::png::Decoder::new(std::io::BufReader::new(file)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    assert_eq!(pixels, picture(spec(31, 17, 3), 2).into_pixels());
}

#[test]
fn a_picture_that_is_there_already_is_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("poster.png");
    fs::write(&output, b"old").unwrap();
    write(&output, spec(5, 5, 1), Encoder::BuiltIn).unwrap();
    assert!(fs::read(&output).unwrap().starts_with(b"\x89PNG"));
    let bytes = poster::save(&output, &picture(spec(9, 9, 1), 0)).unwrap();
    assert_eq!(bytes, fs::metadata(&output).unwrap().len());
    assert_eq!(names(folder.path()), ["poster.png"]);
}

#[test]
fn an_output_that_is_dropped_or_short_leaves_nothing_behind() {
    for name in ["a.y4m", "a.mp4"] {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join(name);
        fs::write(&output, b"old").unwrap();
        let spec = spec(32, 32, 80);
        let mut sink = open(&output, spec, Encoder::BuiltIn).unwrap();
        for frame in 0..70 {
            sink.put(frame, &picture(spec, frame)).unwrap();
        }
        assert!(matches!(sink.finish(), Err(SinkError::Missing { got: 70, frames: 80, .. })));
        drop(open(&output, spec, Encoder::BuiltIn).unwrap());
        assert_eq!(names(folder.path()), [name]);
        assert_eq!(fs::read(&output).unwrap(), b"old");
    }
}

#[test]
fn frames_out_of_order_twice_or_of_another_size_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let spec = spec(8, 8, 3);
    for name in ["s/", "a.y4m", "a.mp4"] {
        let mut sink = open(&folder.path().join(name), spec, Encoder::BuiltIn).unwrap();
        let good = picture(spec, 0);
        assert!(sink.put(1, &good).is_err());
        sink.put(0, &good).unwrap();
        assert!(sink.put(0, &good).is_err());
        assert!(sink.put(1, &Rgb8::new(8, 9)).is_err());
        sink.put(1, &good).unwrap();
        sink.put(2, &good).unwrap();
        assert!(sink.put(3, &good).is_err());
        sink.finish().unwrap();
    }
}

#[test]
fn outputs_that_cannot_be_say_what_can() {
    let folder = tempfile::tempdir().unwrap();
    let fails = |name: &str, spec: Spec, encoder, hint: &str| {
        let error = open(&folder.path().join(name), spec, encoder).err().unwrap().to_string();
        assert!(error.contains(hint), "{name}: {error}");
    };
    let good = spec(16, 16, 2);
    fails("a.avi", good, Encoder::BuiltIn, ".mp4");
    fails("a.webm", good, Encoder::BuiltIn, "--encoder ffmpeg");
    fails("a.png", good, Encoder::BuiltIn, "a_%05d.png");
    fails("a.mp4", Spec { fps: f64::NAN, ..good }, Encoder::BuiltIn, "rate");
    fails("a.mp4", Spec { fps: 0.0, ..good }, Encoder::Ffmpeg, "rate");
    fails("a.mp4", Spec { width: 8192, height: 8192, ..good }, Encoder::BuiltIn, "4096");
    fails("a.y4m", Spec { width: 0, ..good }, Encoder::BuiltIn, "0 x 16");
    fails("a.y4m", Spec { frames: 0, ..good }, Encoder::BuiltIn, "0 frames");
    fs::write(folder.path().join("file"), b"").unwrap();
    fails("file/a.y4m", good, Encoder::BuiltIn, "cannot make the folder");
    assert_eq!(names(folder.path()), ["file"]);
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_is_named_as_such() {
    let error = io::Error::from_raw_os_error(28);
    let error = SinkError::io("write", Path::new("film.mp4"), error).to_string();
    assert!(error.contains("no space left for film.mp4"), "{error}");
}

#[test]
fn raw_video_keeps_its_colours_to_three_levels() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("a.y4m");
    let spec = spec(101, 57, 3);
    let finished = write(&output, spec, Encoder::BuiltIn).unwrap();
    let bytes = fs::read(&output).unwrap();
    assert_eq!(finished.bytes, bytes.len() as u64);
    let header = bytes.split(|byte| *byte == b'\n').next().unwrap();
    let text = "YUV4MPEG2 W101 H57 F25:1 Ip A1:1 C444 XCOLORRANGE=LIMITED XMATRIX=BT709";
    assert_eq!(header, text.as_bytes());
    assert_eq!(bytes.len(), header.len() + 1 + 3 * (6 + 3 * 101 * 57));
    let Some(seen) = decoded(&output, ":in_color_matrix=bt709") else { return };
    assert!(differences(&seen, &originals(spec)).0 <= 3);
}

/// Frames, rate, colours as ffprobe reports them.
fn facts(path: &Path) -> Option<String> {
    let entries = "stream=codec_name,width,height,pix_fmt,color_range,color_space,color_transfer,color_primaries,chroma_location,has_b_frames,avg_frame_rate,nb_read_frames";
    let path = path.to_str().unwrap();
    let answer = ask(
        "ffprobe",
        &["-v", "warning", "-count_frames", "-show_entries", entries, "-of", "default=nw=1", path],
    )?;
    Some(String::from_utf8(answer).unwrap())
}

#[test]
fn built_in_video_is_decoded_whole_and_in_its_colours() {
    let folder = tempfile::tempdir().unwrap();
    // Odd sides, two groups and a rest.
    for (size, shown) in [((320, 180), (320, 180)), ((161, 97), (162, 98))] {
        let output = folder.path().join(format!("{}.mp4", size.0));
        let spec = spec(size.0, size.1, 65);
        let finished = write(&output, spec, Encoder::BuiltIn).unwrap();
        assert_eq!(finished.bytes, fs::metadata(&output).unwrap().len());
        let Some(facts) = facts(&output) else { return };
        for fact in [
            "codec_name=h264",
            &format!("width={}", shown.0),
            &format!("height={}", shown.1),
            "pix_fmt=yuv420p",
            "color_range=tv",
            "color_space=bt709",
            "color_transfer=bt709",
            "color_primaries=bt709",
            "chroma_location=center",
            "has_b_frames=0",
            "avg_frame_rate=25/1",
            "nb_read_frames=65",
        ] {
            assert!(facts.lines().any(|line| line == fact), "{fact} is not in\n{facts}");
        }
        let seen = decoded(&output, "").unwrap();
        if size == shown {
            let (_, mean) = differences(&seen, &originals(spec));
            assert!(mean < 2.0, "mean difference {mean} levels");
        }
    }
}

/// Pictures that encoders stumble over: noise, one colour, hard cuts, jumps by half a
/// picture, a checkerboard that inverts.
fn awkward(spec: Spec, frame: u32) -> Rgb8 {
    let mut state = u64::from(frame / 20) * 7919 + 1;
    let mut noise = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    let pixel = |i: u32| {
        let (x, y) = (i % spec.width, i / spec.width);
        let moved = (x + frame * spec.width / 2) % spec.width;
        let noise = noise();
        match (frame / 5) % 5 {
            0 => [noise; 3],
            1 => [255, 0, (frame * 50 % 256) as u8],
            2 => [(x * 9 + frame * 90) as u8, (y * 3) as u8, 40],
            3 => [(moved * 4) as u8, (y * 4) as u8, noise / 4],
            _ => [if (x / 8 + y / 8 + frame).is_multiple_of(2) { 255 } else { 0 }; 3],
        }
    };
    let pixels = (0..spec.width * spec.height).flat_map(pixel).collect();
    Rgb8::from_pixels(spec.width, spec.height, pixels).unwrap()
}

#[test]
fn awkward_pictures_do_not_drift_apart_from_what_a_decoder_sees() {
    let folder = tempfile::tempdir().unwrap();
    for (width, height) in [(176, 144), (98, 50), (17, 33)] {
        let spec = spec(width, height, 60);
        let output = folder.path().join(format!("{width}.mp4"));
        let mut sink = open(&output, spec, Encoder::BuiltIn).unwrap();
        (0..spec.frames).for_each(|n| sink.put(n, &awkward(spec, n)).unwrap());
        sink.finish().unwrap();
        let path = output.to_str().unwrap();
        let arguments = ["-v", "warning", "-i", path, "-f", "rawvideo", "-"];
        let Some(seen) = ask("ffmpeg", &arguments) else { return };
        let (wide, high) = (colour::even(width as usize), colour::even(height as usize));
        let frames: Vec<_> = seen.chunks(wide * high * 3 / 2).collect();
        assert_eq!(frames.len(), 60);
        for (n, frame) in frames.into_iter().enumerate() {
            let luma = colour::halved(&awkward(spec, n as u32)).y;
            let (_, mean) = differences(&frame[..wide * high], &luma);
            assert!(mean < 5.0, "{width} x {height}, frame {n}: {mean} levels");
        }
    }
}

#[test]
fn built_in_video_starts_with_its_index() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("a.mp4");
    write(&output, spec(64, 64, 31), Encoder::BuiltIn).unwrap();
    let bytes = fs::read(&output).unwrap();
    let at = |kind: &[u8]| bytes.windows(4).position(|window| window == kind).unwrap();
    assert!(at(b"ftyp") < at(b"moov") && at(b"moov") < at(b"mdat"));
}

#[test]
fn built_in_video_is_the_same_on_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let spec = spec(96, 64, 100);
    let film = |threads: usize| {
        let output = folder.path().join(format!("{threads}.mp4"));
        let mut sink = Box::new(Mp4Sink::with_threads(&output, spec, threads).unwrap());
        fill(sink.as_mut(), spec);
        sink.finish().unwrap();
        fs::read(output).unwrap()
    };
    let one = film(1);
    assert_eq!(one, film(2));
    assert_eq!(one, film(5));
}

#[test]
fn ffmpeg_writes_what_it_is_asked_for() {
    if ask("ffmpeg", &["-v", "error", "-version"]).is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let spec = spec(161, 97, 12);
    for name in ["a.mp4", "a.mkv", "a.webm"] {
        let output = folder.path().join(name);
        write(&output, spec, Encoder::Ffmpeg).unwrap();
        let facts = facts(&output).unwrap();
        for fact in ["width=162", "nb_read_frames=12", "color_space=bt709", "color_range=tv"] {
            assert!(facts.lines().any(|line| line == fact), "{fact} is not in\n{facts}");
        }
    }
    assert_eq!(names(folder.path()), ["a.mkv", "a.mp4", "a.webm"]);
}

#[test]
fn without_ffmpeg_the_error_says_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("a.mp4");
    let missing = ffmpeg::Ffmpeg::with_program("no-such-encoder", &output, spec(8, 8, 1));
    let error = missing.err().unwrap().to_string();
    assert!(error.contains("no program \"no-such-encoder\""), "{error}");
    assert!(names(folder.path()).is_empty());
}

#[cfg(unix)]
#[test]
fn what_the_encoder_complains_of_is_in_the_error() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("broken");
    fs::write(&program, "#!/bin/sh\necho the dog ate it >&2\nexit 3\n").unwrap();
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
    let spec = spec(640, 480, 2);
    let output = folder.path().join("a.mp4");
    let mut sink = ffmpeg::Ffmpeg::with_program(program.to_str().unwrap(), &output, spec).unwrap();
    // The pipe may take the first frame before the end is noticed; finishing never works.
    let error = (0..2).find_map(|frame| sink.put(frame, &picture(spec, frame)).err());
    let error = error.unwrap_or_else(|| Box::new(sink).finish().unwrap_err()).to_string();
    assert!(error.contains("the dog ate it"), "{error}");
    assert_eq!(names(folder.path()), ["broken"]);
}

#[test]
fn the_manifest_lies_with_the_output_and_keeps_the_promised_keys() {
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(place(folder.path()), folder.path().join("manifest.json"));
    let picture = picture(spec(2, 2, 1), 0);
    let frame = FrameEntry {
        index: 0,
        sha256: pixels_sha256(&picture).to_hex(),
        ms: 12.5,
        render_ms: 20.0,
        jobs: 3,
        fallbacks: 1,
        fallback_share: 0.25,
        coarser_pixels: 2,
        below_ground: false,
        error_px_p99: Some(0.25),
        error_px_max: Some(0.5),
        depth_error_m_p99: None,
        mismatch: Some(0.0),
        checked_pixels: Some(4),
    };
    let manifest = Manifest {
        program: "terrafarm 0.1.0".into(),
        scene: "scene.toml".into(),
        scene_sha256: "0".repeat(64),
        terrain: "alps.terrain".into(),
        terrain_sha256: "1".repeat(64),
        flight: None,
        output: "film.mp4".into(),
        method: "exact".into(),
        samples: 1,
        tolerance_px: None,
        size: [2, 2],
        fps: 25.0,
        fallbacks: 1,
        fallback_share: 0.25,
        coarser_pixels: 2,
        frames: vec![frame],
        failed: [(1, "no such tile".to_string())].into(),
        workers: Vec::new(),
    };
    let path = manifest.save(&folder.path().join("film.mp4")).unwrap();
    let text = fs::read(path).unwrap();
    assert_eq!(serde_json::from_slice::<Manifest>(&text).unwrap(), manifest);
    let json: serde_json::Value = serde_json::from_slice(&text).unwrap();
    for key in ["scene", "method", "size", "frames", "program", "fallbacks", "fallback_share"] {
        assert!(json.get(key).is_some(), "{key}");
    }
    assert!(json["frames"][0].get("depth_error_m_p99").is_none(), "what is not known is not there");
    for key in [
        "index",
        "sha256",
        "ms",
        "fallbacks",
        "fallback_share",
        "coarser_pixels",
        "error_px_p99",
        "error_px_max",
        "mismatch",
        "checked_pixels",
    ] {
        assert!(json["frames"][0].get(key).is_some(), "{key}");
    }
    assert_eq!(names(folder.path()), ["manifest.json"]);
}

#[test]
fn the_hash_of_a_picture_is_that_of_its_bytes() {
    let grey = Rgb8::from_pixels(1, 1, vec![97, 98, 99]).unwrap();
    let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
    assert_eq!(pixels_sha256(&grey).to_hex(), abc);
}
