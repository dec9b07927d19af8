//! A file that appears whole or not at all.

use super::SinkError;
use std::fs::{self, File};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Written under a hidden name in the same folder; [`Beside::commit`] syncs it and moves
/// it into place, over what may be there. Dropped before that, it is removed.
#[derive(Debug)]
pub(super) struct Beside {
    target: PathBuf,
    temporary: PathBuf,
    file: Option<BufWriter<File>>,
}

impl Beside {
    /// Opens the file, and makes the folders that lead to it.
    pub fn create(target: &Path) -> Result<Self, SinkError> {
        let temporary = reserve(target)?;
        let file = File::create_new(&temporary)
            .map_err(|error| SinkError::io("create", &temporary, error))?;
        let file = Some(BufWriter::with_capacity(1 << 20, file));
        Ok(Beside { target: target.to_path_buf(), temporary, file })
    }

    /// A place for another program to write to.
    pub fn for_program(target: &Path) -> Result<Self, SinkError> {
        let temporary = reserve(target)?;
        Ok(Beside { target: target.to_path_buf(), temporary, file: None })
    }

    /// Where the bytes are until they are all there.
    pub fn temporary(&self) -> &Path {
        &self.temporary
    }

    /// Where the file is going to be.
    pub fn target(&self) -> &Path {
        &self.target
    }

    /// Appends bytes.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), SinkError> {
        let written = self.writer().and_then(|file| file.write_all(bytes));
        written.map_err(|error| SinkError::io("write", &self.target, error))
    }

    /// Replaces bytes that were written before; what follows is appended again.
    pub fn overwrite(&mut self, at: u64, bytes: &[u8]) -> Result<(), SinkError> {
        let written = self.writer().and_then(|file| {
            file.seek(SeekFrom::Start(at))?;
            file.write_all(bytes)?;
            file.seek(SeekFrom::End(0)).map(|_| ())
        });
        written.map_err(|error| SinkError::io("write", &self.target, error))
    }

    /// Syncs the file, gives it its name, and returns its size in bytes.
    pub fn commit(mut self) -> Result<u64, SinkError> {
        let bytes = self.settle().map_err(|error| SinkError::io("write", &self.target, error))?;
        fs::rename(&self.temporary, &self.target)
            .map_err(|error| SinkError::io("rename the finished file to", &self.target, error))?;
        sync_folder(&self.target);
        Ok(bytes)
    }

    fn writer(&mut self) -> io::Result<&mut BufWriter<File>> {
        self.file.as_mut().ok_or_else(|| io::Error::other("another program writes this file"))
    }

    fn settle(&mut self) -> io::Result<u64> {
        let file = match self.file.take() {
            Some(file) => file.into_inner().map_err(|error| error.into_error())?,
            None => File::options().write(true).open(&self.temporary)?,
        };
        file.sync_all()?;
        Ok(file.metadata()?.len())
    }
}

impl Drop for Beside {
    fn drop(&mut self) {
        // An open file cannot be removed everywhere. What is buffered need not be written.
        if let Some(file) = self.file.take() {
            drop(file.into_parts());
        }
        // After a commit there is nothing under this name; and nobody to tell otherwise.
        let _ = fs::remove_file(&self.temporary);
    }
}

/// A free name in the folder of the target. Two programs may write the same output.
fn reserve(target: &Path) -> Result<PathBuf, SinkError> {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let Some(name) = target.file_name() else {
        return Err(SinkError::output(target, "it names no file"));
    };
    let folder = folder_of(target);
    fs::create_dir_all(folder).map_err(|error| SinkError::io("make the folder", folder, error))?;
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    let mut hidden = std::ffi::OsString::from(format!(".{}-{count}.partial.", std::process::id()));
    // The ending stays last: ffmpeg chooses the container by it.
    hidden.push(name);
    Ok(folder.join(hidden))
}

fn folder_of(target: &Path) -> &Path {
    match target.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// Makes the new name survive a power cut. Not every file system allows it, and the file
/// itself is safe already.
fn sync_folder(target: &Path) {
    if cfg!(unix) {
        let _ = File::open(folder_of(target)).and_then(|folder| folder.sync_all());
    }
}
