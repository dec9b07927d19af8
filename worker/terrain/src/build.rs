//! Makes a store from grids of posts.
//!
//! A [`StoreBuilder`] writes to a file beside the target and renames it when all is
//! there and synced; if it is dropped before, nothing is left behind. Tiles are encoded
//! in parallel, in batches, and written in order: the bytes of a store do not depend on
//! the number of threads. Coarser levels are made from the tiles already written, a strip
//! at a time, so that memory stays within about 100 MB whatever the size of the layer.

use self::levels::Made;
use crate::codec::{CodecError, MAX_TILE_BYTES};
use crate::layout::{
    HeightDatum, ImportReport, Layer, LayerKind, MAX_LAYERS, MAX_POSTS, MAX_TILES, PostWindow,
    STORE_VERSION, StoreIndex, TileEntry,
};
use crate::positioned::write_all_at;
use crate::pyramid::Post;
use crate::store::{HEADER_BYTES, Header, MAX_INDEX_BYTES, hash_of};
use std::collections::HashMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use terrafarm_common::id::BlobHash;

/// Why a source cannot give its posts: any error; its text is shown.
pub type SourceError = Box<dyn std::error::Error + Send + Sync>;

/// Where the posts of a layer come from. Called from several threads at once.
pub trait LayerSource: Sync {
    /// Heights of a window of posts, metres, row by row from the south-west; NaN for a
    /// void. The window lies within the layer.
    ///
    /// # Errors
    /// Whatever keeps the source from answering; building stops.
    fn heights(&self, window: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        let _ = (window, into);
        Err("this source has no heights".into())
    }

    /// Colours of the same: sRGB red, green, blue, and coverage.
    ///
    /// # Errors
    /// Whatever keeps the source from answering; building stops.
    fn colors(&self, window: PostWindow, into: &mut [[u8; 4]]) -> Result<(), SourceError> {
        let _ = (window, into);
        Err("this source has no colours".into())
    }
}

/// A layer to be built. Fields as in [`Layer`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LayerSpec {
    /// Heights or colours.
    pub kind: LayerKind,
    /// Position of post (0, 0), metres.
    pub origin: [f64; 2],
    /// Distance between posts, metres.
    pub spacing: [f64; 2],
    /// Number of posts.
    pub posts: [u64; 2],
    /// Heights: what every height is a whole multiple of, metres, as the decimal number
    /// that is written (0.1 means one tenth). It makes tiles smaller and is never
    /// enforced: heights that do not fit are kept as they are. Coarser levels are
    /// rounded as [`crate::rounding`] says.
    pub quantum_m: Option<f32>,
}

/// Why a store cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum BuildError {
    /// The operating system refused.
    #[error("cannot write {}: {source}{}", path.display(), advice(source))]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The source of a layer failed.
    #[error("cannot read the posts of layer {layer}: {source}")]
    Source {
        /// Number of the layer, in the order they were added.
        layer: usize,
        /// What the source said.
        source: SourceError,
    },
    /// The layer breaks a limit.
    #[error("layer {layer} cannot be stored: {what}")]
    Layer {
        /// Number of the layer, in the order they were added.
        layer: usize,
        /// Which limit, and what to do.
        what: String,
    },
    /// The store as a whole breaks a rule.
    #[error("the store cannot be finished: {0}")]
    Store(String),
    /// What was written came back changed.
    #[error("{} came back damaged while it was written ({source}); check the disk", path.display())]
    ReadBack {
        /// The file.
        path: PathBuf,
        /// What is wrong with the tile.
        source: CodecError,
    },
    /// The caller raised the flag.
    #[error("stopped on request; nothing was kept")]
    Cancelled,
}

fn advice(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::StorageFull => "; free some space or choose another disk",
        io::ErrorKind::PermissionDenied => "; choose a folder that you may write to",
        io::ErrorKind::NotFound => "; does the folder exist?",
        _ => "",
    }
}

/// What was made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoreSummary {
    /// The file.
    pub path: PathBuf,
    /// Identity of the store: the hash of its index.
    pub hash: BlobHash,
    /// Length of the file, bytes.
    pub bytes: u64,
    /// Tiles that hold anything, all layers and levels.
    pub tiles: u64,
    /// The same, each content counted once.
    pub distinct_tiles: u64,
}

/// A store in the making.
pub struct StoreBuilder {
    target: PathBuf,
    partial: Partial,
    /// End of what is written, bytes.
    end: u64,
    index: StoreIndex,
    known: HashMap<BlobHash, (u64, u32)>,
    tiles: u64,
    void_posts: u64,
}

/// The file beside the target; removed when dropped.
struct Partial {
    path: PathBuf,
    file: File,
}

impl Drop for Partial {
    fn drop(&mut self) {
        // After the rename there is nothing under this name, and that is right.
        let _ = fs::remove_file(&self.path);
    }
}

/// Progress and the wish to stop, as the caller of [`StoreBuilder::add_layer`] sees them.
struct Watch<'a> {
    progress: &'a dyn Fn(u64, u64),
    cancel: &'a AtomicBool,
    done: u64,
    total: u64,
}

impl Watch<'_> {
    fn advance(&mut self, tiles: usize) -> Result<(), BuildError> {
        self.done += tiles as u64;
        (self.progress)(self.done, self.total);
        if self.cancel.load(Ordering::Relaxed) { Err(BuildError::Cancelled) } else { Ok(()) }
    }
}

impl StoreBuilder {
    /// Begins a store. Fields as in [`StoreIndex`]. An existing store of that name stays
    /// as it is until [`StoreBuilder::finish`] replaces it.
    ///
    /// # Errors
    /// If the file beside the target cannot be made.
    pub fn create(
        path: &Path,
        crs: impl Into<String>,
        height_datum: HeightDatum,
        earth_radius_m: Option<f64>,
    ) -> Result<StoreBuilder, BuildError> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let mut name = path.file_name().unwrap_or_default().to_owned();
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        name.push(format!(".partial-{}-{count}", std::process::id()));
        let partial = path.with_file_name(name);
        let file = File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(true)
            .open(&partial)
            .map_err(|source| BuildError::Io { path: partial.clone(), source })?;
        Ok(StoreBuilder {
            target: path.to_owned(),
            partial: Partial { path: partial, file },
            end: HEADER_BYTES,
            index: StoreIndex {
                version: STORE_VERSION,
                crs: crs.into(),
                height_datum,
                earth_radius_m,
                layers: Vec::new(),
                report: ImportReport::default(),
            },
            known: HashMap::new(),
            tiles: 0,
            void_posts: 0,
        })
    }

    /// Adds a layer with all its levels. `progress` is told the number of tiles done and
    /// to do; `cancel` stops the work at the next batch. Posts outside the layer are void
    /// in its tiles. After an error the builder is only good to be dropped.
    ///
    /// # Errors
    /// If the layer breaks a limit (nothing is allocated for it), its source fails, the
    /// disk is full, or `cancel` was raised.
    pub fn add_layer(
        &mut self,
        spec: LayerSpec,
        source: &dyn LayerSource,
        progress: &dyn Fn(u64, u64),
        cancel: &AtomicBool,
    ) -> Result<(), BuildError> {
        let total = self.check(&spec)?;
        let mut watch = Watch { progress, cancel, done: 0, total };
        let layer = match spec.kind {
            LayerKind::Height => self.build_layer::<f32>(spec, source, &mut watch)?,
            LayerKind::Photo => self.build_layer::<[u8; 4]>(spec, source, &mut watch)?,
        };
        self.index.layers.push(layer);
        Ok(())
    }

    /// Writes the index, syncs, and gives the store its name. Layers are put in the order
    /// that the index asks for; the number of voids in the report is filled in.
    ///
    /// # Errors
    /// If there is no height layer, or the disk refuses.
    pub fn finish(mut self, report: ImportReport) -> Result<StoreSummary, BuildError> {
        self.index.report = ImportReport { void_posts: self.void_posts, ..report };
        self.index.layers.sort_by(|a, b| {
            let area = |layer: &Layer| layer.spacing[0] * layer.spacing[1];
            let rank = |layer: &Layer| u8::from(layer.kind == LayerKind::Photo);
            rank(a).cmp(&rank(b)).then(area(b).total_cmp(&area(a)))
        });
        self.index.check().map_err(BuildError::Store)?;
        let index = postcard::to_stdvec(&self.index)
            .map_err(|error| BuildError::Store(error.to_string()))?;
        if index.len() as u64 > MAX_INDEX_BYTES {
            return Err(BuildError::Store("its index and report are too long".into()));
        }
        let header = Header {
            index_offset: self.end,
            index_length: index.len() as u64,
            index_hash: hash_of(&index),
        };
        self.write(&index, self.end)?;
        self.write(&header.to_bytes(), 0)?;
        let io = |source| BuildError::Io { path: self.partial.path.clone(), source };
        self.partial.file.sync_all().map_err(io)?;
        fs::rename(&self.partial.path, &self.target)
            .map_err(|source| BuildError::Io { path: self.target.clone(), source })?;
        sync_folder(&self.target);
        Ok(StoreSummary {
            path: self.target.clone(),
            hash: header.index_hash,
            bytes: self.end + header.index_length,
            tiles: self.tiles,
            distinct_tiles: self.known.len() as u64,
        })
    }

    /// Checks a layer against all limits; the number of its tiles.
    fn check(&self, spec: &LayerSpec) -> Result<u64, BuildError> {
        let layer = self.index.layers.len();
        let refuse = |what: String| Err(BuildError::Layer { layer, what });
        if layer == MAX_LAYERS {
            return refuse(format!("at most {MAX_LAYERS} layers are allowed; merge some inputs"));
        }
        let [width, height] = spec.posts;
        if spec.posts.iter().any(|&n| n == 0 || n > MAX_POSTS) {
            return refuse(format!(
                "{width} x {height} posts; 1 to {MAX_POSTS} a side are allowed; cut it or use a coarser spacing"
            ));
        }
        let numbers_fit = spec.origin.iter().chain(&spec.spacing).all(|value| value.is_finite())
            && spec.spacing.iter().all(|&step| step > 0.0)
            && shape(spec).far_corner().iter().all(|value| value.is_finite())
            && spec.quantum_m.is_none_or(|step| step.is_finite() && step > 0.0);
        if !numbers_fit {
            return refuse(
                "origin, spacing and quantum must be numbers, the last two above 0".into(),
            );
        }
        let tiles: u64 = (0..Layer::level_count(spec.posts))
            .map(|level| Layer::tiles_for(shape(spec).level_posts(level)))
            .map(|[columns, rows]| u64::from(columns) * u64::from(rows))
            .sum();
        let layers = self.index.layers.iter().flat_map(|layer| &layer.levels);
        let before: u64 = layers.map(|level| level.entries.len() as u64).sum();
        if before + tiles > MAX_TILES {
            return refuse(format!(
                "its {width} x {height} posts make {tiles} tiles, {before} are there, at most {MAX_TILES} are allowed; cut it or use a coarser spacing"
            ));
        }
        Ok(tiles)
    }

    fn build_layer<P: Post>(
        &mut self,
        spec: LayerSpec,
        source: &dyn LayerSource,
        watch: &mut Watch<'_>,
    ) -> Result<Layer, BuildError> {
        let mut layer = shape(&spec);
        // The decimal that was meant: 0.1f32 is 0.10000000149 otherwise.
        let step = spec.quantum_m.and_then(|quantum| quantum.to_string().parse::<f64>().ok());
        let finest = self.build_finest::<P>(spec.posts, step, source, watch)?;
        layer.levels.push(finest);
        for level in 1..Layer::level_count(spec.posts) {
            let coarser = self.build_coarser::<P>(&layer, level, watch)?;
            layer.levels.push(coarser);
        }
        Ok(layer)
    }

    /// Writes a batch in order; a tile that is there already is not written again.
    fn append(
        &mut self,
        batch: Vec<Made>,
        entries: &mut Vec<TileEntry>,
        watch: &mut Watch<'_>,
    ) -> Result<(), BuildError> {
        let count = batch.len();
        for Made { bytes, mut entry, void_posts } in batch {
            self.void_posts += void_posts;
            if !bytes.is_empty() {
                debug_assert!(bytes.len() <= MAX_TILE_BYTES);
                self.tiles += 1;
                let place = match self.known.get(&entry.hash) {
                    Some(&place) => place,
                    None => {
                        let place = (self.end, bytes.len() as u32);
                        self.write(&bytes, self.end)?;
                        self.end += bytes.len() as u64;
                        self.known.insert(entry.hash, place);
                        place
                    }
                };
                (entry.offset, entry.length) = place;
            }
            entries.push(entry);
        }
        watch.advance(count)
    }

    fn write(&self, bytes: &[u8], offset: u64) -> Result<(), BuildError> {
        write_all_at(&self.partial.file, bytes, offset)
            .map_err(|source| BuildError::Io { path: self.partial.path.clone(), source })
    }
}

/// A layer without its levels.
fn shape(spec: &LayerSpec) -> Layer {
    let LayerSpec { kind, origin, spacing, posts, .. } = *spec;
    Layer { kind, origin, spacing, posts, levels: Vec::new() }
}

/// Makes the new name itself durable, where the system can.
fn sync_folder(path: &Path) {
    if cfg!(unix) {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        // The store is whole in any case; a system that cannot sync folders is no reason
        // to call it failed.
        let _ = File::open(folder.unwrap_or(Path::new("."))).and_then(|folder| folder.sync_all());
    }
}

mod levels;
#[cfg(test)]
mod tests;
