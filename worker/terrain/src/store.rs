//! The store as a file, `NAME.terrain`, and how it is read.
//!
//! ```text
//!  0  magic, 8 bytes           8  version, u32       12  zero, u32
//! 16  offset of the index, u64     24  its length, u64     32  its SHA-256
//! 64  tiles, each as long as its entry says
//! ..  index: a `StoreIndex` in postcard, to the end of the file
//! ```
//! Numbers are little-endian. Tiles are read by position, as many at once as there are
//! threads; the file is not mapped, so that a network share that goes away is an error
//! and not a crash. Everything read is checked against its hash.

use crate::codec::{self, CodecError, MAX_TILE_BYTES};
use crate::layout::{STORE_VERSION, StoreIndex, TileEntry, TileKey};
use crate::positioned::read_exact_at;
use crate::resident::Tile;
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use terrafarm_common::id::BlobHash;

/// First bytes of a store. The line ends catch a transfer that took it for text.
pub const MAGIC: [u8; 8] = *b"\x89TFS\r\n\x1a\n";
/// Bytes before the first tile.
pub const HEADER_BYTES: u64 = 64;
/// The longest index: [`crate::layout::MAX_TILES`] entries fit.
pub const MAX_INDEX_BYTES: u64 = 1 << 30;

/// Why a store cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The operating system refused.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Another kind of file.
    #[error("{} is not a terrain store; make one with \"terrafarm terrain import\"", path.display())]
    NotAStore {
        /// The file.
        path: PathBuf,
    },
    /// Written by an older or newer program.
    #[error(
        "{} has version {found}, this program reads version {STORE_VERSION}; import it again, or use the program that made it",
        path.display()
    )]
    OtherVersion {
        /// The file.
        path: PathBuf,
        /// The version in the file.
        found: u32,
    },
    /// The file ends too early.
    #[error("{} is cut short: {found} of {expected} bytes; copy or import it again", path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Length that the header asks for, bytes.
        expected: u64,
        /// Length of the file, bytes.
        found: u64,
    },
    /// The index contradicts itself or its hash.
    #[error("{}: the index is damaged: {what}; copy or import it again", path.display())]
    Index {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A tile is not what the index says.
    #[error("{}: {place} is damaged: {what}; copy or import it again", path.display())]
    Tile {
        /// The file.
        path: PathBuf,
        /// Which tile, in words.
        place: String,
        /// What is wrong.
        what: CodecError,
    },
    /// The caller asked for what the store does not have.
    #[error("{} has no {place}", path.display())]
    NoSuchTile {
        /// The file.
        path: PathBuf,
        /// What was asked for, in words.
        place: String,
    },
}

/// An open store. All methods may be called from several threads.
#[derive(Debug)]
pub struct StoreReader {
    path: PathBuf,
    file: File,
    file_bytes: u64,
    index: Arc<StoreIndex>,
    index_hash: BlobHash,
    index_bytes: Vec<u8>,
    blobs: HashMap<BlobHash, (u64, u32)>,
}

impl StoreReader {
    /// Opens a store and checks all of it but the tiles themselves.
    ///
    /// # Errors
    /// If the file cannot be read, is no store, has another version, is cut short, or its
    /// index is damaged.
    pub fn open(path: &Path) -> Result<StoreReader, StoreError> {
        let io = |source| StoreError::Io { path: path.to_owned(), source };
        let damaged = |what: String| StoreError::Index { path: path.to_owned(), what };
        let file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let header = Header::read(path, &file, length)?;

        let mut index_bytes = vec![0; header.index_length as usize];
        read_exact_at(&file, &mut index_bytes, header.index_offset).map_err(io)?;
        let index_hash = hash_of(&index_bytes);
        if index_hash != header.index_hash {
            return Err(damaged("its hash does not fit".into()));
        }
        let index = decode_index(&index_bytes).map_err(damaged)?;
        let mut blobs = HashMap::new();
        for entry in index.layers.iter().flat_map(|layer| &layer.levels).flat_map(|l| &l.entries) {
            check_range(entry, header.index_offset).map_err(damaged)?;
            if !entry.is_empty() {
                blobs.insert(entry.hash, (entry.offset, entry.length));
            }
        }
        Ok(StoreReader {
            path: path.to_owned(),
            file,
            file_bytes: length,
            index: Arc::new(index),
            index_hash,
            index_bytes,
            blobs,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What the store contains.
    pub fn index(&self) -> &Arc<StoreIndex> {
        &self.index
    }

    /// The index as it is sent to workers, with its hash: the identity of the store.
    pub fn index_blob(&self) -> (BlobHash, &[u8]) {
        (self.index_hash, &self.index_bytes)
    }

    /// Length of the file, bytes.
    pub fn file_bytes(&self) -> u64 {
        self.file_bytes
    }

    /// An encoded tile, or the index, by its hash: what a worker asks for.
    ///
    /// # Errors
    /// If there is no such blob, the file cannot be read, or the bytes are damaged.
    pub fn read_blob(&self, hash: &BlobHash) -> Result<Vec<u8>, StoreError> {
        if *hash == self.index_hash {
            return Ok(self.index_bytes.clone());
        }
        let place = || format!("tile {hash}");
        match self.blobs.get(hash) {
            Some(&(offset, length)) => self.read_at(hash, offset, length, place),
            None => Err(StoreError::NoSuchTile { path: self.path.clone(), place: place() }),
        }
    }

    /// A decoded tile; `None` if nothing in it is valid.
    ///
    /// # Errors
    /// If there is no such tile, the file cannot be read, or the tile is damaged.
    pub fn read_tile(&self, key: TileKey) -> Result<Option<Tile>, StoreError> {
        let place = || {
            let TileKey { layer, level, tx, ty } = key;
            format!("tile ({tx}, {ty}) of level {level} of layer {layer}")
        };
        let Some(entry) = self.index.entry(key) else {
            return Err(StoreError::NoSuchTile { path: self.path.clone(), place: place() });
        };
        if entry.is_empty() {
            return Ok(None);
        }
        let bytes = self.read_at(&entry.hash, entry.offset, entry.length, place)?;
        let decoded = codec::decode(&bytes).and_then(|tile| {
            let kind = self.index.layers[usize::from(key.layer)].kind;
            if tile.kind() == kind { Ok(tile) } else { Err(CodecError::OtherKind) }
        });
        let damaged = |what| StoreError::Tile { path: self.path.clone(), place: place(), what };
        decoded.map(Some).map_err(damaged)
    }

    fn read_at(
        &self,
        hash: &BlobHash,
        offset: u64,
        length: u32,
        place: impl Fn() -> String,
    ) -> Result<Vec<u8>, StoreError> {
        let mut bytes = vec![0; length as usize];
        read_exact_at(&self.file, &mut bytes, offset)
            .map_err(|source| StoreError::Io { path: self.path.clone(), source })?;
        if hash_of(&bytes) != *hash {
            let what = CodecError::CheckSum;
            return Err(StoreError::Tile { path: self.path.clone(), place: place(), what });
        }
        Ok(bytes)
    }
}

/// Reads the index blob of a store, as a worker receives it. Says what is wrong in words.
///
/// # Errors
/// If the bytes are no index or break a rule of [`StoreIndex::check`].
pub fn decode_index(bytes: &[u8]) -> Result<StoreIndex, String> {
    let (index, rest): (StoreIndex, _) =
        postcard::take_from_bytes(bytes).map_err(|error| format!("it cannot be read: {error}"))?;
    if !rest.is_empty() {
        return Err(format!("{} bytes too many", rest.len()));
    }
    index.check()?;
    Ok(index)
}

/// SHA-256 of a blob.
pub fn hash_of(bytes: &[u8]) -> BlobHash {
    BlobHash(Sha256::digest(bytes).into())
}

fn check_range(entry: &TileEntry, index_offset: u64) -> Result<(), String> {
    let end = entry.offset.checked_add(entry.length.into());
    let inside = entry.offset >= HEADER_BYTES && end.is_some_and(|end| end <= index_offset);
    let fits = entry.is_empty() || (inside && entry.length as usize <= MAX_TILE_BYTES);
    if fits { Ok(()) } else { Err(format!("tile {} lies outside the file", entry.hash)) }
}

/// The first bytes of a store.
pub(crate) struct Header {
    pub(crate) index_offset: u64,
    pub(crate) index_length: u64,
    pub(crate) index_hash: BlobHash,
}

impl Header {
    pub(crate) fn to_bytes(&self) -> [u8; HEADER_BYTES as usize] {
        let mut bytes = [0; HEADER_BYTES as usize];
        bytes[..8].copy_from_slice(&MAGIC);
        bytes[8..12].copy_from_slice(&STORE_VERSION.to_le_bytes());
        bytes[16..24].copy_from_slice(&self.index_offset.to_le_bytes());
        bytes[24..32].copy_from_slice(&self.index_length.to_le_bytes());
        bytes[32..].copy_from_slice(&self.index_hash.0);
        bytes
    }

    /// Reads and checks the header of a file of this length.
    fn read(path: &Path, file: &File, length: u64) -> Result<Header, StoreError> {
        let io = |source| StoreError::Io { path: path.to_owned(), source };
        let mut bytes = [0; HEADER_BYTES as usize];
        let present = length.min(HEADER_BYTES) as usize;
        read_exact_at(file, &mut bytes[..present], 0).map_err(io)?;
        if present < MAGIC.len() || bytes[..8] != MAGIC {
            return Err(StoreError::NotAStore { path: path.to_owned() });
        }
        let number = |at: usize| {
            u64::from_le_bytes(*bytes[at..].first_chunk().expect("the header has 64 bytes"))
        };
        let cut =
            |expected| StoreError::Truncated { path: path.to_owned(), expected, found: length };
        if length < HEADER_BYTES {
            return Err(cut(HEADER_BYTES));
        }
        let found = number(8) as u32;
        if found != STORE_VERSION {
            return Err(StoreError::OtherVersion { path: path.to_owned(), found });
        }
        let header = Header {
            index_offset: number(16),
            index_length: number(24),
            index_hash: BlobHash(*bytes.last_chunk().expect("the header has 64 bytes")),
        };
        let end = header.index_offset.checked_add(header.index_length);
        let damaged =
            |what: &str| StoreError::Index { path: path.to_owned(), what: what.to_owned() };
        match end {
            Some(_) if header.index_offset < HEADER_BYTES => Err(damaged("it overlaps the header")),
            Some(_) if header.index_length > MAX_INDEX_BYTES => Err(damaged("it is too long")),
            Some(end) if end > length => Err(cut(end)),
            Some(end) if end < length => Err(damaged("bytes follow it")),
            Some(_) => Ok(header),
            None => Err(damaged("its place is out of range")),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fixture::{Ground, height_layer, hills};
    use proptest::prelude::*;
    use std::fs;
    use std::sync::OnceLock;

    static INDEX: OnceLock<Vec<u8>> = OnceLock::new();

    fn store() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("hills.terrain");
        Ground::new().heights(height_layer([300, 40]), hills).build(&path).unwrap();
        (folder, path)
    }

    const KEY: TileKey = TileKey { layer: 0, level: 0, tx: 1, ty: 0 };

    #[test]
    fn blobs_are_found_by_hash_and_tiles_by_place() {
        let (_folder, path) = store();
        let store = StoreReader::open(&path).unwrap();
        assert_eq!(store.file_bytes(), fs::metadata(&path).unwrap().len());
        let (hash, bytes) = store.index_blob();
        assert_eq!(store.read_blob(&hash).unwrap(), bytes);
        assert_eq!(&decode_index(bytes).unwrap(), &**store.index());
        let entry = store.index().entry(KEY).unwrap();
        assert_eq!(hash_of(&store.read_blob(&entry.hash).unwrap()), entry.hash);
        let Some(Tile::Height(tile)) = store.read_tile(KEY).unwrap() else { panic!("heights") };
        assert_eq!(tile.post(3, 5), hills(259, 5));
        let outside = store.read_tile(TileKey { tx: 2, ..KEY }).err().unwrap();
        assert!(outside.to_string().ends_with("has no tile (2, 0) of level 0 of layer 0"));
        assert!(matches!(store.read_blob(&BlobHash([7; 32])), Err(StoreError::NoSuchTile { .. })));
    }

    #[test]
    fn every_truncation_is_an_error() {
        let (_folder, path) = store();
        let bytes = fs::read(&path).unwrap();
        for length in (0..HEADER_BYTES as usize).chain((64..bytes.len()).step_by(97)) {
            fs::write(&path, &bytes[..length]).unwrap();
            let error = StoreReader::open(&path).unwrap_err();
            assert!(
                matches!(error, StoreError::NotAStore { .. } | StoreError::Truncated { .. }),
                "{length}: {error}"
            );
        }
    }

    #[test]
    fn a_flipped_bit_anywhere_is_an_error_and_names_the_tile() {
        let (_folder, path) = store();
        let bytes = fs::read(&path).unwrap();
        for at in (0..bytes.len()).step_by(53) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 16;
            fs::write(&path, &damaged).unwrap();
            let Ok(store) = StoreReader::open(&path) else { continue };
            let keys = [0, 1].map(|tx| TileKey { tx, ..KEY });
            let top = TileKey { level: 1, tx: 0, ..KEY };
            let errors: Vec<String> = keys
                .iter()
                .chain([&top])
                .filter_map(|&key| store.read_tile(key).err())
                .map(|error| error.to_string())
                .collect();
            let header_padding = (12..16).contains(&at);
            assert_eq!(errors.len(), usize::from(!header_padding), "byte {at}");
            assert!(errors.iter().all(|text| text.contains("of layer 0 is damaged")));
        }
    }

    #[test]
    fn other_files_and_versions_are_told_apart() {
        let (_folder, path) = store();
        let bytes = fs::read(&path).unwrap();
        fs::write(&path, b"II*\0 a TIFF, surely longer than a header of sixty-four bytes is......")
            .unwrap();
        assert!(matches!(StoreReader::open(&path), Err(StoreError::NotAStore { .. })));
        let mut newer = bytes.clone();
        newer[8] = 200;
        fs::write(&path, &newer).unwrap();
        assert!(matches!(
            StoreReader::open(&path),
            Err(StoreError::OtherVersion { found: 200, .. })
        ));
        let longer = [bytes, vec![0]].concat();
        fs::write(&path, longer).unwrap();
        assert!(matches!(StoreReader::open(&path), Err(StoreError::Index { .. })));
        fs::remove_file(&path).unwrap();
        assert!(matches!(StoreReader::open(&path), Err(StoreError::Io { .. })));
    }

    #[test]
    fn an_index_whose_report_is_no_number_is_refused() {
        let (_folder, path) = store();
        let sound = StoreReader::open(&path).unwrap().index().as_ref().clone();
        for error in [f64::NAN, f64::INFINITY, -1.0] {
            for axis in 0..2 {
                let mut index = sound.clone();
                let report = &mut index.report;
                *[&mut report.max_resampling_error_m, &mut report.rms_resampling_error_m][axis] =
                    error;
                let refused = decode_index(&postcard::to_stdvec(&index).unwrap()).unwrap_err();
                assert!(refused.contains("resampling error"), "{refused}");
            }
        }
    }

    #[test]
    fn an_empty_tile_that_claims_a_height_is_refused() {
        let (_folder, path) = store();
        let mut index = StoreReader::open(&path).unwrap().index().as_ref().clone();
        let entry = &mut index.layers[0].levels[0].entries[0];
        *entry = TileEntry::EMPTY;
        assert!(decode_index(&postcard::to_stdvec(&index).unwrap()).is_ok());
        for height in [f32::NAN, 0.0] {
            let entry = &mut index.layers[0].levels[0].entries[0];
            *entry = TileEntry { max: height, ..TileEntry::EMPTY };
            let refused = decode_index(&postcard::to_stdvec(&index).unwrap()).unwrap_err();
            assert!(refused.contains("bound"), "{refused}");
        }
    }

    proptest! {
        #[test]
        fn any_index_is_read_or_refused(at: prop::sample::Index, bytes in prop::collection::vec(any::<u8>(), 0..40)) {
            let _ = decode_index(&bytes);
            let index = INDEX.get_or_init(|| {
                let (_folder, path) = store();
                StoreReader::open(&path).unwrap().index_blob().1.to_vec()
            });
            let mut changed = index.clone();
            let start = at.index(changed.len());
            let end = changed.len().min(start + bytes.len());
            changed.splice(start..end, bytes);
            if let Ok(index) = decode_index(&changed) {
                // Whatever passes the check can be used.
                let resident = crate::resident::Resident::new(Arc::new(index.clone()));
                prop_assert_eq!(resident.bytes(), 0);
                for layer in &index.layers {
                    prop_assert!(layer.far_corner().iter().all(|value| value.is_finite()));
                    prop_assert_eq!(layer.levels.last().unwrap().entries.len(), 1);
                }
            }
        }
    }

    #[test]
    fn many_threads_read_at_once() {
        let (_folder, path) = store();
        let store = StoreReader::open(&path).unwrap();
        std::thread::scope(|scope| {
            for thread in 0..8 {
                let store = &store;
                scope.spawn(move || {
                    for round in 0..40 {
                        let tx = (thread + round) % 2;
                        let Ok(Some(Tile::Height(tile))) = store.read_tile(TileKey { tx, ..KEY })
                        else {
                            panic!("tile {tx}")
                        };
                        assert_eq!(tile.post(1, 1), hills(u64::from(tx) * 256 + 1, 1));
                    }
                });
            }
        });
    }
}
