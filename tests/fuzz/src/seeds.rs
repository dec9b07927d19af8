//! First inputs: small, valid, made here. The fuzzer mutates them.

use std::path::Path;
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::BlobHash;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Split;
use terrafarm_common::shading::Shading;
use terrafarm_coordinator::queue::{Film, ShotPlan, Source};

/// The variable that names the folder to write seeds into.
const FOLDER: &str = "TERRAFARM_FUZZ_SEEDS";

/// Asserts that every seed is accepted: a target that refuses its own seeds tests nothing
/// but its front door. Writes them to the folder that `TERRAFARM_FUZZ_SEEDS` names.
pub fn plant(seeds: &[Vec<u8>], accepts: fn(&[u8]) -> bool) {
    let folder = std::env::var_os(FOLDER);
    for (number, seed) in seeds.iter().enumerate() {
        assert!(accepts(seed), "seed {number} is refused");
        if let Some(folder) = &folder {
            let path = Path::new(folder).join(format!("seed-{number:03}"));
            std::fs::write(&path, seed).expect("the folder of seeds can be written");
        }
    }
}

/// The messages as the wire tests keep them: bytes of one whole frame each.
pub fn golden_frames() -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../common/wire/tests/golden/v1");
    let files = std::fs::read_dir(folder).expect("the golden files are part of the repository");
    let mut paths: Vec<_> = files.map(|file| file.expect("a file").path()).collect();
    paths.sort();
    paths.iter().map(|path| std::fs::read(path).expect("a golden file")).collect()
}

/// A submission of one frame, as JSON.
pub fn submission() -> String {
    let size = (64, 36);
    let camera = Camera::from_angles([1.0, 0.1, 0.2].into(), 10.0, -20.0, 0.0, 60.0, size);
    let plan = ShotPlan {
        name: "hills".to_owned(),
        priority: 0,
        index: BlobHash([7; 32]),
        shading: Shading::default(),
        quality: Quality::default(),
        check: Share::NONE,
        size: [size.0, size.1],
        split: Split::Tiles(64),
        fps: 25.0,
        first_frame: 0,
        cameras: vec![camera],
        frames_in_flight: 3,
        film: Some(Film::Mp4),
        source: Source::default(),
    };
    serde_json::to_string(&plan).expect("a plan is plain data")
}
