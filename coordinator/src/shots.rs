//! The shots under way: what was submitted, what has come back, what it took.

use crate::blobs::ClientId;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use terrafarm_common::accuracy::Summary;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{FrameIndex, ShotId, WorkerId};
use terrafarm_common::image::Rgb8;
use terrafarm_common::region::Region;
use terrafarm_film::{Film, FilmError, Merge};
use terrafarm_sched::{Event, MAX_SHOTS, Micros};
use terrafarm_wire::limits::WORKER_SHARES_MAX;
use terrafarm_wire::message::{
    Accepted, Cameras, Frame, RenderReport, ShotDone, Submit, Timesheet, WorkerShare,
};
use tokio::sync::mpsc;

/// Most frames of all shots together: their cameras take about 0.5 GB.
const CAMERAS_MAX: u64 = 4 << 20;
/// Memory for frames that are begun and not yet taken, all shots together, bytes.
const FILM_BYTES_MAX: u64 = 8 << 30;
/// Most shots of one client at once.
const SHOTS_PER_CLIENT: usize = 64;

/// Where the pixels of a lease belong.
#[derive(Debug, Clone, Copy)]
pub struct Granted {
    /// To whom it was granted.
    pub worker: WorkerId,
    /// The shot.
    pub shot: ShotId,
    /// The frame.
    pub frame: FrameIndex,
    /// The pixels.
    pub region: Region,
}

/// One shot.
#[derive(Debug)]
pub struct Shot {
    /// Whose it is.
    pub client: ClientId,
    /// Whether it is one of the queue on disk.
    pub queued: bool,
    /// What was submitted.
    pub submit: Submit,
    /// One camera a frame, as far as they have arrived.
    pub cameras: Vec<Camera>,
    /// The number of each frame within the flight, ascending; empty if it is the index.
    numbers: Vec<FrameIndex>,
    /// When it was submitted.
    pub since: Micros,
    /// When progress was last told.
    pub progress_at: Micros,
    /// Frames finished.
    pub frames_done: u32,
    /// Frames given up.
    pub frames_failed: u32,
    /// Where its pixels are merged.
    film: Film,
    /// Frames begun and not finished.
    open_frames: BTreeMap<FrameIndex, OpenFrame>,
    jobs: u64,
    jobs_granted: u64,
    report: RenderReport,
    shares: BTreeMap<String, WorkerShare>,
    /// Who has to hear of complete frames that are not believed any more.
    doubts: Option<mpsc::UnboundedSender<Doubt>>,
}

impl Shot {
    /// The number of a frame within the flight, by which people know it.
    pub fn number(&self, frame: FrameIndex) -> FrameIndex {
        self.numbers.get(frame as usize).copied().unwrap_or(frame)
    }

    /// Says that complete frames have pixels of a worker that is not believed any more;
    /// false if nobody is there to have them rendered again.
    pub fn doubt(&self, doubt: Doubt) -> bool {
        self.doubts.as_ref().is_some_and(|doubts| doubts.send(doubt).is_ok())
    }

    /// What the scheduler is told of it.
    fn submitted(&self, id: ShotId) -> Event {
        Event::ShotSubmitted {
            shot: id,
            frames: self.submit.frames,
            width: self.submit.width,
            height: self.submit.height,
            split: self.submit.split,
            priority: self.submit.priority,
            frames_in_flight: self.submit.frames_in_flight,
            live: self.submit.live,
        }
    }
}

/// A frame on its way.
#[derive(Debug)]
pub struct OpenFrame {
    since: Micros,
    jobs: u32,
    report: RenderReport,
    check: Option<Summary>,
    picture: Option<Rgb8>,
}

/// All shots.
#[derive(Debug, Default)]
pub struct Shots {
    shots: BTreeMap<ShotId, Shot>,
    /// The last number given to a shot; the queue on disk counts with the same counter.
    last: Arc<AtomicU64>,
    cameras: u64,
    film_bytes: u64,
}

/// Memory that the frames of a shot may take at the coordinator, bytes.
fn film_bytes(submit: &Submit) -> u64 {
    u64::from(submit.width) * u64::from(submit.height) * 3 * u64::from(submit.frames_in_flight)
}

/// A shot of the queue on disk, which has its number already.
#[derive(Debug)]
pub struct Adoption {
    /// Its number.
    pub shot: ShotId,
    /// What is to be rendered.
    pub submit: Submit,
    /// One camera a frame.
    pub cameras: Vec<Camera>,
    /// The number of each frame within the flight: not all of it is always missing.
    pub numbers: Vec<FrameIndex>,
    /// Where to say that complete frames are not believed any more: before anything that is
    /// said of the shot later.
    pub doubts: mpsc::UnboundedSender<Doubt>,
}

/// Complete frames with pixels of a worker that is not believed any more.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Doubt {
    /// Its name.
    pub worker: String,
    /// The first and the last frame of each run, as the farm counts the shot's.
    pub frames: Vec<(FrameIndex, FrameIndex)>,
}

impl Shots {
    /// No shots; the next one gets the number after the counter's.
    pub fn counted_by(last: Arc<AtomicU64>) -> Self {
        Shots { last, ..Shots::default() }
    }

    /// A shot.
    pub fn get(&self, shot: ShotId) -> Option<&Shot> {
        self.shots.get(&shot)
    }

    /// A shot.
    pub fn get_mut(&mut self, shot: ShotId) -> Option<&mut Shot> {
        self.shots.get_mut(&shot)
    }

    /// All of them.
    pub fn iter(&self) -> impl Iterator<Item = (ShotId, &Shot)> {
        self.shots.iter().map(|(&id, shot)| (id, shot))
    }

    /// Whether the shot is this client's.
    pub fn belongs_to(&self, shot: ShotId, client: ClientId) -> bool {
        self.shots.get(&shot).is_some_and(|state| state.client == client)
    }

    /// The shots of a client.
    pub fn of_client(&self, client: ClientId) -> Vec<ShotId> {
        let own = self.shots.iter().filter(|(_, shot)| shot.client == client);
        own.map(|(id, _)| *id).collect()
    }

    /// Takes a submission; its cameras follow.
    ///
    /// # Errors
    /// If there is no room for it, in words for the user.
    pub fn submit(&mut self, client: ClientId, submit: Submit, now: Micros) -> Result<(), String> {
        let own: Vec<_> = self.shots.values().filter(|shot| shot.client == client).collect();
        if own.iter().any(|shot| shot.submit.number == submit.number) {
            return Err(format!("shot number {} is in use on this connection", submit.number));
        }
        if own.len() >= SHOTS_PER_CLIENT {
            return Err(format!("{SHOTS_PER_CLIENT} shots of this client are under way already"));
        }
        self.check_room(&submit)?;
        let id = ShotId(self.last.fetch_add(1, Ordering::Relaxed) + 1);
        self.insert(id, client, submit, now);
        Ok(())
    }

    /// Takes a shot of the queue on disk, with all its cameras: it begins at once.
    ///
    /// # Errors
    /// If there is no room for it now, in words for the user.
    pub fn adopt(
        &mut self,
        client: ClientId,
        adoption: Adoption,
        now: Micros,
    ) -> Result<(Accepted, Event), String> {
        let Adoption { shot, submit, cameras, numbers, doubts } = adoption;
        if self.shots.contains_key(&shot) {
            return Err(format!("{shot} is under way already"));
        }
        if self.shots.len() >= MAX_SHOTS {
            return Err(format!("{MAX_SHOTS} shots are under way already"));
        }
        self.check_room(&submit)?;
        let (number, size) = (submit.number, (submit.width, submit.height));
        let sized = cameras.iter().all(|camera| (camera.width, camera.height) == size);
        let counted = cameras.len() == submit.frames as usize && numbers.len() == cameras.len();
        if !counted || !sized {
            return Err("the cameras do not fit the shot".into());
        }
        let state = self.insert(shot, client, submit, now);
        state.queued = true;
        state.cameras = cameras;
        state.numbers = numbers;
        state.doubts = Some(doubts);
        Ok((Accepted { number, shot }, state.submitted(shot)))
    }

    fn check_room(&self, submit: &Submit) -> Result<(), String> {
        if self.cameras + u64::from(submit.frames) > CAMERAS_MAX {
            return Err(format!(
                "the farm holds {} frames and takes {CAMERAS_MAX} at most; submit again later",
                self.cameras
            ));
        }
        let film = film_bytes(submit);
        if self.film_bytes.saturating_add(film) > FILM_BYTES_MAX {
            return Err(format!(
                "{} frames of {} x {} pixels in flight need {} MiB of the coordinator's memory, and {} \
                 MiB are left; use fewer --frames-in-flight or smaller pictures",
                submit.frames_in_flight,
                submit.width,
                submit.height,
                film >> 20,
                (FILM_BYTES_MAX - self.film_bytes) >> 20
            ));
        }
        Ok(())
    }

    fn insert(&mut self, id: ShotId, client: ClientId, submit: Submit, now: Micros) -> &mut Shot {
        self.film_bytes += film_bytes(&submit);
        self.cameras += u64::from(submit.frames);
        let shot = Shot {
            client,
            queued: false,
            cameras: Vec::new(),
            numbers: Vec::new(),
            since: now,
            progress_at: now,
            frames_done: 0,
            frames_failed: 0,
            film: Film::new(submit.frames_in_flight as usize),
            open_frames: BTreeMap::new(),
            jobs: 0,
            jobs_granted: 0,
            report: RenderReport::default(),
            shares: BTreeMap::new(),
            doubts: None,
            submit,
        };
        self.shots.entry(id).insert_entry(shot).into_mut()
    }

    /// Adds cameras to a submission; when the last one is there, the shot begins.
    ///
    /// # Errors
    /// If they do not continue what came before: a shot that has not begun is dropped.
    pub fn add_cameras(
        &mut self,
        client: ClientId,
        cameras: &Cameras,
    ) -> Result<Option<(Accepted, Event)>, String> {
        let number = cameras.number;
        let found = self
            .shots
            .iter_mut()
            .find(|(_, shot)| shot.client == client && shot.submit.number == number);
        let Some((&id, shot)) = found else {
            return Err("cameras of a shot that was not submitted".into());
        };
        let total = shot.submit.frames as usize;
        if shot.cameras.len() == total {
            return Err("the shot has all its cameras and is under way".into());
        }
        let sized = |camera: &Camera| {
            camera.width == shot.submit.width && camera.height == shot.submit.height
        };
        if shot.cameras.len() != cameras.first as usize
            || shot.cameras.len() + cameras.cameras.len() > total
            || !cameras.cameras.iter().all(sized)
        {
            self.remove(id);
            return Err("the cameras do not fit the shot".into());
        }
        shot.cameras.extend_from_slice(&cameras.cameras);
        if shot.cameras.len() < total {
            return Ok(None);
        }
        Ok(Some((Accepted { number, shot: id }, shot.submitted(id))))
    }

    /// A job of a frame is granted: the frame is open from the first one on.
    pub fn begin_frame(&mut self, shot: ShotId, frame: FrameIndex, now: Micros) -> Option<&Shot> {
        let state = self.shots.get_mut(&shot)?;
        state.jobs_granted += 1;
        if !state.film.is_open(frame) {
            let (width, height) = (state.submit.width, state.submit.height);
            if let Err(why) = state.film.open(frame, width, height) {
                tracing::error!(%shot, "{why}");
                return None;
            }
        }
        state.open_frames.entry(frame).or_insert_with(|| OpenFrame {
            since: now,
            jobs: 0,
            report: RenderReport::default(),
            check: None,
            picture: None,
        });
        Some(state)
    }

    /// Counts a job whose pixels are used.
    pub fn count_job(
        &mut self,
        shot: ShotId,
        frame: FrameIndex,
        worker: &str,
        report: &RenderReport,
        check: Option<&Summary>,
    ) {
        let Some(state) = self.shots.get_mut(&shot) else { return };
        state.jobs += 1;
        add(&mut state.report, report);
        if let Some(open) = state.open_frames.get_mut(&frame) {
            open.jobs += 1;
            add(&mut open.report, report);
            if let Some(check) = check {
                open.check.get_or_insert_default().merge(check);
            }
        }
        if let Some(share) = state.shares.get_mut(worker) {
            share.jobs += 1;
            share.cost_us = share.cost_us.saturating_add(report.cost_us);
        }
    }

    /// A worker is granted its first job of a shot.
    pub fn begin_share(&mut self, shot: ShotId, worker: &str, now: Micros) {
        let Some(state) = self.shots.get_mut(&shot) else { return };
        if state.shares.len() < WORKER_SHARES_MAX && !state.shares.contains_key(worker) {
            let first_us = now.since(state.since);
            let share = WorkerShare {
                name: worker.to_owned(),
                jobs: 0,
                cost_us: 0,
                first_us,
                last_us: first_us,
                timesheet: Timesheet::default(),
            };
            state.shares.insert(worker.to_owned(), share);
        }
    }

    /// Counts the time of a worker, whose result may have been refused.
    pub fn count_time(&mut self, shot: ShotId, worker: &str, sheet: &Timesheet, now: Micros) {
        let Some(state) = self.shots.get_mut(&shot) else { return };
        if let Some(share) = state.shares.get_mut(worker) {
            share.count(sheet, now.since(state.since));
        }
    }

    /// Puts pixels in their place. A picture that is whole is kept until the scheduler
    /// says that its frame is complete.
    ///
    /// # Errors
    /// If they do not fit; nothing is changed then.
    pub fn merge(
        &mut self,
        shot: ShotId,
        frame: FrameIndex,
        region: Region,
        pixels: &[u8],
    ) -> Result<(), FilmError> {
        let Some(state) = self.shots.get_mut(&shot) else { return Ok(()) };
        if let Merge::Complete(picture) = state.film.merge(frame, region, pixels)?
            && let Some(open) = state.open_frames.get_mut(&frame)
        {
            open.picture = Some(picture);
        }
        Ok(())
    }

    /// Forgets pixels that were merged into an open frame; they will come again.
    pub fn retract(&mut self, shot: ShotId, frame: FrameIndex, region: Region) {
        let Some(state) = self.shots.get_mut(&shot) else { return };
        if !state.film.retract(frame, region) {
            tracing::error!(%shot, frame, ?region, "pixels to take back that are not there");
        }
    }

    /// A frame is complete: its message (still without pixels) and its picture.
    pub fn finish_frame(
        &mut self,
        shot: ShotId,
        frame: FrameIndex,
        now: Micros,
    ) -> Option<(ClientId, FrameHead, Rgb8)> {
        let state = self.shots.get_mut(&shot)?;
        let open = state.open_frames.remove(&frame)?;
        state.frames_done += 1;
        let head = FrameHead {
            shot,
            frame,
            number: state.number(frame),
            jobs: open.jobs,
            report: open.report,
            check: open.check,
            elapsed_us: now.since(open.since),
        };
        Some((state.client, head, open.picture?))
    }

    /// A frame is given up.
    pub fn frame_failed(&mut self, shot: ShotId, frame: FrameIndex) -> Option<&Shot> {
        let state = self.shots.get_mut(&shot)?;
        state.open_frames.remove(&frame);
        state.film.discard(frame);
        state.frames_failed += 1;
        Some(state)
    }

    /// The last word on a shot.
    pub fn summary(&self, shot: ShotId, now: Micros) -> Option<(ClientId, ShotDone)> {
        let state = self.shots.get(&shot)?;
        let done = ShotDone {
            shot,
            frames_done: state.frames_done,
            frames_failed: state.frames_failed,
            jobs: state.jobs,
            jobs_repeated: state.jobs_granted.saturating_sub(state.jobs),
            elapsed_us: now.since(state.since),
            report: state.report,
            workers: state.shares.values().filter(|share| share.jobs > 0).cloned().collect(),
        };
        Some((state.client, done))
    }

    /// Forgets a shot.
    pub fn remove(&mut self, shot: ShotId) -> Option<Shot> {
        let state = self.shots.remove(&shot)?;
        self.cameras -= u64::from(state.submit.frames);
        self.film_bytes -= film_bytes(&state.submit);
        Some(state)
    }
}

/// A frame's message without its pixels.
#[derive(Debug, Clone)]
pub struct FrameHead {
    shot: ShotId,
    frame: FrameIndex,
    number: FrameIndex,
    jobs: u32,
    report: RenderReport,
    check: Option<Summary>,
    elapsed_us: u64,
}

impl FrameHead {
    /// Which frame of which shot, by its number within the flight.
    pub fn place(&self) -> (ShotId, FrameIndex) {
        (self.shot, self.number)
    }

    /// The message with its pixels.
    pub fn with(self, pixels: terrafarm_wire::pixels::Pixels) -> Frame {
        let FrameHead { shot, frame, jobs, report, check, elapsed_us, .. } = self;
        Frame { shot, frame, jobs, report, elapsed_us, check, pixels }
    }
}

fn add(sum: &mut RenderReport, part: &RenderReport) {
    sum.cost_us = sum.cost_us.saturating_add(part.cost_us);
    sum.rays = sum.rays.saturating_add(part.rays);
    sum.steps = sum.steps.saturating_add(part.steps);
    sum.fallbacks = sum.fallbacks.saturating_add(part.fallbacks);
    sum.coarser = sum.coarser.saturating_add(part.coarser);
    sum.below_ground |= part.below_ground;
}
