//! First inputs: small, valid, made here. The fuzzer mutates them.

use std::path::Path;

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
