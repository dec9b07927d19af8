//! The side that submits: sends a shot, supplies its terrain by hash, takes its frames.
//!
//! A coordinator that goes away is waited for: what has come is kept, what is missing is
//! submitted again.

use crate::dial::{DialError, GREETING_LIMIT, dial};
use bytes::Bytes;
use std::sync::Arc;
use std::time::{Duration, Instant};
use terrafarm_common::accuracy::{Share, Summary};
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, FrameIndex, MAX_SHOT_FRAMES, ShotId};
use terrafarm_common::image::Rgb8;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Split;
use terrafarm_common::shading::Shading;
use terrafarm_terrain::store::StoreReader;
use terrafarm_wire::limits::{CAMERAS_MAX, NEWEST_VERSION, clip_name, clip_reason};
use terrafarm_wire::link::{self, HandshakeError, LinkError, Outbox, Trust, Unsent};
use terrafarm_wire::message::{
    Blob, Cameras, Cancel, Frame, FrameTaken, Goodbye, Message, NoBlob, Ping, Pong, Progress, Role,
    ShotDone, Submit, WantBlobs,
};
use terrafarm_wire::{WireError, encode};
use tokio::sync::mpsc::{self, error::TrySendError};
use tokio_util::sync::CancellationToken;

/// Messages that may wait for the coordinator on each lane.
const URGENT_QUEUE: usize = 256;
/// Blobs that may wait: a few megabytes.
const BULK_QUEUE: usize = 16;
/// Questions for blobs that may wait: as many as a coordinator has blobs to wait for. They
/// are always read, for whoever does not read does not notice that a coordinator is gone.
const WANTS_QUEUE: usize = 1 << 16;
/// The first pause before a lost coordinator is tried again; each further one is twice as
/// long ...
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// ... up to this.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);
/// The number of the only shot on a connection.
const NUMBER: u32 = 1;

/// What is to be rendered.
pub struct Submission {
    /// What to call it.
    pub name: String,
    /// Its terrain.
    pub store: Arc<StoreReader>,
    /// Light, air and sky.
    pub shading: Shading,
    /// Method, tolerance and samples.
    pub quality: Quality,
    /// What share of the pixels is to be measured.
    pub check: Share,
    /// How frames are cut into jobs.
    pub split: Split,
    /// One camera a frame, all of one size; at least one.
    pub cameras: Vec<Camera>,
    /// Frames that may be begun and not yet taken.
    pub frames_in_flight: u32,
    /// Shots of a higher priority come first.
    pub priority: i32,
    /// Whether somebody waits for each frame.
    pub live: bool,
}

/// What comes back while a shot is rendered.
#[derive(Debug)]
pub enum Update {
    /// A finished frame; answer with its index on the `taken` channel when it is stored.
    Frame(FrameIndex, Rgb8, FrameFacts),
    /// A frame that could not be made, and why.
    FrameFailed(FrameIndex, String),
    /// How far it is.
    Progress(Progress),
    /// The coordinator was lost, for this reason, and is tried again.
    Lost(String),
}

/// What a frame took.
#[derive(Debug, Clone)]
pub struct FrameFacts {
    /// Number of jobs it was made of.
    pub jobs: u32,
    /// Time that workers rendered, all jobs together, microseconds.
    pub cost_us: u64,
    /// From the first grant to the last pixels, microseconds.
    pub elapsed_us: u64,
    /// Samples that the method could not do its own way and gave a ray of their own.
    pub fallbacks: u64,
    /// Pixels that show coarser terrain, because it had not come: in live shots only.
    pub coarser: u64,
    /// Whether the camera was below the ground.
    pub below_ground: bool,
    /// The errors of the pixels that were measured, if any were to be.
    pub check: Option<Summary>,
}

/// Why a shot did not come to its end.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// There is no coordinator, or it does not let us in.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// The connection was lost.
    #[error("the coordinator was lost: {0}; frames that have come are kept")]
    Link(#[from] LinkError),
    /// No farm would take the shot: it was not sent.
    #[error("the shot fits no farm: {0}")]
    Unfit(String),
    /// The farm does not take the shot, or gave it up.
    #[error("the farm refused the shot: {0}")]
    Refused(String),
    /// The user stopped it.
    #[error("stopped")]
    Stopped,
}

/// Where a coordinator is, and how it is known.
#[derive(Debug, Clone)]
pub struct Coordinator {
    /// `host:port`.
    pub address: String,
    /// Which links are trusted.
    pub trust: Trust,
    /// How long a coordinator that was lost is waited for; one that never answered is not.
    pub patience: Duration,
}

impl Coordinator {
    /// One on this PC that nobody restarts.
    pub fn local(address: impl ToString) -> Self {
        let address = address.to_string();
        Coordinator { address, trust: Trust::Loopback, patience: Duration::ZERO }
    }
}

/// Submits a shot and carries it to its end. Frames arrive in any order on `updates`, each
/// once; each has to be answered on `taken`, else no further ones come. A coordinator that
/// is lost is tried again, and gets what is still missing.
///
/// # Errors
/// If the shot fits no farm, there is no coordinator, it refuses, it stays away for longer
/// than is waited, or `stop` is cancelled.
pub async fn render(
    coordinator: &Coordinator,
    submission: Submission,
    updates: mpsc::Sender<Update>,
    mut taken: mpsc::Receiver<FrameIndex>,
    stop: CancellationToken,
) -> Result<ShotDone, ClientError> {
    let began = Instant::now();
    submission.check()?;
    let mut errand = Errand {
        missing: (0..submission.cameras.len() as FrameIndex).collect(),
        frames_done: 0,
        frames_failed: 0,
        was_accepted: false,
        submission,
    };
    let mut lost_at = None;
    let mut pause = FIRST_PAUSE;
    loop {
        errand.was_accepted = false;
        let attempt = errand.attempt(coordinator, &updates, &mut taken, &stop);
        let why = match attempt.await {
            Ok(done) => {
                let (frames_done, frames_failed) = (errand.frames_done, errand.frames_failed);
                let elapsed_us = began.elapsed().as_micros() as u64;
                return Ok(ShotDone { frames_done, frames_failed, elapsed_us, ..done });
            }
            Err(why) => why,
        };
        if errand.was_accepted {
            (lost_at, pause) = (Some(Instant::now()), FIRST_PAUSE);
        }
        match lost_at {
            Some(at) if why.may_pass() && at.elapsed() < coordinator.patience => {}
            _ => return Err(why),
        }
        if updates.send(Update::Lost(why.to_string())).await.is_err() {
            return Err(ClientError::Stopped);
        }
        tokio::select! {
            // Back-off: a coordinator that restarts is not stormed by its clients.
            () = tokio::time::sleep(pause) => {}
            () = stop.cancelled() => return Err(ClientError::Stopped),
        }
        pause = (2 * pause).min(LONGEST_PAUSE);
    }
}

impl ClientError {
    /// Whether the coordinator may take the shot when it is tried again.
    fn may_pass(&self) -> bool {
        match self {
            ClientError::Dial(DialError::Connect { .. }) | ClientError::Link(_) => true,
            ClientError::Dial(DialError::Handshake { source, .. }) => match source {
                HandshakeError::Refused { refusal, .. } | HandshakeError::TurnedAway(refusal) => {
                    refusal.is_temporary()
                }
                // Somebody answered, but died at it; a token that was right stays right.
                _ => true,
            },
            ClientError::Unfit(_) | ClientError::Refused(_) | ClientError::Stopped => false,
        }
    }
}

/// A shot, and how much of it has come.
struct Errand {
    submission: Submission,
    /// Frames that have not come, in order: those that the next coordinator is asked for.
    missing: Vec<FrameIndex>,
    frames_done: u32,
    frames_failed: u32,
    /// Whether the last coordinator took the shot.
    was_accepted: bool,
}

impl Errand {
    /// One connection, from the greeting to the last frame.
    async fn attempt(
        &mut self,
        coordinator: &Coordinator,
        updates: &mpsc::Sender<Update>,
        taken: &mut mpsc::Receiver<FrameIndex>,
        stop: &CancellationToken,
    ) -> Result<ShotDone, ClientError> {
        let (connection, welcome) = tokio::select! {
            greeted = dial(&coordinator.address, &coordinator.trust, &self.submission.name, Role::Client) => greeted?,
            () = stop.cancelled() => return Err(ClientError::Stopped),
        };
        let silence = Duration::from_micros(welcome.silence_us);
        let (mut reader, writer) = connection.split();
        let (outbox, queues) = link::outbox(URGENT_QUEUE, BULK_QUEUE);
        let mut writing = tokio::spawn(writer.run(queues));
        let (wants, wanted) = mpsc::channel(WANTS_QUEUE);
        let store = self.submission.store.clone();
        let serving = tokio::spawn(serve_blobs(store, wanted, outbox.clone()));
        // What this coordinator numbers from 0 on.
        let asked = self.missing.clone();
        let plan = self.submission.plan(&asked);
        let submitting = tokio::spawn(send_submission(plan, outbox.clone()));

        let mut talk = Talk::new(&self.submission, asked.len());
        let mut heartbeat = tokio::time::interval(Duration::from_micros(welcome.heartbeat_us));
        let mut is_written = false;
        let result = loop {
            if let Some(done) = talk.finished() {
                break Ok(done);
            }
            self.was_accepted |= talk.id.is_some();
            tokio::select! {
                () = stop.cancelled() => {
                    if let Some(shot) = talk.id {
                        let _ = outbox.send(Cancel { shot }).await;
                    }
                    break Err(ClientError::Stopped);
                }
                Some(frame) = taken.recv() => {
                    // One from before the coordinator was lost is no news to this one.
                    if let (Some(shot), Ok(index)) = (talk.id, asked.binary_search(&frame)) {
                        let taken = FrameTaken { shot, frame: index as FrameIndex };
                        if let Err(why) = outbox.send(taken).await {
                            break Err(why.into());
                        }
                    }
                }
                // A full lane means that the coordinator hears from us in any case.
                _ = heartbeat.tick() => if outbox.try_send(Ping { number: 0 }) == Err(Unsent::Closed) {
                    break Err(LinkError::Closed.into());
                },
                received = reader.recv_within(silence) => match received {
                    Ok(Some(Message::WantBlobs(want))) => {
                        if let Err(TrySendError::Full(_)) = wants.try_send(want) {
                            let why = "it asks for more blobs than it can wait for";
                            break Err(ClientError::Refused(why.into()));
                        }
                    }
                    Ok(Some(Message::Ping(ping))) => {
                        if outbox.try_send(Pong { number: ping.number }) == Err(Unsent::Closed) {
                            break Err(LinkError::Closed.into());
                        }
                    }
                    Ok(Some(message)) => match talk.hear(message).map(|said| self.note(said, &asked)) {
                        // Old news when there is room for it again.
                        Ok(Some(update @ Update::Progress(_))) => {
                            let _ = updates.try_send(update);
                        }
                        Ok(Some(update)) => {
                            // The receiver ends first only when writing failed.
                            if updates.send(update).await.is_err() {
                                break Err(ClientError::Stopped);
                            }
                        }
                        Ok(None) => {}
                        Err(why) => break Err(why),
                    },
                    Ok(None) => break Err(LinkError::Closed.into()),
                    Err(why) => break Err(why.into()),
                },
                // A link that broke is noticed by reading, too, behind what was still to come.
                written = &mut writing, if !is_written => {
                    is_written = true;
                    if let Ok(Err(LinkError::Wire(why))) = written {
                        break Err(ClientError::Unfit(why.to_string()));
                    }
                }
            }
        };
        submitting.abort();
        serving.abort();
        let stuck = writing.abort_handle();
        // On a link that is dead, what waits to be sent would wait for ever.
        if !is_written && !matches!(result, Err(ClientError::Link(_))) {
            let farewell = async {
                let _ = outbox.send(Goodbye { reason: "the shot is over".into() }).await;
                drop(outbox);
                writing.await
            };
            let _ = tokio::time::timeout(GREETING_LIMIT, farewell).await;
        }
        stuck.abort();
        result
    }

    /// Notes what has come; a frame that nobody waits for is dropped.
    fn note(&mut self, update: Option<Update>, asked: &[FrameIndex]) -> Option<Update> {
        let mut take = |index: FrameIndex| {
            let frame = *asked.get(index as usize)?;
            let at = self.missing.binary_search(&frame).ok()?;
            self.missing.remove(at);
            Some(frame)
        };
        match update? {
            Update::Frame(index, picture, facts) => {
                let frame = take(index)?;
                self.frames_done += 1;
                Some(Update::Frame(frame, picture, facts))
            }
            Update::FrameFailed(index, reason) => {
                let frame = take(index)?;
                self.frames_failed += 1;
                Some(Update::FrameFailed(frame, reason))
            }
            Update::Progress(mut progress) => {
                let before = self.submission.cameras.len() - asked.len();
                progress.frames_done = progress.frames_done.saturating_add(before as u32);
                Some(Update::Progress(progress))
            }
            other => Some(other),
        }
    }
}

/// What is known of the shot on this side.
struct Talk {
    id: Option<ShotId>,
    size: (u32, u32),
    frames: u64,
    seen: u64,
    done: Option<ShotDone>,
}

impl Talk {
    fn new(submission: &Submission, frames: usize) -> Self {
        let size =
            submission.cameras.first().map_or((0, 0), |camera| (camera.width, camera.height));
        Talk { id: None, size, frames: frames as u64, seen: 0, done: None }
    }

    /// The summary, once every frame has come: it may overtake the last frames, which are
    /// long.
    fn finished(&mut self) -> Option<ShotDone> {
        if self.seen >= self.frames { self.done.take() } else { None }
    }

    fn hear(&mut self, message: Message) -> Result<Option<Update>, ClientError> {
        match message {
            Message::Accepted(accepted) => self.id = Some(accepted.shot),
            Message::Rejected(rejected) => return Err(ClientError::Refused(rejected.reason)),
            Message::ShotFailed(failed) => return Err(ClientError::Refused(failed.reason)),
            Message::ShotDone(done) => self.done = Some(done),
            Message::Progress(progress) => return Ok(Some(Update::Progress(progress))),
            Message::FrameFailed(failed) => {
                self.seen += 1;
                return Ok(Some(Update::FrameFailed(failed.frame, failed.reason)));
            }
            Message::Frame(frame) => {
                self.seen += 1;
                return self.unpack(frame).map(Some);
            }
            // Pongs, and kinds of a later version.
            _ => {}
        }
        Ok(None)
    }

    fn unpack(&self, frame: Frame) -> Result<Update, ClientError> {
        let index = frame.frame;
        let (picture, facts) = unpack(frame, self.size).map_err(ClientError::Refused)?;
        Ok(Update::Frame(index, picture, facts))
    }
}

/// The picture in a frame's message, and what it took.
///
/// # Errors
/// If the pixels do not make a picture of this size, in words.
pub(crate) fn unpack(frame: Frame, size: (u32, u32)) -> Result<(Rgb8, FrameFacts), String> {
    let (width, height) = size;
    let expected = width as usize * height as usize * 3;
    let unusable = |why: String| format!("a frame is unusable: {why}");
    let pixels = frame.pixels.unpack(expected).map_err(|why| unusable(why.to_string()))?;
    let picture = Rgb8::from_pixels(width, height, Vec::from(pixels))
        .ok_or_else(|| unusable("its size is wrong".into()))?;
    let facts = FrameFacts {
        jobs: frame.jobs,
        cost_us: frame.report.cost_us,
        elapsed_us: frame.elapsed_us,
        fallbacks: frame.report.fallbacks,
        coarser: frame.report.coarser,
        below_ground: frame.report.below_ground,
        check: frame.check,
    };
    Ok((picture, facts))
}

/// What the submitting task sends.
struct Plan {
    submit: Submit,
    cameras: Vec<Camera>,
}

impl Submission {
    /// Refuses what the encoder would refuse, before anybody is bothered with it.
    fn check(&self) -> Result<(), ClientError> {
        let frames = self.cameras.len();
        if frames > MAX_SHOT_FRAMES as usize {
            return Err(ClientError::Unfit(format!(
                "{frames} frames; one shot has {MAX_SHOT_FRAMES} at most, so render it in parts, \
                 each some of the frames"
            )));
        }
        let unfit = |why: WireError| ClientError::Unfit(why.to_string());
        encode(NEWEST_VERSION, &self.submit(frames as u32).into()).map_err(unfit)?;
        for cameras in self.cameras.chunks(CAMERAS_MAX) {
            let piece = Cameras { number: NUMBER, first: 0, cameras: cameras.to_vec() };
            encode(NEWEST_VERSION, &piece.into()).map_err(unfit)?;
        }
        Ok(())
    }

    /// A plan of these frames.
    fn plan(&self, frames: &[FrameIndex]) -> Plan {
        let cameras = frames.iter().map(|&frame| self.cameras[frame as usize]).collect();
        Plan { submit: self.submit(frames.len() as u32), cameras }
    }

    /// The message that submits so many frames.
    fn submit(&self, frames: u32) -> Submit {
        let (index, _) = self.store.index_blob();
        let (width, height) =
            self.cameras.first().map_or((1, 1), |camera| (camera.width, camera.height));
        Submit {
            number: NUMBER,
            name: clip_name(&self.name),
            index,
            shading: self.shading.clone(),
            quality: self.quality,
            check: self.check,
            width,
            height,
            split: self.split,
            frames,
            frames_in_flight: self.frames_in_flight,
            priority: self.priority,
            live: self.live,
        }
    }
}

async fn send_submission(plan: Plan, outbox: Outbox) -> Result<(), LinkError> {
    outbox.send(plan.submit).await?;
    for (piece, cameras) in plan.cameras.chunks(CAMERAS_MAX).enumerate() {
        let first = (piece * CAMERAS_MAX) as FrameIndex;
        outbox.send(Cameras { number: NUMBER, first, cameras: cameras.to_vec() }).await?;
    }
    Ok(())
}

/// Answers questions for terrain, one after the other: the disk is read as fast as the
/// link takes it, and no faster.
async fn serve_blobs(
    store: Arc<StoreReader>,
    mut wanted: mpsc::Receiver<WantBlobs>,
    outbox: Outbox,
) -> Result<(), LinkError> {
    while let Some(want) = wanted.recv().await {
        for hash in want.hashes {
            let from = store.clone();
            let read = tokio::task::spawn_blocking(move || read_blob(&from, hash)).await;
            match read {
                Ok(Ok(bytes)) => outbox.send(Blob { hash, bytes }).await?,
                Ok(Err(why)) => {
                    tracing::error!(%hash, "cannot supply a blob: {why}");
                    outbox.send(NoBlob { hash, why: clip_reason(&why) }).await?;
                }
                Err(_) => outbox.send(NoBlob { hash, why: "reading it failed".into() }).await?,
            }
        }
    }
    Ok(())
}

fn read_blob(store: &StoreReader, hash: BlobHash) -> Result<Bytes, String> {
    let (index_hash, index) = store.index_blob();
    if hash == index_hash {
        return Ok(Bytes::copy_from_slice(index));
    }
    store.read_blob(&hash).map(Bytes::from).map_err(|why| why.to_string())
}

#[cfg(test)]
mod tests;
