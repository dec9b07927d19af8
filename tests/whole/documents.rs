//! Every command in the documents is one that works.

use std::fs;
use std::path::Path;

/// Lines of fenced `sh` blocks that start a command of ours, continuation lines joined.
fn commands_in(document: &str) -> Vec<String> {
    let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(document)).unwrap();
    let mut found = Vec::new();
    let mut inside = false;
    let mut pending = String::new();
    for line in text.lines() {
        if line.starts_with("```") {
            inside = line.trim() == "```sh" && !inside;
            continue;
        }
        if !inside {
            continue;
        }
        pending.push_str(line.trim());
        if pending.ends_with('\\') {
            pending.pop();
            continue;
        }
        let command = pending.split(" #").next().unwrap().trim().to_owned();
        if !command.is_empty() {
            found.push(command);
        }
        pending.clear();
    }
    found
}

/// The words of a command as a shell takes them, double quotes being the only ones in use.
fn words(command: &str) -> Vec<String> {
    let parts = command.split('"').enumerate().flat_map(|(number, part)| match number % 2 {
        0 => part.split_whitespace().map(str::to_owned).collect(),
        _ => vec![part.to_owned()],
    });
    parts.collect()
}

#[test]
fn every_terrafarm_command_in_the_documents_is_understood() {
    for document in ["README.md", "CONTRIBUTING.md"] {
        for command in commands_in(document) {
            let Some(arguments) = command
                .strip_prefix("terrafarm ")
                .or_else(|| command.strip_prefix("cargo run --release -- "))
            else {
                continue;
            };
            // Unknown commands and flags are refused before help is shown.
            let words = words(arguments);
            let mut help = crate::support::terrafarm();
            let result = help.args(&words).arg("--help").output().unwrap();
            let said = String::from_utf8_lossy(&result.stderr);
            assert!(result.status.success(), "{document}: {command}\n{said}");
        }
    }
}

#[test]
fn the_test_command_of_the_readme_is_the_one_that_ci_runs() {
    let ci = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(".ci/run")).unwrap();
    let tests =
        commands_in("README.md").into_iter().find(|command| command.starts_with("cargo test"));
    let tests = tests.expect("the README says how to run the tests");
    assert!(ci.contains(&tests), "{tests}");
}
