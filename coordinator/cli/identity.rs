//! A number of this PC, by which a coordinator knows it again whatever its worker is called.
//!
//! 128 random bits lie in the folder of the tile cache; what is sent is a digest of them and
//! of the PC's name, since PCs may share that folder, as homes on a file server do. Nobody
//! proves it and nothing is let in by it: a coordinator that has found wrong pixels uses it
//! to tell the PC whose memory fails from others.

use anyhow::{Context, bail};
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io::{ErrorKind, Read, Write};
use std::path::Path;

/// The file.
const NAME: &str = "pc-number";
/// What it holds: hexadecimal digits.
const DIGITS: usize = 32;

/// The number of the PC of this name; 0 if none can be kept in that folder.
pub fn of_this_pc(folder: &Path, pc: &str) -> u128 {
    match kept(folder) {
        Ok(drawn) => digest(&drawn, pc),
        Err(why) => {
            tracing::info!("this PC is known by its name and address alone: {why:#}");
            0
        }
    }
}

fn digest(drawn: &str, pc: &str) -> u128 {
    let digest = Sha256::new().chain_update(drawn).chain_update(pc).finalize();
    let (halves, _) = digest.as_chunks::<16>();
    u128::from_be_bytes(halves[0])
}

/// The random digits of a folder; new ones if it has none.
fn kept(folder: &Path) -> anyhow::Result<String> {
    let path = folder.join(NAME);
    if let Some(there) = read(&path)? {
        return Ok(there);
    }
    let mut drawn = [0; DIGITS / 2];
    getrandom::fill(&mut drawn).context("the operating system gives no random numbers")?;
    fs::create_dir_all(folder)?;
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    write!(file, "{:0DIGITS$x}", u128::from_be_bytes(drawn))?;
    match file.persist_noclobber(&path) {
        Ok(_) => {}
        // Another worker was faster: its number is the one.
        Err(error) if error.error.kind() == ErrorKind::AlreadyExists => {}
        Err(error) => return Err(error.error.into()),
    }
    read(&path)?.with_context(|| format!("{} is gone again", path.display()))
}

fn read(path: &Path) -> anyhow::Result<Option<String>> {
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
    };
    let mut text = String::new();
    file.take(DIGITS as u64 + 1).read_to_string(&mut text)?;
    if text.len() != DIGITS || !text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        bail!("{} is not what a worker has written; remove it", path.display());
    }
    Ok(Some(text))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn a_pc_keeps_its_number_and_pcs_that_share_a_folder_have_different_ones() {
        let folder = tempfile::tempdir().unwrap();
        let shared = folder.path().join("tiles");
        let number = of_this_pc(&shared, "pc-1");
        assert!(number != 0 && of_this_pc(&shared, "pc-1") == number);
        assert_ne!(of_this_pc(&shared, "pc-2"), number);
        assert_ne!(of_this_pc(&folder.path().join("other"), "pc-1"), number);
    }

    #[test]
    fn what_else_lies_there_is_no_number_and_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(NAME);
        for text in ["", "17", &"x".repeat(DIGITS), &"1".repeat(DIGITS + 1)] {
            fs::write(&path, text).unwrap();
            assert_eq!(of_this_pc(folder.path(), "pc-1"), 0);
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
    }
}
