use crate::round_trip::bytes;
use crate::samples;
use std::path::PathBuf;
use terrafarm_wire::decode;

/// The variable that makes this test write the files instead of comparing them.
const REGENERATE: &str = "REGENERATE_GOLDEN";

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden/v1")
}

#[test]
fn version_1_is_written_and_read_as_it_was_released() {
    for (name, message) in samples::all() {
        let path = folder().join(format!("{name}.bin"));
        let written = bytes(&message);
        if std::env::var_os(REGENERATE).is_some() {
            std::fs::create_dir_all(folder()).unwrap();
            std::fs::write(&path, &written).unwrap();
        }
        let stored = std::fs::read(&path).unwrap_or_else(|error| {
            panic!("{}: {error}; write it with {REGENERATE}=1", path.display())
        });
        let advice = format!(
            "{name}: the encoding has changed. Peers of version 1 will not understand it: give \
             the protocol a new version. Only if version 1 was never released, run this test \
             with {REGENERATE}=1 and commit the files"
        );
        assert_eq!(written, stored, "{advice}");
        assert_eq!(decode(&stored), Ok(vec![message]), "{advice}");
    }
}

#[test]
fn there_is_no_file_without_its_message() {
    let expected = samples::all().into_iter().map(|(name, _)| format!("{name}.bin"));
    let expected: std::collections::BTreeSet<String> = expected.collect();
    let found = std::fs::read_dir(folder()).unwrap();
    for file in found {
        let name = file.unwrap().file_name().into_string().unwrap();
        assert!(expected.contains(&name), "{name} belongs to no sample; delete it");
    }
}
