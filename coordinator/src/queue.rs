//! The queue on disk: shots that outlive whoever submitted them, and the coordinator.
//!
//! The farm is memory only; the queue is what a person relies on. It is a client of its
//! own farm, inside the coordinator: it holds the terrain of its shots as blobs, submits
//! the frames that are missing, and writes what comes back. Whatever is killed when, what
//! was acknowledged stays: a submission, an order, a finished frame.
//!
//! | in the folder | what |
//! |---|---|
//! | `lock` | held while a coordinator uses the folder; says its process number |
//! | `queue.redb` | shots, cameras, states, one record a finished frame |
//! | `blobs/ab/HASH` | terrain, by hash |
//! | `shots/000017/frame_00000.png` | finished frames, by their number in the flight |
//! | `shots/000017/manifest.json`, `film.mp4` | made when the last frame is there |
//!
//! A frame is finished when its picture and then its record are on the disk. In between,
//! a crash costs the frame: it is rendered again and written over.
//!
//! [`Queue`] is the handle; [`QueueTask`] does the work. Within: `plan` is what is
//! submitted, `book` decides (pure), `ledger` keeps records (`record`), `blobs` terrain,
//! `pictures` frames and films, `task` joins them.

mod blobs;
mod book;
mod disk;
mod ledger;
mod pictures;
mod plan;
mod record;
mod task;

pub use plan::{Film, PIXELS_IN_FLIGHT_MAX, ShotPlan, Source, TEXT_BYTES_MAX, parse_hash};

use crate::driver::FarmLine;
use crate::order::{Order, OrderError};
use crate::view::{ShotState, ShotView};
use blobs::Blobs;
use bytes::Bytes;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use task::Task;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId};
use terrafarm_terrain::store::hash_of;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;

pub(crate) use ledger::{is_frame_on_record, is_shot_on_record};

/// Most shots that are not over.
pub const SHOTS_MAX: usize = 20_000;
/// Most shots that are over and still listed; of more, the oldest are forgotten. Their
/// files stay.
pub const OVER_MAX: usize = 20_000;
/// Most hashes in one question for missing blobs.
pub const MISSING_MAX: usize = 1 << 16;
/// Commands that may wait for the task; further ones wait with whoever gives them.
const COMMANDS: usize = 256;

/// Longest key of a submission, bytes.
pub const KEY_BYTES_MAX: usize = 128;
/// How long keys of submissions are remembered, at least.
pub const KEY_KEPT: Duration = Duration::from_secs(2 * 24 * 3600);

/// Every shot of the queue, by number.
pub type ShotList = Arc<Vec<Arc<ShotView>>>;

/// Settings of a queue.
#[derive(Debug, Clone)]
pub struct QueueConfig {
    /// Where everything is.
    pub folder: PathBuf,
    /// Space that is left free on its disk, bytes: below it, the queue waits.
    pub reserve_bytes: u64,
    /// Terrain that no unfinished shot needs is kept up to this size, bytes.
    pub terrain_cache_bytes: u64,
    /// How long it is kept at most after it came or was asked for.
    pub terrain_kept: Duration,
    /// How long terrain is kept in any case after it came or was asked for: a submission
    /// may be on its way.
    pub terrain_grace: Duration,
    /// How often a full disk is looked at again.
    pub retry: Duration,
    /// Shots that are in the farm at once; more only when a more urgent one comes.
    pub active: usize,
}

impl QueueConfig {
    /// The usual settings, in this folder.
    pub fn new(folder: impl Into<PathBuf>) -> Self {
        QueueConfig {
            folder: folder.into(),
            reserve_bytes: 256 << 20,
            terrain_cache_bytes: 8 << 30,
            terrain_kept: Duration::from_secs(14 * 24 * 3600),
            terrain_grace: Duration::from_secs(3600),
            retry: Duration::from_secs(3),
            active: 16,
        }
    }
}

/// Why the queue did not do what was asked.
#[derive(Debug, Clone, thiserror::Error)]
pub enum QueueError {
    /// Another coordinator uses the folder.
    #[error(
        "{} is in use by {}; stop it, or choose another folder with --data", folder.display(),
        owner(*pid)
    )]
    Locked {
        /// The folder.
        folder: PathBuf,
        /// The process that uses it, where it could be read.
        pid: Option<u32>,
    },
    /// The disk is full, or nearly.
    #[error("no space left in {}; free {} MiB or more, the queue goes on by itself", folder.display(),
        needed_bytes.div_ceil(1 << 20))]
    DiskFull {
        /// The folder of the queue.
        folder: PathBuf,
        /// What is needed beyond what is free, bytes.
        needed_bytes: u64,
    },
    /// The file system said no.
    #[error("cannot {what} {}: {why}", path.display())]
    Io {
        /// What was tried.
        what: &'static str,
        /// On which file.
        path: PathBuf,
        /// What the system answered.
        why: String,
    },
    /// The records cannot be read or written.
    #[error("the records of the queue in {} cannot be used: {why}", path.display())]
    Ledger {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, and what to do.
        why: String,
    },
    /// The shot cannot be rendered as it is.
    #[error("the shot is not taken: {0}")]
    Unfit(String),
    /// Too many shots.
    #[error("{SHOTS_MAX} shots wait already; submit again when some are done")]
    Full,
    /// Terrain of the shot is not here.
    #[error("{} blobs of its terrain are not here; send them first", .0.len())]
    Missing(Vec<BlobHash>),
    /// Too many hashes in one question.
    #[error("{0} hashes in one question; at most {MISSING_MAX}")]
    TooMany(usize),
    /// A blob is not what it is called.
    #[error("the blob is not {expected}: its hash is {found}; send it again")]
    WrongBlob {
        /// What it was called.
        expected: BlobHash,
        /// What it is.
        found: BlobHash,
    },
    /// What was submitted under a key before is something else.
    #[error(
        "the key {key:?} was used for {shot}, which is another submission; use a new key for each shot, \
         and the same one only to send the same again"
    )]
    KeyReused {
        /// The key.
        key: String,
        /// What it stands for.
        shot: ShotId,
    },
    /// None of the queue's shots.
    #[error("there is no {0} in the queue; \"terrafarm shots\" lists those that are")]
    NoShot(ShotId),
    /// The shot has no such frame.
    #[error("{shot} has the frames {first} to {last}; {frame} is none of them")]
    NoFrame {
        /// The shot.
        shot: ShotId,
        /// Number of its first frame.
        first: FrameIndex,
        /// Number of its last frame.
        last: FrameIndex,
        /// What was asked for.
        frame: FrameIndex,
    },
    /// The shot is over.
    #[error("{shot} is {}; nothing can be changed about it", state.name())]
    Over {
        /// The shot.
        shot: ShotId,
        /// How it ended.
        state: ShotState,
    },
    /// The farm refused.
    #[error(transparent)]
    Order(#[from] OrderError),
    /// A mistake of this program.
    #[error("a part of the queue failed; the coordinator's log says where")]
    Broken,
    /// The coordinator is stopping.
    #[error("the coordinator stops")]
    Stopping,
}

fn owner(pid: Option<u32>) -> String {
    pid.map_or("another coordinator".into(), |pid| format!("the coordinator with process {pid}"))
}

/// What makes a submission that is sent again the same one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SubmissionKey {
    key: String,
    /// SHA-256 of what was submitted.
    content: BlobHash,
}

impl SubmissionKey {
    /// The key of a submission with this content; drawn at random by whoever submits.
    ///
    /// # Errors
    /// [`QueueError::Unfit`] unless it has 1 to [`KEY_BYTES_MAX`] visible ASCII characters.
    pub fn new(key: &str, content: &[u8]) -> Result<Self, QueueError> {
        let visible = key.bytes().all(|symbol| symbol.is_ascii_graphic());
        if key.is_empty() || key.len() > KEY_BYTES_MAX || !visible {
            let why = format!("its key has to have 1 to {KEY_BYTES_MAX} visible ASCII characters");
            return Err(QueueError::Unfit(why));
        }
        Ok(SubmissionKey { key: key.to_owned(), content: hash_of(content) })
    }
}

/// Where the files of a shot are, or will be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ShotFiles {
    /// Its folder.
    pub folder: PathBuf,
    /// Number of its first frame within the flight.
    pub first_frame: FrameIndex,
    /// How many frames it has.
    pub frames: u32,
}

impl ShotFiles {
    /// The picture of a frame, by its number within the flight; `None` if the shot has no
    /// such frame.
    pub fn frame(&self, number: FrameIndex) -> Option<PathBuf> {
        let index = number.checked_sub(self.first_frame)?;
        (index < self.frames).then(|| picture(&self.folder, number))
    }

    /// What it was made of and what came out; there when the shot is done.
    pub fn manifest(&self) -> PathBuf {
        self.folder.join("manifest.json")
    }

    /// The film; there when the shot is done, if it was asked for.
    pub fn film(&self) -> PathBuf {
        self.folder.join("film.mp4")
    }
}

/// The folder of a shot.
fn shot_folder(queue: &Path, shot: ShotId) -> PathBuf {
    queue.join("shots").join(format!("{:06}", shot.0))
}

fn picture(folder: &Path, number: FrameIndex) -> PathBuf {
    folder.join(format!("frame_{number:05}.png"))
}

/// A way to the queue. Clones lead to the same one.
#[derive(Clone)]
pub struct Queue {
    commands: mpsc::Sender<Command>,
    list: watch::Receiver<ShotList>,
    blobs: Arc<Blobs>,
}

/// What the task is told by handles.
enum Command {
    Submit(Box<ShotPlan>, Option<SubmissionKey>, oneshot::Sender<Result<ShotId, QueueError>>),
    /// The shot of a submission that may have come before.
    Recall(SubmissionKey, oneshot::Sender<Result<Option<ShotId>, QueueError>>),
    Order(Order, oneshot::Sender<Result<String, QueueError>>),
    /// A blob came that may have been missed.
    Came(BlobHash),
}

/// The work of the queue: run it once.
pub struct QueueTask {
    task: Task,
}

impl QueueTask {
    /// Works until `stop` is cancelled. Whatever it is doing then may be cut off anywhere.
    pub async fn run(self, stop: CancellationToken) {
        self.task.run(stop).await;
    }
}

impl Queue {
    /// Opens the folder, or makes it, and reads what is there. Nothing happens until the
    /// task runs.
    ///
    /// # Errors
    /// If another coordinator uses the folder, it cannot be written, or what is in it
    /// cannot be read.
    pub async fn open(
        config: QueueConfig,
        farm: FarmLine,
    ) -> Result<(Queue, QueueTask), QueueError> {
        let (commands, inbox) = mpsc::channel(COMMANDS);
        let config = Arc::new(config);
        let blobs = Arc::new(Blobs::new(&config));
        let (task, list) = Task::open(config, blobs.clone(), farm, inbox).await?;
        Ok((Queue { commands, list, blobs }, QueueTask { task }))
    }

    /// Which of these blobs are not here. Those that are stay for a while.
    ///
    /// # Errors
    /// If they are too many in one question.
    pub async fn missing_blobs(&self, hashes: Vec<BlobHash>) -> Result<Vec<BlobHash>, QueueError> {
        if hashes.len() > MISSING_MAX {
            return Err(QueueError::TooMany(hashes.len()));
        }
        let blobs = self.blobs.clone();
        blocking(move || Ok(blobs.missing(hashes))).await
    }

    /// Keeps a blob, after checking that it is what it is called.
    ///
    /// # Errors
    /// If it is something else, or there is no room for it.
    pub async fn put_blob(&self, hash: BlobHash, bytes: Bytes) -> Result<(), QueueError> {
        let blobs = self.blobs.clone();
        blocking(move || blobs.put(hash, &bytes)).await?;
        // The task may have ended; the blob is there all the same.
        let _ = self.commands.send(Command::Came(hash)).await;
        Ok(())
    }

    /// Takes a shot. When this returns, it is on the disk.
    ///
    /// # Errors
    /// If it cannot be rendered, some of its terrain is not here, or there is no room.
    pub async fn submit(&self, plan: ShotPlan) -> Result<ShotId, QueueError> {
        self.take(plan, None).await
    }

    /// As [`Queue::submit`], once for each key: who is not sure whether a submission has come
    /// sends it again with its key, and gets the number of the shot that it was. Keys are
    /// remembered for [`KEY_KEPT`] at least, restarts included.
    ///
    /// # Errors
    /// As [`Queue::submit`], and [`QueueError::KeyReused`].
    pub async fn submit_once(
        &self,
        plan: ShotPlan,
        key: SubmissionKey,
    ) -> Result<ShotId, QueueError> {
        // First, since terrain and room may be gone that the shot had when it was taken.
        match self.ask(|answer| Command::Recall(key.clone(), answer)).await? {
            Some(shot) => Ok(shot),
            None => self.take(plan, Some(key)).await,
        }
    }

    async fn take(&self, plan: ShotPlan, key: Option<SubmissionKey>) -> Result<ShotId, QueueError> {
        let blobs = self.blobs.clone();
        let plan = blocking(move || {
            plan.check()?;
            blobs.has_room()?;
            blobs.complete(plan.index)?;
            Ok(plan)
        });
        let plan = Box::new(plan.await?);
        self.ask(|answer| Command::Submit(plan, key, answer)).await
    }

    /// Carries out an order about a shot of the queue: pause, resume, cancel, priority,
    /// and why a frame (by its number in the flight) is not done. When this returns, it
    /// has reached the farm and the disk.
    ///
    /// # Errors
    /// [`QueueError::NoShot`] if it is about anything else.
    pub async fn order(&self, order: Order) -> Result<String, QueueError> {
        self.ask(|answer| Command::Order(order, answer)).await
    }

    /// All shots, by number, those that are over included.
    pub fn shots(&self) -> ShotList {
        self.list.borrow().clone()
    }

    /// One shot.
    pub fn shot(&self, shot: ShotId) -> Option<Arc<ShotView>> {
        let list = self.list.borrow();
        let at = list.binary_search_by_key(&shot, |view| view.id).ok()?;
        list.get(at).cloned()
    }

    /// The list of shots whenever it changes: at once for what is submitted and ordered,
    /// a few times a second for frames.
    pub fn watch(&self) -> watch::Receiver<ShotList> {
        self.list.clone()
    }

    /// Where the files of a shot are.
    pub fn files(&self, shot: ShotId) -> Option<ShotFiles> {
        let view = self.shot(shot)?;
        let folder = shot_folder(self.blobs.queue(), shot);
        Some(ShotFiles { folder, first_frame: view.first_frame, frames: view.frames })
    }

    async fn ask<T>(
        &self,
        command: impl FnOnce(oneshot::Sender<Result<T, QueueError>>) -> Command,
    ) -> Result<T, QueueError> {
        let (answer, answered) = oneshot::channel();
        self.commands.send(command(answer)).await.map_err(|_| QueueError::Stopping)?;
        answered.await.map_err(|_| QueueError::Stopping)?
    }
}

/// Runs what waits for a disk where that harms nobody.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, QueueError> + Send + 'static,
) -> Result<T, QueueError> {
    let broken = |why: tokio::task::JoinError| match why.is_panic() {
        true => QueueError::Broken,
        false => QueueError::Stopping,
    };
    tokio::task::spawn_blocking(work).await.map_err(broken)?
}

#[cfg(test)]
pub(crate) mod tests;
