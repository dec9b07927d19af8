//! The task of the queue: the one place where book, ledger, disk and farm meet.
//!
//! It waits for the disk and the farm, never for a worker or a person. Pictures are
//! written side by side on threads for blocking work; whatever is written when it looks
//! again becomes one transaction of the ledger. Each stay of a shot in the farm is a
//! client of its own, so that what comes late of an earlier stay cannot be taken for a
//! frame of this one.

mod close;
mod doubt;
mod show;
mod stay;

use super::blobs::Blobs;
use super::book::{Book, Move};
use super::disk::{self, FolderLock};
use super::ledger::{FrameRecord, Ledger, Progress, Saved, ShotRecord, Stage};
use super::pictures::Unfinished;
use super::{
    Command, QueueConfig, QueueError, SHOTS_MAX, ShotFiles, ShotList, ShotPlan, SubmissionKey,
    blocking, shot_folder,
};
use crate::driver::FarmLine;
use crate::order::{Order, OrderError};
use doubt::Doubted;
use stay::{Picture, Stay, StayId};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId};
use terrafarm_wire::Message;
use tokio::sync::{Semaphore, mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::{CancellationToken, DropGuard};

/// News of its own work that may wait for the task.
const NEWS: usize = 1024;
/// Pictures that are written at once: they wait for the disk together.
const WRITERS: usize = 16;
/// How often frames are shown.
const LOOK: Duration = Duration::from_millis(200);
/// How often terrain is looked through for what nobody needs.
const SWEEP: Duration = Duration::from_secs(3600);

/// What threads for blocking work need.
pub(super) struct Shared {
    pub config: Arc<QueueConfig>,
    pub blobs: Arc<Blobs>,
    ledger: Mutex<Ledger>,
    /// Let go of when the last write has ended.
    _lock: FolderLock,
}

/// What the task hears of its own work.
enum News {
    /// The frames that a shot lacks have been read.
    Read(StayId, Result<Vec<(FrameIndex, Camera)>, QueueError>),
    /// The farm said something.
    Said(StayId, Box<Message>),
    /// The farm gave the client up.
    Hung(StayId),
    /// The farm asks for terrain that is not here.
    Lacks(StayId, BlobHash),
    /// The disk does not read terrain that the farm asks for.
    Unread(StayId, BlobHash),
    /// Frames of a shot have pixels of a worker that is not believed any more.
    Doubted(Doubted),
    /// A picture was written, or not.
    Stored(Picture, Result<u64, QueueError>),
    /// A shot was finished, or not.
    Finished(ShotId, Result<String, Unfinished>),
    /// Terrain was looked through.
    Swept(Result<u64, QueueError>),
}

/// A frame that is over and not yet recorded.
struct Outcome {
    stay: StayId,
    /// Its index among the frames of that stay.
    frame: FrameIndex,
    shot: ShotId,
    index: FrameIndex,
    record: FrameRecord,
}

/// Everything that the queue knows.
pub(super) struct Task {
    shared: Arc<Shared>,
    farm: FarmLine,
    inbox: mpsc::Receiver<Command>,
    list: watch::Sender<ShotList>,
    book: Book,
    stays: HashMap<StayId, Stay>,
    by_shot: BTreeMap<ShotId, StayId>,
    last_stay: u64,
    news: mpsc::Receiver<News>,
    tell: mpsc::Sender<News>,
    /// Ends with the task.
    errands: JoinSet<()>,
    writers: Arc<Semaphore>,
    /// To be recorded with the next transaction.
    outcomes: Vec<Outcome>,
    /// Pictures for which there was no room.
    unwritten: Vec<Picture>,
    /// Frames on their way to the disk that are not believed any more: they are rendered
    /// again. By shot, so that those of earlier stays are forgotten with a new one.
    distrusted: BTreeSet<(ShotId, StayId, FrameIndex)>,
    /// Doubts that the disk did not let be recorded.
    doubts: Vec<Doubted>,
    /// Why nothing goes on: the disk is full or fails.
    stalled: Option<QueueError>,
    /// The shot whose film is being made, and what stops that when it is dropped.
    finishing: Option<(ShotId, Option<DropGuard>)>,
    /// How often pictures of a shot were found damaged.
    losses: BTreeMap<ShotId, u32>,
    swept: Option<Instant>,
    is_sweeping: bool,
    changed: BTreeSet<ShotId>,
}

impl Task {
    /// Opens the folder and reads what is there.
    pub async fn open(
        config: Arc<QueueConfig>,
        blobs: Arc<Blobs>,
        farm: FarmLine,
        inbox: mpsc::Receiver<Command>,
    ) -> Result<(Task, watch::Receiver<ShotList>), QueueError> {
        let path = config.folder.join("queue.redb");
        let active = config.active;
        let opened = tokio::task::spawn_blocking(move || {
            let lock = FolderLock::take(&config.folder)?;
            let mut ledger = Ledger::open(&config.folder.join("queue.redb"))?;
            let (last, saved) = ledger.load()?;
            disk::sync_folder(&config.folder)
                .map_err(|why| disk::error(&config.folder, "sync", &config.folder, &why))?;
            let shared = Shared { config, blobs, ledger: Mutex::new(ledger), _lock: lock };
            Ok::<_, QueueError>((shared, last, saved))
        });
        // A file that is damaged beyond what its reader expects must not end the program.
        let damaged = |_| QueueError::Ledger { path, why: "it is damaged; move it away".into() };
        let (shared, last, saved) = opened.await.map_err(damaged)??;
        farm.last_shot().fetch_max(last, Ordering::Relaxed);
        let (tell, news) = mpsc::channel(NEWS);
        let (list, view) = watch::channel(ShotList::default());
        let mut task = Task {
            shared: Arc::new(shared),
            farm,
            inbox,
            list,
            book: Book::new(saved, active),
            stays: HashMap::new(),
            by_shot: BTreeMap::new(),
            last_stay: 0,
            news,
            tell,
            errands: JoinSet::new(),
            writers: Arc::new(Semaphore::new(WRITERS)),
            outcomes: Vec::new(),
            unwritten: Vec::new(),
            distrusted: BTreeSet::new(),
            doubts: Vec::new(),
            stalled: None,
            finishing: None,
            losses: BTreeMap::new(),
            swept: None,
            is_sweeping: false,
            changed: BTreeSet::new(),
        };
        task.changed = task.book.iter().map(|(id, _)| id).collect();
        task.publish();
        Ok((task, view))
    }

    /// Works until it is told to stop.
    pub async fn run(mut self, stop: CancellationToken) {
        let mut retry = tokio::time::interval(self.shared.config.retry);
        let mut look = tokio::time::interval(LOOK);
        retry.set_missed_tick_behavior(MissedTickBehavior::Delay);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        // What was cut off between its last frame and the next step.
        self.check_all().await;
        loop {
            self.settle().await;
            tokio::select! {
                () = stop.cancelled() => break,
                Some(command) = self.inbox.recv() => self.obey(command).await,
                Some(news) = self.news.recv() => {
                    self.hear(news).await;
                    // What is here already joins the same transaction.
                    while let Ok(news) = self.news.try_recv() {
                        self.hear(news).await;
                    }
                }
                _ = look.tick() => self.publish(),
                _ = retry.tick() => self.try_again().await,
                Some(_) = self.errands.join_next() => {}
            }
        }
    }

    /// Does whatever is due.
    async fn settle(&mut self) {
        self.record().await;
        if self.stalled.is_some() {
            return;
        }
        for step in self.book.moves() {
            match step {
                Move::Enter(shot) => self.enter(shot),
                Move::Leave(shot) => self.leave(shot).await,
            }
        }
        self.finish_next();
        self.sweep();
    }

    async fn hear(&mut self, news: News) {
        match news {
            News::Read(stay, frames) => self.submit_frames(stay, frames).await,
            News::Said(stay, message) => self.hear_farm(stay, *message).await,
            News::Hung(stay) => {
                if let Some(shot) = self.stays.get(&stay).map(|stay| stay.shot) {
                    tracing::warn!(%shot, "the farm gave the queue up; the shot is submitted again");
                    self.leave(shot).await;
                }
            }
            News::Lacks(stay, hash) => {
                // It may have come since.
                let is_here = self.is_here(hash).await;
                self.lacks(stay, hash, !is_here).await;
            }
            News::Unread(stay, hash) => self.lacks(stay, hash, true).await,
            News::Doubted(doubted) => self.doubt(doubted).await,
            News::Stored(picture, stored) => self.stored(picture, stored).await,
            News::Finished(shot, result) => self.finished(shot, result).await,
            News::Swept(result) => {
                self.is_sweeping = false;
                match result {
                    Ok(0) => {}
                    Ok(bytes) => tracing::info!(bytes, "removed terrain that no shot needs"),
                    Err(why) => tracing::warn!("terrain was not tidied: {why}"),
                }
            }
        }
    }

    async fn obey(&mut self, command: Command) {
        match command {
            Command::Recall(key, answer) => {
                let _ = answer.send(self.recall(&key).await);
            }
            Command::Submit(plan, key, answer) => {
                let submitted = self.submit(*plan, key).await;
                self.publish();
                // Who asked may have gone; the shot is there all the same.
                let _ = answer.send(submitted);
            }
            Command::Order(order, answer) => {
                let carried_out = self.order(order).await;
                // Shown before it is answered: whoever looks then sees it.
                self.publish();
                let _ = answer.send(carried_out);
            }
            Command::Came(hash) => {
                for shot in self.book.lacking(hash) {
                    self.book.set_lacks(shot, None);
                    self.changed.insert(shot);
                    self.sync_pause(shot).await;
                }
            }
        }
    }

    /// The shot that was submitted with this key, if there was one.
    async fn recall(&self, key: &SubmissionKey) -> Result<Option<ShotId>, QueueError> {
        let SubmissionKey { key, content } = key.clone();
        let text = key.clone();
        match self.ledger(move |ledger| ledger.recall(&text)).await? {
            Some((shot, before)) if before != content => Err(QueueError::KeyReused { key, shot }),
            known => Ok(known.map(|(shot, _)| shot)),
        }
    }

    async fn submit(
        &mut self,
        mut plan: ShotPlan,
        key: Option<SubmissionKey>,
    ) -> Result<ShotId, QueueError> {
        // It may have come twice at the same time.
        if let Some(key) = &key
            && let Some(shot) = self.recall(key).await?
        {
            return Ok(shot);
        }
        if self.book.unfinished() >= SHOTS_MAX {
            return Err(QueueError::Full);
        }
        let cameras = std::mem::take(&mut plan.cameras);
        let record = ShotRecord {
            frames: cameras.len() as u32,
            submitted_s: SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs(),
            stage: Stage::Open,
            note: String::new(),
            workers: Vec::new(),
            history: Vec::new(),
            plan,
        };
        let id = ShotId(self.farm.last_shot().fetch_add(1, Ordering::Relaxed) + 1);
        let kept = record.clone();
        self.ledger(move |ledger| ledger.add(id, &kept, &cameras, key.as_ref())).await?;
        tracing::info!(shot = %id, name = %record.plan.name, frames = record.frames, "queued");
        self.book.add(Saved { id, record, progress: Progress::default() });
        self.changed.insert(id);
        Ok(id)
    }

    /// The farm first, since people wait for it; then the disk, which is what counts.
    async fn order(&mut self, order: Order) -> Result<String, QueueError> {
        let record = self.book.ordered(order)?;
        let (id, text) = match order {
            Order::Why(id, frame) => return self.why(id, frame).await,
            Order::Clear(..) | Order::Drain(_) => return Ok(self.farm.order(order).await?),
            Order::Pause(id) => (id, format!("{id} waits")),
            Order::Resume(id) => (id, format!("{id} goes on")),
            Order::Cancel(id) => (id, format!("{id} is canceled; its finished frames stay")),
            Order::Prioritise(id, priority) => (id, format!("{id} has priority {priority}")),
        };
        let Some(record) = record else { return Ok(text) };
        if self.by_shot.contains_key(&id) {
            let at_once = if let Order::Cancel(id) = order { Order::Pause(id) } else { order };
            // What the farm does not know of it does not render either.
            if !matches!(order, Order::Resume(_)) {
                let _ = self.farm.order(at_once).await;
            }
        }
        if let Err(why) = self.keep(id, record).await {
            if let (Order::Prioritise(..), Some(shot)) = (order, self.book.get(id)) {
                let before = Order::Prioritise(id, shot.record.plan.priority);
                let _ = self.farm.order(before).await;
            }
            self.sync_pause(id).await;
            return Err(why);
        }
        if let Order::Cancel(_) = order {
            self.give_up(id).await;
        }
        self.sync_pause(id).await;
        Ok(text)
    }

    /// Writes the record of a shot; then it is true.
    async fn keep(&mut self, id: ShotId, record: ShotRecord) -> Result<(), QueueError> {
        let kept = record.clone();
        self.ledger(move |ledger| ledger.put(id, &kept)).await?;
        self.book.set(id, record);
        self.changed.insert(id);
        Ok(())
    }

    /// Why a frame is not done.
    async fn why(&mut self, id: ShotId, frame: FrameIndex) -> Result<String, QueueError> {
        let shot = self.book.get(id).ok_or(QueueError::NoShot(id))?;
        let (first, frames) = (shot.record.plan.first_frame, shot.record.frames);
        let index = frame.checked_sub(first).filter(|index| *index < frames);
        let last = first + frames.saturating_sub(1);
        let index = index.ok_or(QueueError::NoFrame { shot: id, first, last, frame })?;
        match self.ledger(move |ledger| ledger.frame(id, index)).await? {
            Some(Some(FrameRecord::Done { .. })) => return Ok("it is done".into()),
            Some(Some(FrameRecord::Failed(reason))) => return Ok(format!("it failed: {reason}")),
            Some(None) => {
                return Ok(
                    "its record is damaged: it is rendered again when the rest is done".into()
                );
            }
            None => {}
        }
        let view = self.view(id).ok_or(QueueError::NoShot(id))?;
        let asked = self.by_shot.get(&id).and_then(|stay| self.stays.get(stay));
        let asked = asked.and_then(|stay| stay.frames.binary_search(&index).ok());
        use crate::view::ShotState;
        Ok(match (view.state, asked) {
            (ShotState::Running, Some(at)) => {
                match self.farm.order(Order::Why(id, at as FrameIndex)).await {
                    Err(OrderError::NoShot(_)) => "it has been rendered and is being stored".into(),
                    answer => answer?,
                }
            }
            (ShotState::Waiting | ShotState::Running, _) => match self.book.before(id) {
                _ if !view.note.is_empty() => format!("the shot waits: {}", view.note),
                0 => "its shot is about to begin".into(),
                before => format!("{before} shots of the queue are before its own"),
            },
            (ShotState::Paused, _) => "its shot is paused".into(),
            (ShotState::Stalled, _) => format!("its shot cannot go on: {}", view.note),
            (state, _) => format!("its shot is {}", state.name()),
        })
    }

    /// Has something done with the records, where waiting for a disk harms nobody.
    async fn ledger<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Ledger) -> Result<T, QueueError> + Send + 'static,
    ) -> Result<T, QueueError> {
        let shared = self.shared.clone();
        blocking(move || shared.with_ledger(work)).await
    }

    /// Whether a blob of terrain can be had.
    async fn is_here(&self, hash: BlobHash) -> bool {
        let blobs = self.shared.blobs.clone();
        let missing = blocking(move || Ok(blobs.missing(vec![hash]))).await;
        missing.is_ok_and(|missing| missing.is_empty())
    }

    fn files(&self, id: ShotId, record: &ShotRecord) -> ShotFiles {
        ShotFiles {
            folder: shot_folder(&self.shared.config.folder, id),
            first_frame: record.plan.first_frame,
            frames: record.frames,
        }
    }
}

impl Shared {
    fn with_ledger<T>(
        &self,
        work: impl FnOnce(&mut Ledger) -> Result<T, QueueError>,
    ) -> Result<T, QueueError> {
        // A call that panicked left no half of a transaction.
        work(&mut self.ledger.lock().unwrap_or_else(PoisonError::into_inner))
    }
}
