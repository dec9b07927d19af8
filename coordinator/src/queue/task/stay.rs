//! A stay of a shot in the farm: in with the frames that are missing, terrain there,
//! frames back, out.

use super::doubt::Doubted;
use super::{FrameRecord, News, Outcome, QueueError, Stage, Task};
use crate::blobs::ClientId;
use crate::client::unpack;
use crate::driver::FarmLine;
use crate::farm::PeerEvent;
use crate::order::Order;
use crate::queue::blobs::Blobs;
use crate::queue::{blocking, pictures};
use crate::shots::{Adoption, Doubt};
use crate::sink::manifest::{FrameEntry, WorkerEntry};
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId};
use terrafarm_common::image::Rgb8;
use terrafarm_sched::LostReason;
use terrafarm_wire::limits::{WORKER_SHARES_MAX, clip_reason};
use terrafarm_wire::link::OutboxEnd;
use terrafarm_wire::message::{Blob, Frame, FrameTaken, Message, NoBlob, WantBlobs, WorkerShare};
use tokio::sync::mpsc;

/// Clients inside this process have numbers that no connection reaches.
const FIRST_CLIENT: u64 = 1 << 62;
/// Questions for terrain that may wait for the disk.
const WANTS: usize = 256;
/// Frames whose times say how fast a shot is.
const LATELY: usize = 32;

/// One stay of a shot in the farm; numbers are never used again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct StayId(u64);

impl StayId {
    fn client(self) -> ClientId {
        ClientId(FIRST_CLIENT + self.0)
    }
}

/// What is known of a stay.
pub struct Stay {
    /// Whose it is.
    pub shot: ShotId,
    /// The shot's index of each frame that was submitted, in order; empty while they are
    /// being read.
    pub frames: Arc<[FrameIndex]>,
    /// Whether the farm has taken it.
    pub is_accepted: bool,
    /// Frames that have come or failed.
    seen: usize,
    /// Whether the farm has said its last word on it.
    is_done: bool,
    /// When the last frames were recorded.
    pub lately: VecDeque<Instant>,
}

/// A finished frame on its way to the disk.
pub struct Picture {
    pub stay: StayId,
    /// Its index among the frames of that stay.
    pub frame: FrameIndex,
    shot: ShotId,
    index: FrameIndex,
    pub entry: FrameEntry,
    pub pixels: Arc<Rgb8>,
}

impl Picture {
    /// Whose frame it is.
    pub fn shot(&self) -> ShotId {
        self.shot
    }
}

impl Task {
    /// Begins a stay: reads what is missing.
    pub fn enter(&mut self, shot: ShotId) {
        let Some(state) = self.book.get(shot) else { return };
        let (record, files) = (state.record.clone(), self.files(shot, &state.record));
        self.last_stay += 1;
        let id = StayId(self.last_stay);
        let stay = Stay {
            shot,
            frames: Arc::default(),
            is_accepted: false,
            seen: 0,
            is_done: false,
            lately: VecDeque::new(),
        };
        self.stays.insert(id, stay);
        self.by_shot.insert(shot, id);
        self.book.set_present(shot, true);
        // Nothing of earlier stays is on its way to the disk any more.
        self.distrusted.retain(|(other, ..)| *other != shot);
        let (shared, tell) = (self.shared.clone(), self.tell.clone());
        self.errands.spawn(async move {
            let read = blocking(move || {
                pictures::tidy(&files.folder);
                shared.with_ledger(|ledger| ledger.missing(shot, &record))
            });
            let read = read.await;
            let _ = tell.send(News::Read(id, read)).await;
        });
    }

    /// Ends the stay of a shot, if there is one. What has come of it is kept.
    pub async fn leave(&mut self, shot: ShotId) {
        let Some(id) = self.by_shot.remove(&shot) else { return };
        self.stays.remove(&id);
        self.book.set_present(shot, false);
        self.changed.insert(shot);
        let gone = PeerEvent::Gone(LostReason::Left, "the queue has its shot back".into());
        let _ = self.farm.tell(id.client(), gone).await;
    }

    /// The frames that a shot lacks are known: the farm gets them.
    pub async fn submit_frames(
        &mut self,
        id: StayId,
        frames: Result<Vec<(FrameIndex, Camera)>, QueueError>,
    ) {
        let Some(shot) = self.stays.get(&id).map(|stay| stay.shot) else { return };
        let Some(state) = self.book.get(shot) else { return };
        let frames = match frames {
            Ok(frames) => frames,
            Err(QueueError::Unfit(why)) => return self.fail(shot, why).await,
            Err(why) => {
                self.leave(shot).await;
                return self.stall(why).await;
            }
        };
        let submit = state.record.plan.submission(0, frames.len() as u32);
        let (numbers, cameras): (Vec<_>, Vec<_>) = frames.into_iter().unzip();
        if numbers.is_empty() {
            self.leave(shot).await;
            return self.check_complete(shot).await;
        }
        let name = format!("queue, {shot}");
        let Ok(end) = self.farm.join(id.client(), &name).await else { return };
        let first = state.record.plan.first_frame;
        let in_flight = numbers.iter().map(|index| first + index).collect();
        let numbers: Arc<[_]> = numbers.into();
        if let Some(stay) = self.stays.get_mut(&id) {
            stay.frames = numbers.clone();
        }
        let (doubts, doubted) = mpsc::unbounded_channel();
        let ear = Ear { id, shot, frames: numbers, end, doubted, tell: self.tell.clone() };
        self.errands.spawn(attend(ear, self.farm.clone(), self.shared.blobs.clone()));
        let adoption = Box::new(Adoption { shot, submit, cameras, numbers: in_flight, doubts });
        let _ = self.farm.tell(id.client(), PeerEvent::Adopt(adoption)).await;
        self.sync_pause(shot).await;
    }

    /// Has the farm render a shot, or wait with it, as things are now.
    pub async fn sync_pause(&mut self, shot: ShotId) {
        let (Some(state), true) = (self.book.get(shot), self.by_shot.contains_key(&shot)) else {
            return;
        };
        let may_run =
            state.record.stage == Stage::Open && state.may_go_on() && self.stalled.is_none();
        let order = if may_run { Order::Resume(shot) } else { Order::Pause(shot) };
        // The farm may not know it yet: then this is called again.
        let _ = self.farm.order(order).await;
        self.changed.insert(shot);
    }

    /// The farm said something to the client of a stay.
    pub async fn hear_farm(&mut self, id: StayId, message: Message) {
        let Some(stay) = self.stays.get_mut(&id) else { return };
        let shot = stay.shot;
        match message {
            Message::Accepted(_) => {
                stay.is_accepted = true;
                self.sync_pause(shot).await;
            }
            Message::Rejected(rejected) => {
                tracing::info!(%shot, "not yet in the farm: {}", rejected.reason);
                self.leave(shot).await;
                self.book.set_refused(shot, Some(rejected.reason));
            }
            Message::ShotFailed(failed) => self.fail(shot, failed.reason).await,
            Message::Frame(frame) => self.take(id, frame).await,
            Message::FrameFailed(failed) => {
                stay.seen += 1;
                let Some(&index) = stay.frames.get(failed.frame as usize) else { return };
                self.book.count_in_hand(shot, 1);
                let record = FrameRecord::Failed(failed.reason);
                let frame = failed.frame;
                self.outcomes.push(Outcome { stay: id, frame, shot, index, record });
            }
            Message::ShotDone(done) => {
                stay.is_done = true;
                self.count_workers(shot, &done.workers);
                self.check_complete(shot).await;
            }
            // The farm goes with the coordinator, and the queue with both.
            _ => {}
        }
    }

    /// A frame came: to the disk with it.
    async fn take(&mut self, id: StayId, frame: Frame) {
        let Some(stay) = self.stays.get_mut(&id) else { return };
        stay.seen += 1;
        let (shot, number) = (stay.shot, frame.frame);
        let (Some(&index), Some(state)) = (stay.frames.get(number as usize), self.book.get(shot))
        else {
            return;
        };
        if self.distrusted.remove(&(shot, id, number)) {
            self.taken(id, number).await;
            return self.check_complete(shot).await;
        }
        let plan = &state.record.plan;
        let (size, samples) = (plan.size, plan.quality.samples_per_side);
        let at = plan.first_frame + index;
        match unpack(frame, (size[0], size[1])) {
            Ok((pixels, facts)) => {
                let entry = FrameEntry::new(at, &pixels, &facts, samples);
                self.book.count_in_hand(shot, 1);
                let pixels = Arc::new(pixels);
                self.write(Picture { stay: id, frame: number, shot, index, entry, pixels });
            }
            Err(why) => {
                tracing::error!(%shot, frame = at, "{why}; it is rendered again");
                self.check_complete(shot).await;
            }
        }
    }

    /// Writes a picture, with others side by side.
    pub fn write(&mut self, picture: Picture) {
        let Some(state) = self.book.get(picture.shot) else { return };
        let files = self.files(picture.shot, &state.record);
        let Some(path) = files.frame(picture.entry.index) else { return };
        let (shared, tell) = (self.shared.clone(), self.tell.clone());
        let (writers, pixels) = (self.writers.clone(), picture.pixels.clone());
        self.errands.spawn(async move {
            let Ok(_turn) = writers.acquire().await else { return };
            let config = shared.config.clone();
            let stored = blocking(move || {
                // Held so that nobody else opens the folder while this is written.
                let _shared = shared;
                pictures::store(&config.folder, config.reserve_bytes, &path, &pixels)
            });
            let stored = stored.await;
            let _ = tell.send(News::Stored(picture, stored)).await;
        });
    }

    /// A picture is on the disk, or found no room there.
    pub async fn stored(&mut self, picture: Picture, stored: Result<u64, QueueError>) {
        match stored {
            Ok(_) if self.distrusted.remove(&(picture.shot, picture.stay, picture.frame)) => {
                self.drop_in_hand(picture.shot, picture.stay, picture.frame).await;
                self.check_complete(picture.shot).await;
            }
            Ok(bytes) => {
                let Picture { stay, frame, shot, index, entry, .. } = picture;
                let record = FrameRecord::Done { entry, bytes };
                self.outcomes.push(Outcome { stay, frame, shot, index, record });
            }
            Err(why) => {
                let shot = picture.shot;
                self.unwritten.push(picture);
                self.hold(shot, why).await;
            }
        }
    }

    /// A frame is recorded: the farm may send the next one.
    pub async fn taken(&mut self, id: StayId, frame: FrameIndex) {
        let Some(stay) = self.stays.get_mut(&id) else { return };
        stay.lately.push_back(Instant::now());
        if stay.lately.len() > LATELY {
            stay.lately.pop_front();
        }
        let taken = FrameTaken { shot: stay.shot, frame };
        let _ = self.farm.tell(id.client(), PeerEvent::Said(taken.into())).await;
    }

    /// Whether all that a stay promised has come, used or not.
    pub fn is_spent(&self, shot: ShotId) -> bool {
        let stay = self.by_shot.get(&shot).and_then(|id| self.stays.get(id));
        stay.is_none_or(|stay| stay.is_done && stay.seen >= stay.frames.len())
    }

    /// Terrain of a shot could not be given: it waits until someone sends it, or it can be
    /// had again, unless it is here by now.
    pub async fn lacks(&mut self, id: StayId, hash: BlobHash, waits: bool) {
        let Some(shot) = self.stays.get(&id).map(|stay| stay.shot) else { return };
        let index = self.book.get(shot).map(|state| state.record.plan.index);
        if let (Some(index), true) = (index, waits) {
            tracing::warn!(%shot, %hash, "terrain is damaged or gone; the shot waits for it");
            let blobs = self.shared.blobs.clone();
            if let Err(why) = blocking(move || blobs.suspect_store(index)).await {
                tracing::warn!(%shot, "its terrain cannot be looked through: {why}");
            }
        }
        self.book.set_lacks(shot, waits.then_some(hash));
        // First its jobs are stopped, else they would fail.
        self.sync_pause(shot).await;
        let why = clip_reason("the queue has it no longer");
        let answer = PeerEvent::Said(NoBlob { hash, why }.into());
        let _ = self.farm.tell(id.client(), answer).await;
    }

    fn count_workers(&mut self, shot: ShotId, shares: &[WorkerShare]) {
        let Some(state) = self.book.get(shot) else { return };
        let mut record = state.record.clone();
        for share in shares {
            let has_room = record.workers.len() < WORKER_SHARES_MAX;
            match record.workers.iter_mut().find(|worker| worker.name == share.name) {
                Some(worker) => {
                    worker.jobs += share.jobs;
                    worker.render_ms += share.cost_us as f64 / 1e3;
                }
                None if has_room => {
                    record.workers.push(WorkerEntry::new(share));
                }
                None => {}
            }
        }
        // Written with the next change of the shot.
        self.book.set(shot, record);
    }
}

/// What hears the farm for one stay.
struct Ear {
    id: StayId,
    shot: ShotId,
    frames: Arc<[FrameIndex]>,
    end: OutboxEnd,
    doubted: mpsc::UnboundedReceiver<Doubt>,
    tell: mpsc::Sender<News>,
}

impl Ear {
    /// Passes on what the farm says, until it closes the line or the queue has ended.
    async fn hear(mut self, wants: mpsc::Sender<WantBlobs>) {
        loop {
            let heard = tokio::select! {
                Some(doubt) = self.doubted.recv() => Err(doubt),
                message = self.end.recv() => match message {
                    Some(message) => Ok(message),
                    None => return,
                },
            };
            let sent = match heard {
                Err(doubt) => self.doubt(doubt).await,
                Ok(Message::WantBlobs(want)) => wants.send(want).await.is_ok(),
                Ok(Message::Progress(_) | Message::Pong(_)) => true,
                Ok(other) => {
                    // What is doubted was said before: the last word on a shot must not
                    // overtake it.
                    let mut sent = true;
                    while let (Ok(doubt), true) = (self.doubted.try_recv(), sent) {
                        sent = self.doubt(doubt).await;
                    }
                    sent && self.tell.send(News::Said(self.id, Box::new(other))).await.is_ok()
                }
            };
            if !sent {
                return;
            }
        }
    }

    async fn doubt(&self, doubt: Doubt) -> bool {
        let Doubt { worker, frames } = doubt;
        let all = frames.into_iter().flat_map(|(first, last)| first..=last);
        let known = all.filter_map(|frame| Some((frame, *self.frames.get(frame as usize)?)));
        let doubted = Doubted { stay: self.id, shot: self.shot, worker, frames: known.collect() };
        self.tell.send(News::Doubted(doubted)).await.is_ok()
    }
}

/// Hears the farm for one stay, and supplies its terrain, until the farm closes the line.
async fn attend(ear: Ear, farm: FarmLine, blobs: Arc<Blobs>) {
    let (wants, wanted) = mpsc::channel(WANTS);
    let (id, tell) = (ear.id, ear.tell.clone());
    tokio::select! {
        () = ear.hear(wants) => {}
        () = supply(id, wanted, &farm, &blobs, &tell) => {}
    }
    let _ = tell.send(News::Hung(id)).await;
}

/// Answers questions for terrain, one after the other.
async fn supply(
    id: StayId,
    mut wanted: mpsc::Receiver<WantBlobs>,
    farm: &FarmLine,
    blobs: &Arc<Blobs>,
    tell: &mpsc::Sender<News>,
) {
    while let Some(want) = wanted.recv().await {
        for hash in want.hashes {
            let from = blobs.clone();
            let told = match blocking(move || from.read(hash)).await {
                Ok(Some(bytes)) => {
                    let blob = PeerEvent::Said(Blob { hash, bytes }.into());
                    farm.tell(id.client(), blob).await.is_ok()
                }
                Ok(None) => tell.send(News::Lacks(id, hash)).await.is_ok(),
                Err(why) => {
                    tracing::error!(%hash, "cannot supply a blob: {why}");
                    tell.send(News::Unread(id, hash)).await.is_ok()
                }
            };
            if !told {
                return;
            }
        }
    }
}
