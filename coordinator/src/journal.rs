//! The file of a farm's journal: every event of its scheduler, to be replayed by
//! `terrafarm simulate --replay`.
//!
//! A coordinator that starts again writes a new file beside the old one: what it decides
//! has nothing to do with what was decided before. [`terrafarm_sched::journal`] has the
//! format.

use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use terrafarm_sched::Config;
use terrafarm_sched::journal::{JOURNAL_BYTES, Recorder, Stopped};

/// The highest number that is tried for a journal's file.
const NUMBER_MAX: u32 = 9999;

/// A journal that is being written.
pub type Journal = Recorder<File>;

/// Why a journal cannot be begun.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// The file cannot be made.
    #[error("cannot make the journal {}: {why}; is its folder there?", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What the system said.
        why: io::Error,
    },
    /// There are too many.
    #[error(
        "{} and its successors up to number {NUMBER_MAX} are there already; move them away, or \
         name another file with --journal", path.display()
    )]
    TooMany {
        /// The file that was asked for.
        path: PathBuf,
    },
    /// Its beginning cannot be written.
    #[error("{}: {why}", path.display())]
    Begin {
        /// The file.
        path: PathBuf,
        /// Why.
        why: Stopped,
    },
}

/// Begins a journal of a scheduler with these settings in a file of this name. A file that
/// is there stays as it is: then the name gets a number, `night-2.journal`. Returns the
/// name as well.
///
/// # Errors
/// If no such file can be made or written.
pub fn begin(path: &Path, config: &Config, seed: u64) -> Result<(Journal, PathBuf), JournalError> {
    for number in 1..=NUMBER_MAX {
        let path = numbered(path, number);
        let file = match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
            Err(why) => return Err(JournalError::File { path, why }),
        };
        return match Recorder::begin(file, config, seed, JOURNAL_BYTES) {
            Ok(journal) => Ok((journal, path)),
            Err(why) => Err(JournalError::Begin { path, why }),
        };
    }
    Err(JournalError::TooMany { path: path.to_owned() })
}

/// `night.journal`, `night-2.journal`, `night-3.journal`
fn numbered(path: &Path, number: u32) -> PathBuf {
    let Some(stem) = path.file_stem().filter(|_| number > 1) else { return path.to_owned() };
    let mut name = OsString::from(stem);
    name.push(format!("-{number}"));
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_journal_that_is_there_is_not_written_over() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("night.journal");
        let config = Config::default();
        let names: Vec<_> = (0..3).map(|_| begin(&path, &config, 1).expect("begins").1).collect();
        let expected = ["night.journal", "night-2.journal", "night-3.journal"];
        assert_eq!(names, expected.map(|name| dir.path().join(name)));
        for name in names {
            assert!(name.metadata().expect("is there").len() > 8, "the settings are written");
        }
    }

    #[test]
    fn a_journal_without_a_folder_says_so() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("nowhere/night");
        let error = begin(&path, &Config::default(), 1).expect_err("no folder");
        assert!(error.to_string().contains("is its folder there"), "{error}");
    }
}
