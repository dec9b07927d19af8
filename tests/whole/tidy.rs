//! Reads the manifests and fails on any dependency arrow that ARCHITECTURE.md does not
//! have, and reads the sources for what must not stand in them.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Every allowed arrow between our own crates. The program (`terrafarm`) puts the parts
/// together and may use them all.
const ARROWS: &[(&str, &[&str])] = &[
    ("common", &[]),
    ("geo", &[]),
    ("wire", &["common"]),
    ("terrain", &["common", "geo"]),
    ("raster", &["common", "geo"]),
    ("import", &["common", "geo", "raster", "terrain"]),
    ("synth", &["common", "terrain"]),
    ("raycast", &["common", "terrain"]),
    ("worker", &["common", "wire", "terrain", "raycast"]),
    ("sched", &["common"]),
    ("film", &["common"]),
    ("coordinator", &["common", "wire", "sched", "film", "terrain"]),
];

/// Crates that decide or compute and therefore may not know a network, a clock, a log or
/// a thread pool, whatever comes transitively.
const PURE: &[(&str, &[&str])] = &[
    ("common", &["tokio", "rayon", "tracing"]),
    ("sched", &["tokio", "rayon", "tracing", "rand"]),
    ("film", &["tokio", "rayon", "tracing"]),
    ("raycast", &["tokio", "rayon", "tracing"]),
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn manifests() -> BTreeMap<String, toml::Table> {
    let read = |path: PathBuf| -> toml::Table {
        fs::read_to_string(&path).unwrap().parse().unwrap_or_else(|e| panic!("{path:?}: {e}"))
    };
    let workspace = read(root().join("Cargo.toml"));
    let members = workspace["workspace"]["members"].as_array().unwrap();
    let crates = members.iter().map(|member| {
        let table = read(root().join(member.as_str().unwrap()).join("Cargo.toml"));
        let name = table["package"]["name"].as_str().unwrap();
        (name.strip_prefix("terrafarm-").expect("every member is terrafarm-...").to_owned(), table)
    });
    crates.collect()
}

fn dependencies(manifest: &toml::Table) -> Vec<String> {
    let table = manifest.get("dependencies").and_then(toml::Value::as_table);
    table.into_iter().flat_map(|table| table.keys().cloned()).collect()
}

#[test]
fn crates_depend_only_along_the_arrows() {
    let manifests = manifests();
    let known: Vec<_> = ARROWS.iter().map(|(name, _)| (*name).to_owned()).collect();
    let mut found: Vec<_> = manifests.keys().cloned().collect();
    found.sort();
    let mut expected = known.clone();
    expected.sort();
    assert_eq!(found, expected, "a crate came or went: adjust ARROWS and ARCHITECTURE.md");
    for (name, allowed) in ARROWS {
        for dependency in dependencies(&manifests[*name]) {
            let Some(ours) = dependency.strip_prefix("terrafarm-") else { continue };
            assert!(allowed.contains(&ours), "{name} must not depend on {ours}");
        }
    }
}

#[test]
fn pure_crates_know_no_network_no_threads_and_no_log() {
    let manifests = manifests();
    for (name, forbidden) in PURE {
        for dependency in dependencies(&manifests[*name]) {
            assert!(!forbidden.contains(&dependency.as_str()), "{name} must not use {dependency}");
        }
    }
}

#[test]
fn logic_reads_no_clock() {
    for folder in ["coordinator/sched/src", "coordinator/film/src", "worker/raycast/src"] {
        for (path, text) in sources(&root().join(folder)) {
            for clock in ["Instant::now", "SystemTime::now"] {
                assert!(!text.contains(clock), "{} reads a clock: {clock}", path.display());
            }
        }
    }
}

#[test]
fn pixels_use_no_platform_maths() {
    // sin, exp and pow of the platform differ between systems in the last bit; fused
    // multiply-add differs between processors. A frame must not.
    let banned = [
        ".sin()",
        ".cos()",
        ".tan()",
        ".exp()",
        ".powf(",
        ".powi(",
        ".ln()",
        ".mul_add(",
        ".atan2(",
        ".exp2(",
    ];
    for folder in
        ["worker/raycast/src", "worker/terrain/src", "worker/terrain/synth/src", "common/src"]
    {
        for (path, text) in sources(&root().join(folder)) {
            let code = text.split("#[cfg(test)]").next().unwrap();
            // Oracles compare with formulas; what they compute is no pixel.
            if path.components().any(|part| part.as_os_str() == "oracle") {
                continue;
            }
            let name = path.file_name().unwrap();
            if name == "tests_support.rs" || name == "tests.rs" || name == "oracle.rs" {
                continue;
            }
            for (number, line) in code.lines().enumerate() {
                let line = line.split("//").next().unwrap();
                for word in banned {
                    assert!(
                        !line.contains(word),
                        "{}:{}: {word} is not the same on every PC; use libm",
                        path.display(),
                        number + 1
                    );
                }
            }
        }
    }
}

#[test]
fn every_top_level_document_exists() {
    for name in [
        "README.md",
        "ARCHITECTURE.md",
        "CONTRIBUTING.md",
        "CHANGELOG.md",
        "LICENSE-MIT",
        "LICENSE-APACHE",
    ] {
        assert!(root().join(name).is_file(), "{name} is missing");
    }
}

fn sources(folder: &Path) -> Vec<(PathBuf, String)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path).unwrap();
            found.push((path, text));
        }
    }
    found
}
