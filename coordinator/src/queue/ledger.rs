//! The records of the queue, in one redb file.
//!
//! Every call is one transaction and is on the disk when it returns. After an error of
//! the disk the file is closed and opened again by the next call: redb goes back to its
//! last transaction then, however the disk failed.
//!
//! | table | key | value |
//! |---|---|---|
//! | `meta` | `version`, `last` | version of this format; last number given to a shot |
//! | `shots` | shot | [`ShotRecord`], JSON |
//! | `cameras` | shot, piece | up to 1024 cameras of 13 f64 each, little endian |
//! | `frames` | shot, index | [`FrameRecord`], JSON |
//! | `progress` | shot | frames done, frames failed, last one done + 1 |
//! | `keys` | key of a submission | shot, seconds since 1970, SHA-256 of the submission |

use super::{QueueError, SubmissionKey};
use redb::{Database, ReadableDatabase, ReadableTable, TableDefinition, WriteTransaction};
use serde::Serialize;
use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId};

/// The format that this program reads and writes.
const VERSION: u64 = 1;
/// Cameras of one record.
const PIECE: usize = 1024;
/// Numbers of one camera: four vectors and the field of view.
const CAMERA_NUMBERS: usize = 13;
/// Memory that redb may take for pages, bytes.
const CACHE_BYTES: usize = 32 << 20;

pub use super::record::{FrameRecord, Progress, Saved, ShotRecord, Stage};

const META: TableDefinition<&str, u64> = TableDefinition::new("meta");
const SHOTS: TableDefinition<u64, &[u8]> = TableDefinition::new("shots");
const CAMERAS: TableDefinition<(u64, u32), &[u8]> = TableDefinition::new("cameras");
const FRAMES: TableDefinition<(u64, u32), &[u8]> = TableDefinition::new("frames");
const PROGRESS: TableDefinition<u64, (u32, u32, u32)> = TableDefinition::new("progress");

/// Shot, seconds since 1970, hash of what was submitted.
type KeyRow = (u64, u64, [u8; 32]);
const KEYS: TableDefinition<&str, KeyRow> = TableDefinition::new("keys");

/// Opens the file; again and again, if need be.
type Opener = Box<dyn Fn() -> Result<Database, redb::DatabaseError> + Send>;

/// The records.
pub struct Ledger {
    path: PathBuf,
    opener: Opener,
    /// `None` after an error of the disk.
    database: Option<Database>,
}

impl Ledger {
    /// Opens the file, or makes it.
    ///
    /// # Errors
    /// If it is no queue, a newer one, damaged, or the disk fails.
    pub fn open(path: &Path) -> Result<Self, QueueError> {
        let file = path.to_path_buf();
        let opener = move || Database::builder().set_cache_size(CACHE_BYTES).create(&file);
        Self::with(path, Box::new(opener))
    }

    /// As [`Ledger::open`], with another way to the file.
    pub(super) fn with(path: &Path, opener: Opener) -> Result<Self, QueueError> {
        let mut ledger = Ledger { path: path.to_path_buf(), opener, database: None };
        let version = ledger.write(|transaction| {
            transaction.open_table(SHOTS)?;
            transaction.open_table(CAMERAS)?;
            transaction.open_table(FRAMES)?;
            transaction.open_table(PROGRESS)?;
            transaction.open_table(KEYS)?;
            let mut meta = transaction.open_table(META)?;
            let version = meta.get("version")?.map(|version| version.value());
            if version.is_none() {
                meta.insert("version", VERSION)?;
            }
            Ok(version.unwrap_or(VERSION))
        })?;
        if version != VERSION {
            return Err(ledger.damaged(format!(
                "it has format {version}, this program knows {VERSION}; use the program that wrote it"
            )));
        }
        Ok(ledger)
    }

    /// All shots by number, and the last number given. Those that are damaged have failed.
    ///
    /// # Errors
    /// If they cannot be read.
    pub fn load(&mut self) -> Result<(u64, Vec<Saved>), QueueError> {
        self.read(|transaction| {
            let last = transaction.open_table(META)?.get("last")?.map_or(0, |last| last.value());
            let progress = transaction.open_table(PROGRESS)?;
            let mut rows = Vec::new();
            for row in transaction.open_table(SHOTS)?.iter()? {
                let (id, record) = row?;
                let far = progress.get(id.value())?.map(|far| far.value()).unwrap_or_default();
                let record = ShotRecord::read(record.value());
                let progress = Progress::from_row(far);
                rows.push(Saved { id: ShotId(id.value()), record, progress });
            }
            Ok((last, rows))
        })
    }

    /// Adds a shot and its cameras, and the key under which it was submitted, if it had one.
    ///
    /// # Errors
    /// If it cannot be written; then nothing is.
    pub fn add(
        &mut self,
        id: ShotId,
        record: &ShotRecord,
        cameras: &[Camera],
        key: Option<&SubmissionKey>,
    ) -> Result<(), QueueError> {
        let submitted_s = record.submitted_s;
        let record = self.text(record)?;
        self.write(|transaction| {
            transaction.open_table(META)?.insert("last", id.0)?;
            if let Some(SubmissionKey { key, content }) = key {
                let row = (id.0, submitted_s, content.0);
                transaction.open_table(KEYS)?.insert(key.as_str(), row)?;
            }
            transaction.open_table(SHOTS)?.insert(id.0, record.as_slice())?;
            let mut table = transaction.open_table(CAMERAS)?;
            for (piece, cameras) in (0..).zip(cameras.chunks(PIECE)) {
                table.insert((id.0, piece), pack(cameras).as_slice())?;
            }
            Ok(())
        })
    }

    /// The shot that was submitted under a key, and the hash of what was submitted.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn recall(&mut self, key: &str) -> Result<Option<(ShotId, BlobHash)>, QueueError> {
        self.read(|transaction| {
            let row = transaction.open_table(KEYS)?.get(key)?.map(|row| row.value());
            Ok(row.map(|(shot, _, content)| (ShotId(shot), BlobHash(content))))
        })
    }

    /// Forgets keys that are older than this many seconds since 1970; returns how many.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn forget_keys(&mut self, before_s: u64) -> Result<usize, QueueError> {
        let old = self.read(|transaction| {
            let mut old = Vec::new();
            for row in transaction.open_table(KEYS)?.iter()? {
                let (key, row) = row?;
                if row.value().1 < before_s {
                    old.push(key.value().to_owned());
                }
            }
            Ok(old)
        })?;
        if old.is_empty() {
            return Ok(0);
        }
        self.write(|transaction| {
            let mut keys = transaction.open_table(KEYS)?;
            for key in &old {
                keys.remove(key.as_str())?;
            }
            Ok(old.len())
        })
    }

    /// Writes a shot that is there already.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn put(&mut self, id: ShotId, record: &ShotRecord) -> Result<(), QueueError> {
        let record = self.text(record)?;
        self.write(|transaction| {
            transaction.open_table(SHOTS)?.insert(id.0, record.as_slice())?;
            Ok(())
        })
    }

    /// Keeps what became of frames, all or none of them, and returns how far their shots
    /// are.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn record(
        &mut self,
        frames: &[(ShotId, FrameIndex, FrameRecord)],
    ) -> Result<BTreeMap<ShotId, Progress>, QueueError> {
        let texts: Vec<_> =
            frames.iter().map(|(_, _, record)| self.text(record)).collect::<Result<_, _>>()?;
        self.write(|transaction| {
            let mut table = transaction.open_table(FRAMES)?;
            let mut shots = transaction.open_table(PROGRESS)?;
            let mut far = BTreeMap::new();
            for ((shot, index, record), text) in frames.iter().zip(&texts) {
                let before = table.insert((shot.0, *index), text.as_slice())?.is_some();
                let progress = match far.entry(*shot) {
                    std::collections::btree_map::Entry::Occupied(known) => known.into_mut(),
                    std::collections::btree_map::Entry::Vacant(new) => {
                        let row = shots.get(shot.0)?.map(|row| row.value()).unwrap_or_default();
                        new.insert(Progress::from_row(row))
                    }
                };
                match record {
                    _ if before => {}
                    FrameRecord::Done { .. } => progress.done = progress.done.saturating_add(1),
                    FrameRecord::Failed(_) => progress.failed = progress.failed.saturating_add(1),
                }
                if matches!(record, FrameRecord::Done { .. }) {
                    progress.last = Some(*index);
                }
            }
            for (shot, progress) in &far {
                shots.insert(shot.0, progress.row())?;
            }
            Ok(far)
        })
    }

    /// Forgets that these frames were finished: their pictures are not what they should be,
    /// or their records are damaged. Those that failed are left as they are. Returns how far the shot is now: all of its frames are
    /// counted again, since nobody knows as what a damaged one was counted.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn unrecord(
        &mut self,
        shot: ShotId,
        frames: &[FrameIndex],
    ) -> Result<Progress, QueueError> {
        self.write(|transaction| {
            let mut table = transaction.open_table(FRAMES)?;
            let mut shots = transaction.open_table(PROGRESS)?;
            let row = shots.get(shot.0)?.map(|row| row.value()).unwrap_or_default();
            let mut progress = Progress { done: 0, failed: 0, ..Progress::from_row(row) };
            for &index in frames {
                let kept = table.get((shot.0, index))?;
                let kept = kept.map(|text| FrameRecord::read(text.value()));
                // One that could not be rendered has no pixels that could be wrong.
                if !matches!(kept, Some(Some(FrameRecord::Failed(_)))) {
                    table.remove((shot.0, index))?;
                }
            }
            for row in table.range((shot.0, 0)..=(shot.0, u32::MAX))? {
                match FrameRecord::read(row?.1.value()) {
                    Some(FrameRecord::Failed(_)) => progress.failed += 1,
                    Some(FrameRecord::Done { .. }) | None => progress.done += 1,
                }
            }
            shots.insert(shot.0, progress.row())?;
            Ok(progress)
        })
    }

    /// What became of the frames of a shot, by index; `None` where the record is damaged.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn frames(
        &mut self,
        shot: ShotId,
    ) -> Result<BTreeMap<FrameIndex, Option<FrameRecord>>, QueueError> {
        self.read(|transaction| {
            let table = transaction.open_table(FRAMES)?;
            let range = table.range((shot.0, 0)..=(shot.0, u32::MAX))?;
            let read = range
                .map(|row| row.map(|(key, text)| (key.value().1, FrameRecord::read(text.value()))));
            Ok(read.collect::<Result<_, _>>()?)
        })
    }

    /// What became of one frame; `Some(None)` where its record is damaged.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn frame(
        &mut self,
        shot: ShotId,
        index: FrameIndex,
    ) -> Result<Option<Option<FrameRecord>>, QueueError> {
        self.read(|transaction| {
            let table = transaction.open_table(FRAMES)?;
            Ok(table.get((shot.0, index))?.map(|text| FrameRecord::read(text.value())))
        })
    }

    /// The frames that are not over, each with its camera.
    ///
    /// # Errors
    /// If they cannot be read; [`QueueError::Unfit`] if they are not those of the shot.
    pub fn missing(
        &mut self,
        shot: ShotId,
        record: &ShotRecord,
    ) -> Result<Vec<(FrameIndex, Camera)>, QueueError> {
        let [width, height] = record.plan.size;
        let (over, pieces) = self.read(|transaction| {
            let all = (shot.0, 0)..=(shot.0, u32::MAX);
            let frames = transaction.open_table(FRAMES)?;
            let over: Result<std::collections::BTreeSet<_>, _> =
                frames.range(all.clone())?.map(|row| row.map(|(key, _)| key.value().1)).collect();
            let cameras = transaction.open_table(CAMERAS)?;
            let pieces: Result<Vec<_>, _> = cameras
                .range(all)?
                .map(|row| row.map(|(_, piece)| piece.value().to_vec()))
                .collect();
            Ok((over?, pieces?))
        })?;
        let cameras: Vec<_> =
            pieces.iter().flat_map(|piece| unpack(piece, (width, height))).collect();
        if cameras.len() != record.frames as usize || !cameras.iter().all(Camera::is_valid) {
            let found = cameras.len();
            return Err(QueueError::Unfit(format!(
                "it has {} frames, and {found} cameras that can be read",
                record.frames
            )));
        }
        Ok((0..).zip(cameras).filter(|(index, _)| !over.contains(index)).collect())
    }

    /// Forgets shots that are over. Their files stay.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn forget(&mut self, shots: &[ShotId]) -> Result<(), QueueError> {
        self.write(|transaction| {
            let mut records = transaction.open_table(SHOTS)?;
            let mut progress = transaction.open_table(PROGRESS)?;
            let mut frames = transaction.open_table(FRAMES)?;
            let mut cameras = transaction.open_table(CAMERAS)?;
            for shot in shots {
                records.remove(shot.0)?;
                progress.remove(shot.0)?;
                let all = (shot.0, 0)..=(shot.0, u32::MAX);
                frames.retain_in(all.clone(), |_, _| false)?;
                cameras.retain_in(all, |_, _| false)?;
            }
            Ok(())
        })
    }

    fn write<T>(
        &mut self,
        work: impl FnOnce(&WriteTransaction) -> Result<T, redb::Error>,
    ) -> Result<T, QueueError> {
        self.with_database(|database| {
            let transaction = database.begin_write()?;
            let value = work(&transaction)?;
            transaction.commit()?;
            Ok(value)
        })
    }

    fn read<T>(
        &mut self,
        work: impl FnOnce(&redb::ReadTransaction) -> Result<T, redb::Error>,
    ) -> Result<T, QueueError> {
        self.with_database(|database| work(&database.begin_read()?))
    }

    /// Opens the file if need be. redb gives up by a panic where a file contradicts itself:
    /// that is an error of the file here.
    fn with_database<T>(
        &mut self,
        work: impl FnOnce(&Database) -> Result<T, redb::Error>,
    ) -> Result<T, QueueError> {
        let worked = catch_unwind(AssertUnwindSafe(|| match &mut self.database {
            Some(database) => work(database),
            closed => work(closed.insert((self.opener)()?)),
        }));
        match worked {
            Ok(Ok(value)) => Ok(value),
            Ok(Err(why)) => Err(self.failed(why)),
            Err(_) => {
                self.close();
                Err(self.unreadable(&"its pages contradict each other"))
            }
        }
    }

    fn close(&mut self) {
        let database = self.database.take();
        // Closing writes, too.
        if catch_unwind(AssertUnwindSafe(|| drop(database))).is_err() {
            tracing::warn!(path = %self.path.display(), "the records could not be closed in order");
        }
    }

    /// The file cannot be trusted until it is opened again.
    fn failed(&mut self, why: redb::Error) -> QueueError {
        self.close();
        match why {
            redb::Error::Io(source) => match source.kind() {
                ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
                    super::disk::full(self.path.parent().unwrap_or(Path::new(".")), 1)
                }
                ErrorKind::InvalidData | ErrorKind::UnexpectedEof => self.unreadable(&source),
                _ => self.damaged(source.to_string()),
            },
            redb::Error::DatabaseAlreadyOpen => self.damaged("another program has it open".into()),
            other => self.unreadable(&other),
        }
    }

    fn unreadable(&self, why: &dyn std::fmt::Display) -> QueueError {
        self.damaged(format!(
            "{why}; move the file away to begin with an empty queue: pictures stay in \"shots\""
        ))
    }

    fn damaged(&self, why: String) -> QueueError {
        QueueError::Ledger { path: self.path.clone(), why }
    }

    fn text(&self, value: &impl Serialize) -> Result<Vec<u8>, QueueError> {
        serde_json::to_vec(value).map_err(|why| self.damaged(format!("cannot be written: {why}")))
    }
}

impl Drop for Ledger {
    fn drop(&mut self) {
        self.close();
    }
}

/// Reads a shot from its values, and puts it into a book; for [`crate::fuzz`].
pub(crate) fn is_shot_on_record(record: &[u8], row: (u32, u32, u32), cameras: &[u8]) -> bool {
    let is_sound = serde_json::from_slice::<ShotRecord>(record).is_ok();
    let record = ShotRecord::read(record);
    let [width, height] = record.plan.size;
    let valid = unpack(cameras, (width, height)).filter(Camera::is_valid).count();
    let (id, progress) = (ShotId(1), Progress::from_row(row));
    let mut book = super::book::Book::new(vec![Saved { id, record, progress }], 1);
    let _ = book.moves();
    let _ = book.to_finish();
    let complete = book.get(id).is_some_and(super::book::Shot::is_complete);
    book.forget(id);
    is_sound && (complete || valid > 0)
}

/// Reads what became of a frame; for [`crate::fuzz`].
pub(crate) fn is_frame_on_record(record: &[u8]) -> bool {
    FrameRecord::read(record).is_some()
}

fn pack(cameras: &[Camera]) -> Vec<u8> {
    let numbers = |camera: &Camera| {
        let axes = [camera.position, camera.right, camera.up, camera.forward];
        axes.into_iter().flat_map(|axis| axis.to_array()).chain([camera.tan_half_hfov])
    };
    cameras.iter().flat_map(|camera| numbers(camera).flat_map(f64::to_le_bytes)).collect()
}

fn unpack(piece: &[u8], (width, height): (u32, u32)) -> impl Iterator<Item = Camera> {
    piece.chunks_exact(8 * CAMERA_NUMBERS).map(move |bytes| {
        let mut numbers = [0.0; CAMERA_NUMBERS];
        for (number, bytes) in numbers.iter_mut().zip(bytes.as_chunks::<8>().0) {
            *number = f64::from_le_bytes(*bytes);
        }
        let axis = |at: usize| [numbers[at], numbers[at + 1], numbers[at + 2]].into();
        let tan_half_hfov = numbers[12];
        let (position, right, up, forward) = (axis(0), axis(3), axis(6), axis(9));
        Camera { position, right, up, forward, tan_half_hfov, width, height }
    })
}
