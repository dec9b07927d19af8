//! Where this PC keeps the farm token, and what follows from there being one.
//!
//! The token comes from `--token-file`, else from the variable `TERRAFARM_TOKEN`, else from
//! the file of `terrafarm token`. Where there is none, links are plain and stay on this PC.
//! It never stands on a command line that others could list, nor in a log.

use crate::args::serve::Security;
use anyhow::{Context, bail};
use std::fs::File;
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use terrafarm_wire::link::{FarmToken, Trust};

/// Carries the token itself.
pub const VARIABLE: &str = "TERRAFARM_TOKEN";
/// Longest token file that is read, bytes.
const FILE_BYTES_MAX: u64 = 4096;

/// Where a token was found.
pub enum Source {
    /// In this file.
    File(PathBuf),
    /// In [`VARIABLE`].
    Variable,
}

/// How a coordinator knows its peers. One that others can reach, and only that, makes a
/// token where there is none.
pub fn to_serve(security: &Security, reachable: bool) -> anyhow::Result<(Trust, Option<Source>)> {
    if security.plain {
        return Ok((Trust::Network, None));
    }
    if let Some((token, source)) = find(security)? {
        return Ok((Trust::Token(token), Some(source)));
    }
    let path = match &security.token_file {
        Some(path) => path.clone(),
        None if reachable => default_file()?,
        None => return Ok((Trust::Loopback, None)),
    };
    Ok((Trust::Token(make(&path)?), Some(Source::File(path))))
}

/// How a worker or a render knows its coordinator.
pub fn to_connect(security: &Security) -> anyhow::Result<Trust> {
    if security.plain {
        return Ok(Trust::Network);
    }
    match (find(security)?, &security.token_file) {
        (Some((token, _)), _) => Ok(Trust::Token(token)),
        (None, Some(path)) => bail!(
            "{}: there is no such token file; copy the coordinator's, or enter its token with \
             \"terrafarm token --enter --token-file {}\"",
            path.display(),
            path.display()
        ),
        (None, None) => Ok(Trust::Loopback),
    }
}

/// The token that there is.
fn find(security: &Security) -> anyhow::Result<Option<(FarmToken, Source)>> {
    if let Some(path) = &security.token_file {
        return Ok(read(path)?.map(|token| (token, Source::File(path.clone()))));
    }
    if let Some(text) = std::env::var_os(VARIABLE) {
        let text = text.to_string_lossy();
        let token = text.parse().with_context(|| format!("the variable {VARIABLE} is no token"))?;
        return Ok(Some((token, Source::Variable)));
    }
    // A user without such a folder has no token in it.
    let Ok(path) = default_file() else { return Ok(None) };
    Ok(read(&path)?.map(|token| (token, Source::File(path))))
}

/// The file of `terrafarm token`.
pub fn default_file() -> anyhow::Result<PathBuf> {
    let folder = dirs::config_dir().context(
        "this user has no configuration folder to keep the farm token in; name a --token-file",
    )?;
    Ok(folder.join("terrafarm").join("farm.token"))
}

/// The token of a file; `None` if there is no file.
pub fn read(path: &Path) -> anyhow::Result<Option<FarmToken>> {
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
    };
    warn_if_others_read(path, &file);
    let mut text = String::new();
    file.take(FILE_BYTES_MAX)
        .read_to_string(&mut text)
        .with_context(|| format!("cannot read {}", path.display()))?;
    let token = text.parse().with_context(|| format!("{} holds no farm token", path.display()))?;
    Ok(Some(token))
}

/// A new token in a new file.
pub fn make(path: &Path) -> anyhow::Result<FarmToken> {
    let token = FarmToken::generate()?;
    match keep(path, &token) {
        Ok(()) => Ok(token),
        // Another process was faster: its token is the farm's.
        Err(error) if is_there_already(&error) => match read(path)? {
            Some(token) => Ok(token),
            None => Err(error),
        },
        Err(error) => Err(error),
    }
}

fn is_there_already(error: &anyhow::Error) -> bool {
    let io = error.chain().find_map(|cause| cause.downcast_ref::<std::io::Error>());
    io.is_some_and(|io| io.kind() == ErrorKind::AlreadyExists)
}

/// Writes a token to a file that does not exist yet and that nobody else may read. It
/// appears whole or not at all.
pub fn keep(path: &Path, token: &FarmToken) -> anyhow::Result<()> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let write = || {
        std::fs::create_dir_all(folder)?;
        // Such files are made for their owner alone.
        let mut file = tempfile::NamedTempFile::new_in(folder)?;
        writeln!(file, "{}", token.to_text())?;
        file.as_file().sync_all()?;
        file.persist_noclobber(path)?;
        Ok(())
    };
    write().map_err(|error: std::io::Error| {
        anyhow::Error::new(error)
            .context(format!("cannot keep the farm token in {}", path.display()))
    })
}

#[cfg(unix)]
fn warn_if_others_read(path: &Path, file: &File) {
    use std::os::unix::fs::PermissionsExt;
    let mode = file.metadata().map_or(0, |data| data.permissions().mode());
    if mode & 0o077 != 0 {
        let path = path.display();
        eprintln!(
            "terrafarm: warning: other users of this PC can read the farm token; say: chmod 600 {path}"
        );
    }
}

/// Who may read a file is inherited from the user's folder here.
#[cfg(not(unix))]
fn warn_if_others_read(_path: &Path, _file: &File) {}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_token_is_made_once_kept_for_its_owner_and_read_again() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("new/farm.token");
        assert!(read(&path).unwrap().is_none());
        let token = make(&path).unwrap();
        assert_eq!(make(&path).unwrap().to_text(), token.to_text(), "the one that is there");
        assert_eq!(read(&path).unwrap().unwrap().to_text(), token.to_text());
        let again = keep(&path, &FarmToken::generate().unwrap()).unwrap_err();
        assert!(is_there_already(&again), "{again:#}");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let mode = std::fs::metadata(&path).unwrap().permissions().mode();
            assert_eq!(mode & 0o777, 0o600);
        }
    }

    #[test]
    fn a_file_that_holds_no_token_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("farm.token");
        std::fs::write(&path, "secret").unwrap();
        let error = format!("{:#}", read(&path).unwrap_err());
        assert!(error.contains("farm.token") && !error.contains("secret"), "{error}");
    }
}
