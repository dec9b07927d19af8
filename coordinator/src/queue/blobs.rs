//! Terrain of the queue: one file a blob, named by its hash.
//!
//! A blob is checked when it comes and each time it is read: a damaged one is removed, so
//! that it counts as missing and is sent again. One that the disk does not read, and all
//! blobs of a store of which one was damaged, are suspect: they count as here when they have
//! been read from end to end, and what is sent takes their place. Blobs are synced when a shot
//! that needs them is taken, not one by one.

use super::{QueueConfig, QueueError, disk};
use bytes::Bytes;
use std::collections::HashSet;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;
use terrafarm_common::id::BlobHash;
use terrafarm_terrain::store::{decode_index, hash_of};
use terrafarm_wire::limits::BLOB_BYTES_MAX;

/// Most blobs that are suspect at once; of more, each shows when it is read.
const SUSPECTS_MAX: usize = 1 << 20;

/// The terrain of the queue.
#[derive(Debug)]
pub struct Blobs {
    config: Arc<QueueConfig>,
    folder: PathBuf,
    /// Those that came and are not yet known to be on the disk.
    unsynced: Mutex<HashSet<BlobHash>>,
    /// Those that are believed when they have been read.
    suspects: Mutex<HashSet<BlobHash>>,
    count: AtomicU64,
}

impl Blobs {
    /// In the folder of a queue.
    pub fn new(config: &Arc<QueueConfig>) -> Self {
        Blobs {
            config: config.clone(),
            folder: config.folder.join("blobs"),
            unsynced: Mutex::default(),
            suspects: Mutex::default(),
            count: AtomicU64::new(0),
        }
    }

    /// The folder of the queue.
    pub fn queue(&self) -> &Path {
        &self.config.folder
    }

    fn shelf(&self, hash: BlobHash) -> PathBuf {
        self.folder.join(&hash.to_hex()[..2])
    }

    fn path(&self, hash: BlobHash) -> PathBuf {
        let name = hash.to_hex();
        self.folder.join(&name[..2]).join(name)
    }

    fn error(&self, what: &'static str, path: &Path, why: &io::Error) -> QueueError {
        disk::error(&self.config.folder, what, path, why)
    }

    /// Fails if the disk has no more than the reserve.
    ///
    /// # Errors
    /// [`QueueError::DiskFull`].
    pub fn has_room(&self) -> Result<(), QueueError> {
        disk::has_room(&self.config.folder, self.config.reserve_bytes, 0)
    }

    /// Those that are not here; the others stay for the time of grace from now on. Reads
    /// those that are suspect.
    pub fn missing(&self, hashes: Vec<BlobHash>) -> Vec<BlobHash> {
        let now = SystemTime::now();
        hashes.into_iter().filter(|&hash| !self.touch(hash, now)).collect()
    }

    /// Marks a blob as used now; returns whether it is here.
    fn touch(&self, hash: BlobHash, now: SystemTime) -> bool {
        if self.suspects().contains(&hash) && !matches!(self.read(hash), Ok(Some(_))) {
            return false;
        }
        let file = File::options().append(true).open(self.path(hash));
        // One that cannot be marked is here all the same.
        file.map(|file| file.set_modified(now)).is_ok()
    }

    /// Keeps a blob.
    ///
    /// # Errors
    /// If it is not what it is called, too long, or there is no room.
    pub fn put(&self, hash: BlobHash, bytes: &[u8]) -> Result<(), QueueError> {
        if bytes.len() > BLOB_BYTES_MAX {
            let length = bytes.len();
            return Err(QueueError::Unfit(format!("a blob of {length} bytes is too long")));
        }
        let found = hash_of(bytes);
        if found != hash {
            return Err(QueueError::WrongBlob { expected: hash, found });
        }
        if self.touch(hash, SystemTime::now()) {
            return Ok(());
        }
        disk::has_room(&self.config.folder, self.config.reserve_bytes, bytes.len() as u64)?;
        let shelf = self.shelf(hash);
        fs::create_dir_all(&shelf).map_err(|why| self.error("make the folder", &shelf, &why))?;
        let count = self.count.fetch_add(1, Ordering::Relaxed);
        let beside = shelf.join(format!(".{}-{count}.partial", std::process::id()));
        let written = File::create(&beside)
            .and_then(|mut file| file.write_all(bytes))
            .and_then(|()| fs::rename(&beside, self.path(hash)));
        if let Err(why) = written {
            let _ = fs::remove_file(&beside);
            return Err(self.error("write", &self.path(hash), &why));
        }
        self.suspects().remove(&hash);
        self.unsynced().insert(hash);
        Ok(())
    }

    /// A blob; `None` if it is not here, or was damaged and is no longer.
    ///
    /// # Errors
    /// If the disk cannot read it: then it is suspect.
    pub fn read(&self, hash: BlobHash) -> Result<Option<Bytes>, QueueError> {
        let read = self.read_through(hash);
        match &read {
            Ok(_) => drop(self.suspects().remove(&hash)),
            Err(_) => self.suspect([hash]),
        }
        read
    }

    fn suspect(&self, hashes: impl IntoIterator<Item = BlobHash>) {
        let mut suspects = self.suspects();
        let room = SUSPECTS_MAX.saturating_sub(suspects.len());
        suspects.extend(hashes.into_iter().take(room));
    }

    /// A blob of this store was damaged: so may be others of the same disk. Whoever sends the
    /// terrain again is to be asked for all of them at once.
    ///
    /// # Errors
    /// If its index cannot be read: that comes first then.
    pub fn suspect_store(&self, index: BlobHash) -> Result<(), QueueError> {
        let all = self.store(index)?;
        self.suspect(all.into_iter().map(|(hash, _)| hash));
        Ok(())
    }

    fn read_through(&self, hash: BlobHash) -> Result<Option<Bytes>, QueueError> {
        let path = self.path(hash);
        let wrong = |why: &io::Error| self.error("read", &path, why);
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(why) if why.kind() == ErrorKind::NotFound => return Ok(None),
            Err(why) => return Err(wrong(&why)),
        };
        let mut bytes = Vec::new();
        let limit = BLOB_BYTES_MAX as u64 + 1;
        file.take(limit).read_to_end(&mut bytes).map_err(|why| wrong(&why))?;
        if hash_of(&bytes) == hash {
            return Ok(Some(bytes.into()));
        }
        tracing::warn!(%hash, "a blob of terrain is damaged on the disk; it has to be sent again");
        fs::remove_file(&path).map_err(|why| self.error("remove", &path, &why))?;
        Ok(None)
    }

    /// The hashes of all blobs of a store, its index first, and their lengths in bytes.
    ///
    /// # Errors
    /// [`QueueError::Missing`] if its index is not here, [`QueueError::Unfit`] if it is
    /// none.
    pub fn store(&self, index: BlobHash) -> Result<Vec<(BlobHash, u64)>, QueueError> {
        let bytes = self.read(index)?.ok_or_else(|| QueueError::Missing(vec![index]))?;
        let unfit = |why| QueueError::Unfit(format!("{index} is no index of terrain: {why}"));
        let store = decode_index(&bytes).map_err(unfit)?;
        let levels = store.layers.iter().flat_map(|layer| &layer.levels);
        let tiles = levels.flat_map(|level| &level.entries).filter(|tile| !tile.is_empty());
        let tiles = tiles.map(|tile| (tile.hash, u64::from(tile.length)));
        Ok(std::iter::once((index, bytes.len() as u64)).chain(tiles).collect())
    }

    /// Makes sure that a store is here, all of it, and stays when the power fails.
    ///
    /// # Errors
    /// [`QueueError::Missing`] with what is not here.
    pub fn complete(&self, index: BlobHash) -> Result<(), QueueError> {
        let all = self.store(index)?;
        self.remove_torn(&all)?;
        let all: Vec<_> = all.into_iter().map(|(hash, _)| hash).collect();
        let missing = self.missing(all.clone());
        if !missing.is_empty() {
            return Err(QueueError::Missing(missing));
        }
        let unsynced: Vec<_> = {
            let unsynced = self.unsynced();
            all.into_iter().filter(|hash| unsynced.contains(hash)).collect()
        };
        let shelves: HashSet<_> = unsynced.iter().map(|&hash| self.shelf(hash)).collect();
        for &hash in &unsynced {
            let path = self.path(hash);
            let synced = File::options().append(true).open(&path).and_then(|file| file.sync_all());
            synced.map_err(|why| self.error("sync", &path, &why))?;
        }
        let folders = shelves.iter().map(PathBuf::as_path);
        for folder in folders.chain([self.folder.as_path()]) {
            disk::sync_folder(folder).map_err(|why| self.error("sync", folder, &why))?;
        }
        self.unsynced().retain(|hash| !unsynced.contains(hash));
        Ok(())
    }

    /// Removes blobs that are not as long as they should be: until a shot needs them they are
    /// not synced, and a power cut leaves their names and not what was in them.
    fn remove_torn(&self, blobs: &[(BlobHash, u64)]) -> Result<(), QueueError> {
        for &(hash, length) in blobs {
            let path = self.path(hash);
            if fs::metadata(&path).is_ok_and(|facts| facts.len() != length) {
                tracing::warn!(%hash, "a blob of terrain was never whole; it has to be sent again");
                fs::remove_file(&path).map_err(|why| self.error("remove", &path, &why))?;
            }
        }
        Ok(())
    }

    /// Removes what no unfinished shot needs and nobody asked for lately, the longest
    /// unused first, until the rest is within its limit and none of it is too old. Returns
    /// bytes removed.
    ///
    /// Of a shot whose index is damaged or gone nobody knows what it needs: its terrain counts
    /// as unused, since whoever sends the index again is asked for the rest, too.
    ///
    /// # Errors
    /// If the disk does not read the index of a store in use: then nothing is removed.
    pub fn sweep(&self, in_use: &HashSet<BlobHash>) -> Result<u64, QueueError> {
        let mut needed = HashSet::new();
        for &index in in_use {
            match self.store(index) {
                Ok(all) => needed.extend(all.into_iter().map(|(hash, _)| hash.to_hex())),
                Err(why @ (QueueError::Missing(_) | QueueError::Unfit(_))) => {
                    tracing::warn!(%index, "nobody knows what a shot needs of its terrain: {why}");
                }
                Err(why) => return Err(why),
            }
        }
        let now = SystemTime::now();
        let mut idle = Vec::new();
        let mut idle_bytes = 0;
        for shelf in entries(&self.folder) {
            for blob in entries(&shelf.path()) {
                let Ok(facts) = blob.metadata() else { continue };
                if blob.file_name().to_str().is_some_and(|name| needed.contains(name)) {
                    continue;
                }
                idle_bytes += facts.len();
                idle.push((facts.modified().unwrap_or(now), facts.len(), blob.path()));
            }
        }
        idle.sort();
        let mut removed = 0;
        for (used, bytes, path) in idle {
            let age = now.duration_since(used).unwrap_or_default();
            let is_young = age < self.config.terrain_grace;
            let is_old = age >= self.config.terrain_kept;
            let is_within = idle_bytes - removed <= self.config.terrain_cache_bytes;
            if is_young || (is_within && !is_old) {
                break;
            }
            fs::remove_file(&path).map_err(|why| self.error("remove", &path, &why))?;
            removed += bytes;
        }
        Ok(removed)
    }

    fn suspects(&self) -> std::sync::MutexGuard<'_, HashSet<BlobHash>> {
        self.suspects.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn unsynced(&self) -> std::sync::MutexGuard<'_, HashSet<BlobHash>> {
        self.unsynced.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What is in a folder; nothing if it is not there.
fn entries(folder: &Path) -> impl Iterator<Item = fs::DirEntry> {
    fs::read_dir(folder).into_iter().flatten().flatten()
}

#[cfg(test)]
mod tests {
    use super::super::tests::house::Land;
    use super::*;
    use std::time::Duration;

    const DAY: Duration = Duration::from_secs(24 * 3600);

    /// Terrain that came so many days ago.
    fn aged(blobs: &Blobs, land: &Land, days: u32) {
        for (hash, bytes) in &land.blobs {
            blobs.put(*hash, bytes).expect("room");
            blobs.touch(*hash, SystemTime::now() - days * DAY);
        }
    }

    /// How many of a store's blobs are there.
    fn here(blobs: &Blobs, land: &Land) -> usize {
        land.blobs.iter().filter(|(hash, _)| blobs.path(*hash).exists()).count()
    }

    #[test]
    fn terrain_that_no_shot_needs_goes_when_it_is_old_however_little_it_is() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::new(&Arc::new(QueueConfig::new(folder.path())));
        let land = Land::new(folder.path());
        let (all, index) = (land.blobs.len(), land.index);
        // Tiles came, and their index never did.
        aged(&blobs, &land, 13);
        fs::remove_file(blobs.path(index)).expect("it was there");
        blobs.sweep(&HashSet::new()).expect("readable");
        assert_eq!(here(&blobs, &land), all - 1, "not yet");
        aged(&blobs, &land, 15);
        blobs.sweep(&HashSet::from([index])).expect("readable");
        assert_eq!(here(&blobs, &land), all, "a shot needs it");
        // The index of a shot is gone: that holds up nothing.
        fs::remove_file(blobs.path(index)).expect("it was there");
        let removed = blobs.sweep(&HashSet::from([index])).expect("readable");
        assert_eq!(here(&blobs, &land), 0);
        let bytes = land.blobs.iter().filter(|(hash, _)| *hash != index);
        assert_eq!(removed, bytes.map(|(_, bytes)| bytes.len() as u64).sum::<u64>());
    }
}
