//! What the queue asks of a disk: room, the lock of its folder, words for its errors.

use super::QueueError;
use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind, Read, Seek, Write};
use std::path::Path;

/// The error of a file system, on a path; a full disk has an error of its own.
pub fn error(queue: &Path, what: &'static str, path: &Path, source: &io::Error) -> QueueError {
    match source.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => full(queue, 1),
        _ => QueueError::Io { what, path: path.to_path_buf(), why: source.to_string() },
    }
}

/// The disk is full; so many bytes more are needed, at least.
pub fn full(queue: &Path, needed_bytes: u64) -> QueueError {
    QueueError::DiskFull { folder: queue.to_path_buf(), needed_bytes: needed_bytes.max(1) }
}

/// Fails if writing so many bytes would leave less than the reserve.
pub fn has_room(queue: &Path, reserve_bytes: u64, bytes: u64) -> Result<(), QueueError> {
    let wanted = reserve_bytes.saturating_add(bytes);
    match free_bytes(queue) {
        Some(free) if free < wanted => Err(full(queue, wanted - free)),
        // Where nobody says how much is free, writing will show.
        _ => Ok(()),
    }
}

/// Bytes that may still be written in a folder, where the system says so.
#[cfg(unix)]
pub fn free_bytes(folder: &Path) -> Option<u64> {
    let stat = rustix::fs::statvfs(folder).ok()?;
    Some(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Bytes that may still be written in a folder, where the system says so.
#[cfg(not(unix))]
pub fn free_bytes(_folder: &Path) -> Option<u64> {
    None
}

/// Writes a little into a folder, which is made if it is not there, and removes it again.
///
/// # Errors
/// If the folder takes no files.
pub fn probe(queue: &Path, folder: &Path) -> Result<(), QueueError> {
    // A name that is tidied up should this be cut off.
    let path = folder.join("probe.partial.");
    fs::create_dir_all(folder)
        .and_then(|()| File::create(&path))
        .and_then(|mut file| file.write_all(b"x").and_then(|()| file.sync_all()))
        .and_then(|()| fs::remove_file(&path))
        .map_err(|why| error(queue, "write into", folder, &why))
}

/// Makes the names in a folder survive a power cut, where the system can.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}

/// Holds a folder for one coordinator; the system lets go of it however the process ends.
#[derive(Debug)]
pub struct FolderLock {
    _file: File,
}

impl FolderLock {
    /// Makes the folder and locks it.
    ///
    /// # Errors
    /// If another process holds it, or it cannot be made.
    pub fn take(folder: &Path) -> Result<Self, QueueError> {
        fs::create_dir_all(folder).map_err(|why| error(folder, "make the folder", folder, &why))?;
        let path = folder.join("lock");
        let wrong = |what| move |why: io::Error| error(folder, what, &folder.join("lock"), &why);
        let mut options = File::options();
        options.read(true).write(true).create(true).truncate(false);
        let mut file = options.open(&path).map_err(wrong("open"))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut text = String::new();
                // Where a lock also keeps others from reading, nobody knows.
                let read = (&file).take(32).read_to_string(&mut text);
                let pid = read.ok().and_then(|_| text.trim().parse().ok());
                return Err(QueueError::Locked { folder: folder.to_path_buf(), pid });
            }
            Err(TryLockError::Error(why)) => return Err(wrong("lock")(why)),
        }
        // Only for people: the lock counts, not what is written. A full disk is no reason
        // not to start.
        let written = file
            .set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| writeln!(file, "{}", std::process::id()));
        if let Err(why) = written {
            tracing::debug!("the process number cannot be noted: {why}");
        }
        Ok(FolderLock { _file: file })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_held_once_and_the_second_is_told_by_whom() {
        let folder = tempfile::tempdir().expect("a folder");
        let held = FolderLock::take(folder.path()).expect("free");
        let refused = FolderLock::take(folder.path()).expect_err("taken");
        let ours = Some(std::process::id());
        assert!(matches!(&refused, QueueError::Locked { pid, .. } if *pid == ours), "{refused}");
        drop(held);
        FolderLock::take(folder.path()).expect("free again");
    }

    #[test]
    fn a_reserve_that_is_not_there_is_a_full_disk() {
        let folder = tempfile::tempdir().expect("a folder");
        has_room(folder.path(), 0, 1).expect("room for a byte");
        if free_bytes(folder.path()).is_some() {
            let full = has_room(folder.path(), u64::MAX, 1).expect_err("no disk is so large");
            assert!(matches!(full, QueueError::DiskFull { .. }));
        }
    }
}
