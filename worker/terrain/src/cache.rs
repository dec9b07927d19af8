//! Blobs on a worker's disk, so that a second start or a second worker on the same PC
//! fetches nothing twice.
//!
//! One folder, one file a blob, named by its hash in 64 hexadecimal digits. Files appear
//! whole (written beside, renamed) and are checked against their name when read, so the
//! folder may be shared by any number of processes, killed at any instruction, or
//! tampered with; other files in it are left alone. The time of last use is the file's
//! modification time, so that all processes agree on what is oldest.
//!
//! Each process counts what it adds; before that could exceed the limit, or after a
//! sixteenth of the limit was added, it looks at the folder anew. With n processes the
//! folder is thus at most n/16 of the limit too large, for a short time.

use crate::store::hash_of;
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};
use terrafarm_common::id::BlobHash;

/// Age at which an unfinished file is taken for what a killed process left.
const ABANDONED: Duration = Duration::from_secs(3600);
/// Share of the limit that is freed beyond need when blobs are removed, so that not every
/// new blob costs a look at the folder.
const SLACK: u64 = 16;

/// Why a blob could not be kept. Rendering goes on without.
#[derive(Debug, thiserror::Error)]
pub enum CacheError {
    /// The operating system refused.
    #[error("cannot use the tile cache {}: {source}; is there space, and may this user write there?", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The bytes are not what their hash says.
    #[error("blob {hash} does not fit its hash; it was not kept")]
    WrongHash {
        /// The hash that was given.
        hash: BlobHash,
    },
}

/// A folder of blobs of limited size.
#[derive(Debug)]
pub struct BlobCache {
    folder: PathBuf,
    limit_bytes: u64,
    account: Mutex<Account>,
    /// Size of all blobs when the folder was last looked at, and of those added since;
    /// changed by whoever holds the account, read without waiting for it.
    total_bytes: AtomicU64,
    damaged: AtomicU64,
}

#[derive(Debug, Default)]
struct Account {
    /// Size of the blobs added since the folder was last looked at.
    added_bytes: u64,
    /// The last time that was given to a file: times are handed out in strict order.
    last_use: Option<SystemTime>,
}

struct Kept {
    path: PathBuf,
    bytes: u64,
    last_use: SystemTime,
}

impl BlobCache {
    /// Opens a cache, making its folder if there is none, and brings it within the limit.
    ///
    /// # Errors
    /// If the folder cannot be made or read.
    pub fn open(folder: &Path, limit_bytes: u64) -> Result<BlobCache, CacheError> {
        fs::create_dir_all(folder).map_err(|source| io_error(folder, source))?;
        let cache = BlobCache {
            folder: folder.to_owned(),
            limit_bytes,
            account: Mutex::default(),
            total_bytes: AtomicU64::new(0),
            damaged: AtomicU64::new(0),
        };
        cache.trim(&mut cache.lock())?;
        Ok(cache)
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The most that all blobs may take, bytes.
    pub fn limit_bytes(&self) -> u64 {
        self.limit_bytes
    }

    /// Size of all blobs as this process knows it, bytes. Never waits for the disk.
    pub fn total_bytes(&self) -> u64 {
        self.total_bytes.load(Ordering::Relaxed)
    }

    /// Blobs that were found damaged.
    pub fn damaged(&self) -> u64 {
        self.damaged.load(Ordering::Relaxed)
    }

    /// A blob, if it is here and sound. A damaged one is removed.
    pub fn get(&self, hash: &BlobHash) -> Option<Vec<u8>> {
        let path = self.path_of(hash);
        let file = File::open(&path).ok()?;
        let length = file.metadata().ok()?.len();
        let mut bytes = Vec::new();
        let whole = length <= self.limit_bytes
            && file.take(self.limit_bytes).read_to_end(&mut bytes).ok()? as u64 == length;
        if !whole || hash_of(&bytes) != *hash {
            self.damaged.fetch_add(1, Ordering::Relaxed);
            // Another process may have put a sound one in its place meanwhile; it will be
            // fetched again, which is harmless.
            if fs::remove_file(&path).is_ok() {
                let _account = self.lock();
                let total = self.total_bytes().saturating_sub(length);
                self.total_bytes.store(total, Ordering::Relaxed);
            }
            return None;
        }
        // Without the right to change times the cache still works, by age.
        let _ = touch(&path, self.next_use());
        Some(bytes)
    }

    /// Length of a blob that is here, bytes, as far as one can tell without reading it.
    pub fn length(&self, hash: &BlobHash) -> Option<u64> {
        fs::metadata(self.path_of(hash)).ok().filter(|there| there.is_file()).map(|it| it.len())
    }

    /// Whether a blob is here, as far as one can tell without reading it. It counts as used.
    pub fn holds(&self, hash: &BlobHash) -> bool {
        self.length(hash).is_some() && touch(&self.path_of(hash), self.next_use()).is_ok()
    }

    /// Keeps a blob, removing those unused longest if space is needed. One that is larger
    /// than the limit is not kept, which is no error.
    ///
    /// # Errors
    /// If the bytes do not fit the hash, or the disk refuses.
    pub fn put(&self, hash: &BlobHash, bytes: &[u8]) -> Result<(), CacheError> {
        if hash_of(bytes) != *hash {
            return Err(CacheError::WrongHash { hash: *hash });
        }
        let length = bytes.len() as u64;
        if length > self.limit_bytes {
            return Ok(());
        }
        let path = self.path_of(hash);
        if fs::metadata(&path).is_ok_and(|there| there.len() == length) {
            let _ = touch(&path, self.next_use());
            return Ok(());
        }
        self.write(&path, hash, bytes)?;
        let mut account = self.lock();
        let total = self.total_bytes.fetch_add(length, Ordering::Relaxed) + length;
        account.added_bytes += length;
        let unsure = account.added_bytes > self.limit_bytes / SLACK;
        if total > self.limit_bytes || unsure {
            self.trim(&mut account)?;
        }
        Ok(())
    }

    fn write(&self, path: &Path, hash: &BlobHash, bytes: &[u8]) -> Result<(), CacheError> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let name = format!("{}.{}-{count}.part", hash.to_hex(), std::process::id());
        let part = self.folder.join(name);
        let last_use = self.next_use();
        let written = File::create(&part).and_then(|mut file| {
            file.write_all(bytes)?;
            file.set_modified(last_use)?;
            drop(file);
            fs::rename(&part, path)
        });
        written.map_err(|source| {
            let _ = fs::remove_file(&part);
            io_error(&part, source)
        })
    }

    /// Looks at the folder and removes the blobs unused longest until the rest fits with
    /// some slack. Files that vanish meanwhile were removed by another process.
    fn trim(&self, account: &mut Account) -> Result<(), CacheError> {
        let mut kept = self.scan()?;
        let mut total = kept.iter().map(|blob| blob.bytes).sum();
        self.total_bytes.store(total, Ordering::Relaxed);
        account.added_bytes = 0;
        account.last_use = account.last_use.max(kept.iter().map(|blob| blob.last_use).max());
        if total <= self.limit_bytes {
            return Ok(());
        }
        let goal = self.limit_bytes - self.limit_bytes / SLACK;
        kept.sort_by(|a, b| a.last_use.cmp(&b.last_use).then_with(|| a.path.cmp(&b.path)));
        // The newest stays even if it alone fills the cache: it was just asked for.
        kept.pop();
        for blob in kept {
            if total <= goal {
                break;
            }
            match fs::remove_file(&blob.path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    return Err(io_error(&blob.path, error));
                }
                _ => total -= blob.bytes,
            }
            self.total_bytes.store(total, Ordering::Relaxed);
        }
        Ok(())
    }

    /// All blobs of the folder; unfinished files that were abandoned are removed.
    fn scan(&self) -> Result<Vec<Kept>, CacheError> {
        let mut kept = Vec::new();
        let entries = fs::read_dir(&self.folder).map_err(|e| io_error(&self.folder, e))?;
        for entry in entries.flatten() {
            let name = entry.file_name();
            let Some((hash, rest)) = name.to_str().and_then(|name| name.split_at_checked(64))
            else {
                continue;
            };
            let Ok(metadata) = entry.metadata() else { continue };
            if !metadata.is_file() || !hash.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
            {
                continue;
            }
            let last_use = metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH);
            if rest.is_empty() {
                kept.push(Kept { path: entry.path(), bytes: metadata.len(), last_use });
            } else if rest.ends_with(".part") && last_use.elapsed().is_ok_and(|age| age > ABANDONED)
            {
                let _ = fs::remove_file(entry.path());
            }
        }
        Ok(kept)
    }

    fn path_of(&self, hash: &BlobHash) -> PathBuf {
        self.folder.join(hash.to_hex())
    }

    /// The present, but later than any time handed out before: uses keep their order even
    /// within one tick of the clock.
    fn next_use(&self) -> SystemTime {
        let mut account = self.lock();
        let now = SystemTime::now();
        let next = match account.last_use {
            // Windows counts in steps of 100 ns.
            Some(last) if last >= now => last + Duration::from_nanos(100),
            _ => now,
        };
        account.last_use = Some(next);
        next
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Account> {
        self.account.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn touch(path: &Path, last_use: SystemTime) -> io::Result<()> {
    File::options().write(true).open(path)?.set_modified(last_use)
}

fn io_error(path: &Path, source: io::Error) -> CacheError {
    CacheError::Io { path: path.to_owned(), source }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn blob(number: u8, length: usize) -> (BlobHash, Vec<u8>) {
        let bytes = vec![number; length];
        (hash_of(&bytes), bytes)
    }

    fn cache(limit_bytes: u64) -> (tempfile::TempDir, BlobCache) {
        let folder = tempfile::tempdir().unwrap();
        let cache = BlobCache::open(&folder.path().join("tiles"), limit_bytes).unwrap();
        (folder, cache)
    }

    fn bytes_on_disk(cache: &BlobCache) -> u64 {
        let entries = fs::read_dir(cache.folder()).unwrap();
        entries.map(|entry| entry.unwrap().metadata().unwrap().len()).sum()
    }

    #[test]
    fn blobs_come_back_and_survive_a_new_start() {
        let (_folder, cache) = cache(1000);
        let (hash, bytes) = blob(1, 100);
        assert_eq!(cache.get(&hash), None);
        cache.put(&hash, &bytes).unwrap();
        cache.put(&hash, &bytes).unwrap();
        assert_eq!(cache.get(&hash), Some(bytes.clone()));
        assert_eq!(cache.total_bytes(), 100);
        let again = BlobCache::open(cache.folder(), 1000).unwrap();
        assert_eq!(again.get(&hash), Some(bytes));
        assert_eq!(again.total_bytes(), 100);
    }

    #[test]
    fn the_blob_unused_longest_goes_first() {
        let (_folder, cache) = cache(1000);
        let blobs: Vec<_> = (0..10).map(|number| blob(number, 100)).collect();
        for (hash, bytes) in &blobs {
            cache.put(hash, bytes).unwrap();
        }
        assert_eq!(cache.total_bytes(), 1000);
        cache.get(&blobs[0].0).unwrap();
        let (hash, bytes) = blob(99, 100);
        cache.put(&hash, &bytes).unwrap();
        let kept: Vec<_> = (0..10).filter(|&n| cache.get(&blobs[n].0).is_some()).collect();
        assert_eq!(kept, [0, 3, 4, 5, 6, 7, 8, 9], "1 and 2 were oldest; 0 was used again");
        assert_eq!(cache.total_bytes(), bytes_on_disk(&cache));
    }

    #[test]
    fn the_order_of_use_survives_a_new_start_with_a_smaller_limit() {
        let (_folder, cache) = cache(1000);
        let blobs: Vec<_> = (0..6).map(|number| blob(number, 100)).collect();
        for (hash, bytes) in &blobs {
            cache.put(hash, bytes).unwrap();
        }
        cache.get(&blobs[1].0).unwrap();
        let smaller = BlobCache::open(cache.folder(), 220).unwrap();
        let kept: Vec<_> = (0..6).filter(|&n| smaller.get(&blobs[n].0).is_some()).collect();
        assert_eq!(kept, [1, 5]);
    }

    #[test]
    fn a_damaged_blob_is_absent_and_removed() {
        let (_folder, cache) = cache(1000);
        let (hash, bytes) = blob(1, 100);
        cache.put(&hash, &bytes).unwrap();
        let path = cache.folder().join(hash.to_hex());
        for damage in [vec![1; 99], vec![2; 100], vec![], vec![1; 5000]] {
            fs::write(&path, damage).unwrap();
            assert_eq!(cache.get(&hash), None);
            assert!(!path.exists());
        }
        assert_eq!(cache.damaged(), 4);
        cache.put(&hash, &bytes).unwrap();
        assert_eq!(cache.get(&hash), Some(bytes));
    }

    #[test]
    fn a_blob_that_does_not_fit_its_hash_is_refused() {
        let (_folder, cache) = cache(1000);
        let error = cache.put(&BlobHash([3; 32]), b"something").unwrap_err();
        assert!(matches!(error, CacheError::WrongHash { .. }));
        assert_eq!(bytes_on_disk(&cache), 0);
    }

    #[test]
    fn a_blob_larger_than_the_limit_is_not_kept_and_one_just_as_large_is() {
        let (_folder, cache) = cache(100);
        let (too_large, bytes) = blob(1, 101);
        cache.put(&too_large, &bytes).unwrap();
        assert_eq!(cache.get(&too_large), None);
        for number in 2..4 {
            let (fitting, bytes) = blob(number, 100);
            cache.put(&fitting, &bytes).unwrap();
            assert_eq!(cache.get(&fitting), Some(bytes));
            assert_eq!(bytes_on_disk(&cache), 100);
        }
    }

    #[test]
    fn two_caches_on_one_folder_share_blobs_and_the_limit() {
        let (_folder, first) = cache(3200);
        let second = BlobCache::open(first.folder(), 3200).unwrap();
        for number in 0..100 {
            let (hash, bytes) = blob(number, 100);
            let (writer, reader) =
                if number % 2 == 0 { (&first, &second) } else { (&second, &first) };
            writer.put(&hash, &bytes).unwrap();
            assert_eq!(reader.get(&hash), Some(bytes));
            assert!(bytes_on_disk(&first) <= 3200 + 2 * 3200 / SLACK + 100);
        }
    }

    #[test]
    fn many_threads_on_two_caches_never_see_a_wrong_blob() {
        let (_folder, first) = cache(2000);
        let second = BlobCache::open(first.folder(), 2000).unwrap();
        std::thread::scope(|scope| {
            for thread in 0..4u8 {
                let cache = if thread % 2 == 0 { &first } else { &second };
                scope.spawn(move || {
                    for round in 0..60u8 {
                        let (hash, bytes) = blob(round * 3 % 25 + thread, 300);
                        cache.put(&hash, &bytes).unwrap();
                        assert!(cache.get(&hash).is_none_or(|found| found == bytes));
                    }
                });
            }
        });
    }

    #[test]
    fn foreign_files_are_left_alone_and_abandoned_ones_removed() {
        let (_folder, cache) = cache(100);
        let hash = blob(1, 1).0.to_hex();
        let foreign = ["notes.txt", &"g".repeat(64), &"é".repeat(40)];
        let abandoned = cache.folder().join(format!("{hash}.1234-0.part"));
        let recent = cache.folder().join(format!("{hash}.1234-1.part"));
        for name in foreign {
            fs::write(cache.folder().join(name), vec![0; 500]).unwrap();
        }
        fs::create_dir(cache.folder().join("a".repeat(64))).unwrap();
        fs::write(&abandoned, "half").unwrap();
        fs::write(&recent, "half").unwrap();
        touch(&abandoned, SystemTime::now() - 2 * ABANDONED).unwrap();
        let again = BlobCache::open(cache.folder(), 100).unwrap();
        assert_eq!(again.total_bytes(), 0);
        assert!(foreign.iter().all(|name| cache.folder().join(name).exists()));
        assert!(!abandoned.exists() && recent.exists());
    }
}
