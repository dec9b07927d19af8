//! One shift: a worker's time on one connection, from the welcome to the goodbye.
//!
//! The shell around the [`Session`]: it carries out what the session asks for and tells
//! it what came of it. Everything slow happens elsewhere (rendering, decoding and disk on
//! the thread pool, writing in a task of its own), so that a heartbeat is answered at
//! once whatever else goes on.

mod early;
mod status;

use crate::clock::{TaskClock, Worked};
use crate::office::Gate;
use crate::render::{Caster, Check, Job, Outcome, Picture, Scene, said};
use crate::session::{Action, Doing, Event, Session};
use crate::share::{Others, Shelf};
use crate::terrain::Terrain;
use rayon::ThreadPool;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};
use terrafarm_common::id::{BlobHash, FrameIndex, LeaseId, ShotId};
use terrafarm_raycast::View;
use terrafarm_terrain::cache::BlobCache;
use terrafarm_terrain::codec::{self, CodecError};
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::{Resident, Tile};
use terrafarm_terrain::store::{decode_index, hash_of};
use terrafarm_wire::Message;
use terrafarm_wire::link::{Connection, Heard, LinkError, Outbox, Unsent, WHILE_IT_COMES, outbox};
use terrafarm_wire::message::{
    Blob, Done, Grant, OpenShot, Pong, RenderReport, Sharing, Speed, Status, Timesheet, Welcome,
};
use terrafarm_wire::pixels::Pixels;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};

/// Small messages that may wait for the writer.
const URGENT_MAX: usize = 256;
/// Pictures that may wait for the writer: one on its way, one behind it.
const BULK_MAX: usize = 2;
/// Answers of the thread pool that may wait; more hold the pool back.
const REPORTS_MAX: usize = 64;

/// What outlives a connection.
pub(crate) struct Site<C: Caster> {
    pub pool: ThreadPool,
    pub cache: Option<Arc<BlobCache>>,
    /// Whether it has failed to keep a blob.
    pub cache_failed: Arc<AtomicBool>,
    pub terrain: Terrain<C::Prepared>,
    pub caster: Arc<C>,
    pub gate: Gate,
    /// What a trial said of its speed.
    pub pixels_per_s: Option<u64>,
    /// Where others may ask for its blobs, if they may.
    pub shelf: Option<Shelf>,
    /// Terrain that others were given.
    pub given_bytes: Arc<AtomicU64>,
    pub others: Arc<Others>,
    /// Blobs that the coordinator sent and that were not what they should be.
    pub damaged: u64,
}

/// A go at a job: [`Job::advance`] or [`Job::settle`].
type Work<C> =
    fn(Box<Job<C>>, &C, &Scene<<C as Caster>::Prepared>, &Gate) -> Result<Outcome<C>, String>;

/// What the thread pool has done.
enum Report<C: Caster> {
    Absent(BlobHash),
    Damaged(BlobHash),
    Spoiled(BlobHash, String),
    Index(BlobHash, Box<Resident>, C::Prepared),
    Tile(BlobHash, Tile),
    /// A tile before its turn, or what is on disk until then.
    Early(BlobHash, Option<Tile>),
    Fetched(Blob),
    Unfetched(BlobHash),
    /// The tiles of a store that a frame will need.
    Glanced(BlobHash, (ShotId, FrameIndex), Vec<TileKey>),
    Done(Box<Done>, Worked),
    Missing(Box<Job<C>>, Vec<TileKey>),
    Stopped(LeaseId),
    Broken(LeaseId, String),
}

/// A worker on one connection.
pub(crate) struct Shift<'a, C: Caster> {
    site: &'a mut Site<C>,
    session: Session,
    compress: bool,
    silence: Duration,
    /// When it last said unasked that it lives.
    spoke: Instant,
    /// The store of the job that is begun, and how to stop it.
    current: Option<(BlobHash, Arc<AtomicBool>)>,
    paused: Option<Box<Job<C>>>,
    clock: TaskClock,
    /// Time of the pool for reading and unpacking terrain, nanoseconds of all threads.
    unpacking_ns: Arc<AtomicU64>,
    /// What the outbox had no room for, in order.
    backlog: VecDeque<Message>,
    ended: bool,
    /// What the coordinator was told last of how this worker is off.
    told: Option<Status>,
    /// Damaged blobs, and bytes given to others, before this shift.
    before: [u64; 2],
    reports: mpsc::Sender<Report<C>>,
    reported: mpsc::Receiver<Report<C>>,
}

impl<'a, C: Caster> Shift<'a, C> {
    /// A shift that has not begun. `compress` packs pixels for a network.
    pub fn new(site: &'a mut Site<C>, compress: bool, welcome: &Welcome) -> Self {
        let (reports, reported) = mpsc::channel(REPORTS_MAX);
        let before = site.damaged_and_given();
        Shift {
            site,
            session: Session::new(),
            compress,
            silence: Duration::from_micros(welcome.silence_us),
            spoke: Instant::now(),
            current: None,
            paused: None,
            clock: TaskClock::new(Instant::now()),
            unpacking_ns: Arc::default(),
            backlog: VecDeque::new(),
            ended: false,
            told: None,
            before,
            reports,
            reported,
        }
    }

    /// Works until every lease is answered and the worker may leave, or until the
    /// connection is lost, which is the error.
    pub async fn work<S>(
        mut self,
        connection: Connection<S>,
        stop: &CancellationToken,
    ) -> Result<(), LinkError>
    where
        S: AsyncRead + AsyncWrite + Send + 'static,
    {
        let (mut reader, writer) = connection.split();
        let (outbox, queues) = outbox(URGENT_MAX, BULK_MAX);
        let mut writing = tokio::spawn(writer.run(queues));
        if let Some(pixels_per_s) = self.site.pixels_per_s {
            outbox.send(Speed { pixels_per_s }).await?;
        }
        if let Some(shelf) = &self.site.shelf {
            self.backlog.push_back(Sharing { port: shelf.address().port() }.into());
        }
        let mut looks = status::looks();
        let mut asked_to_stop = false;
        while !(self.ended && self.backlog.is_empty()) {
            let waiting = self.backlog.front().cloned();
            let event = tokio::select! {
                heard = reader.hear(Some(self.silence)) => match heard {
                    Ok(Heard::Message(message)) => self.received(message, &outbox),
                    Ok(Heard::More) => self.speak_up(&outbox).map(|()| None),
                    Ok(Heard::Claim(_)) => Ok(None),
                    Ok(Heard::End) => Err(LinkError::Closed),
                    Err(lost) => Err(lost),
                },
                Some(report) = self.reported.recv() => Ok(Some(self.judge(report))),
                _ = looks.tick() => {
                    self.tell_status(&outbox);
                    Ok(None)
                }
                sent = send_waiting(&outbox, waiting) => sent.map(|()| {
                    matches!(self.backlog.pop_front(), Some(Message::Done(_))).then_some(Event::Sent)
                }),
                () = stop.cancelled(), if !asked_to_stop => {
                    asked_to_stop = true;
                    Ok(Some(Event::Leave("the worker was told to stop".to_owned())))
                }
                written = &mut writing => Err(written.ok().and_then(Result::err).unwrap_or(LinkError::Closed)),
            };
            match event {
                Ok(Some(event)) => self.handle(event, &outbox),
                Ok(None) => {}
                Err(lost) => {
                    self.stop_current();
                    writing.abort();
                    return Err(lost);
                }
            }
        }
        drop(outbox);
        // The farewell is worth as much time as any other message.
        match tokio::time::timeout(self.silence, &mut writing).await {
            Ok(_) => {}
            Err(_) => writing.abort(),
        }
        Ok(())
    }

    /// A message as an event; heartbeats are answered here.
    fn received(&mut self, message: Message, outbox: &Outbox) -> Result<Option<Event>, LinkError> {
        match message {
            Message::Ping(ping) => {
                // A full lane means that the coordinator will hear from us in any case.
                if outbox.try_send(Pong { number: ping.number }) == Err(Unsent::Closed) {
                    return Err(LinkError::Closed);
                }
                Ok(None)
            }
            Message::Goodbye(_) => Err(LinkError::Closed),
            Message::Blob(_) => {
                self.speak_up(outbox)?;
                Ok(Some(Event::Received(message)))
            }
            Message::OpenShot(open) => {
                // What this worker did before is no part of the shot.
                if self.session.doing() == Doing::Idle {
                    self.clock = TaskClock::new(Instant::now());
                    self.unpacking_ns.store(0, Ordering::Relaxed);
                }
                Ok(Some(Event::Received(open.into())))
            }
            message => Ok(Some(Event::Received(message))),
        }
    }

    /// Says that this worker lives, unasked but not too often: where the link is slow, the
    /// question waits behind the terrain that comes, and the answer would be late.
    fn speak_up(&mut self, outbox: &Outbox) -> Result<(), LinkError> {
        if self.spoke.elapsed() < WHILE_IT_COMES {
            return Ok(());
        }
        self.spoke = Instant::now();
        match outbox.try_send(Pong { number: 0 }) {
            Err(Unsent::Closed) => Err(LinkError::Closed),
            // A full lane means that the coordinator will hear from us in any case.
            Ok(()) | Err(Unsent::Full) => Ok(()),
        }
    }

    fn handle(&mut self, event: Event, outbox: &Outbox) {
        self.session.handle(event);
        while let Some(action) = self.session.poll_action() {
            let outcome = match action {
                Action::Send(message) => self.send(message, outbox),
                Action::Load(hash) => self.load(hash),
                Action::Take(blob) => self.take(blob),
                Action::Seek(hash) => self.seek(hash),
                Action::Stock(blob) => self.stock(blob),
                Action::Fetch(elsewhere) => self.fetch(elsewhere),
                Action::Glance(glance, shot) => self.glance(glance, &shot),
                Action::Start(grant, shot) => self.start(&grant, &shot),
                Action::Resume(lease) => self.go_on(lease, Job::advance),
                Action::Settle(lease) => self.go_on(lease, Job::settle),
                Action::Stop(_) => {
                    self.stop_current();
                    None
                }
                Action::Discard(_) => {
                    self.paused = None;
                    self.clock.discard(Instant::now());
                    None
                }
                Action::Close(shot) => {
                    self.site.terrain.close_shot(shot);
                    None
                }
                Action::Release(store) => {
                    self.site.terrain.release(store);
                    None
                }
                Action::End => {
                    self.ended = true;
                    None
                }
            };
            if let Some(event) = outcome {
                self.session.handle(event);
            }
        }
        self.clock.turn(self.session.doing(), Instant::now());
    }

    /// Sends now if there is room, later otherwise.
    fn send(&mut self, message: Message, outbox: &Outbox) -> Option<Event> {
        let is_done = matches!(message, Message::Done(_));
        if self.backlog.is_empty() && outbox.try_send(message.clone()).is_ok() {
            return is_done.then_some(Event::Sent);
        }
        self.backlog.push_back(message);
        None
    }

    fn load(&mut self, hash: BlobHash) -> Option<Event> {
        if self.site.terrain.has_store(hash) {
            return Some(Event::Loaded(hash));
        }
        if self.site.terrain.has_come(hash) {
            return Some(Event::Loaded(hash));
        }
        if let Some(tile) = self.site.terrain.take_stowed(hash) {
            return Some(self.add_tile(hash, &tile));
        }
        let Some(cache) = self.site.cache.clone() else {
            return Some(Event::Absent(hash));
        };
        let (caster, unpacking_ns) = (self.site.caster.clone(), self.unpacking_ns.clone());
        self.spawn(
            move || {
                counted(&unpacking_ns, || match read(&cache, &hash) {
                    Some(bytes) => decoded(&*caster, hash, &bytes),
                    None => Report::Absent(hash),
                })
            },
            move |panic| Report::Spoiled(hash, panic),
        );
        None
    }

    fn take(&mut self, blob: Blob) -> Option<Event> {
        let Blob { hash, bytes } = blob;
        let (caster, unpacking_ns) = (self.site.caster.clone(), self.unpacking_ns.clone());
        let (cache, failed) = (self.site.cache.clone(), self.site.cache_failed.clone());
        self.spawn(
            move || {
                counted(&unpacking_ns, || {
                    if hash_of(&bytes) != hash {
                        return Report::Damaged(hash);
                    }
                    let report = decoded(&*caster, hash, &bytes);
                    if !matches!(report, Report::Spoiled(..)) {
                        keep(cache.as_deref(), &failed, &hash, &bytes);
                    }
                    report
                })
            },
            move |panic| Report::Spoiled(hash, panic),
        );
        None
    }

    fn start(&mut self, grant: &Grant, shot: &OpenShot) -> Option<Event> {
        debug!(lease = %grant.lease, shot = %grant.shot, frame = grant.frame, "job begins");
        self.site.terrain.begin_job(grant.shot, grant.frame);
        let stop = Arc::new(AtomicBool::new(false));
        self.current = Some((shot.index, stop.clone()));
        let view =
            View { camera: grant.camera, shading: shot.shading.clone(), quality: shot.quality };
        let (lease, region) = (grant.lease, grant.region);
        let check = Check { share: shot.check, frame: grant.frame };
        self.launch(
            lease,
            move |caster| Box::new(Job::new(caster, lease, view, region, check, stop)),
            Job::advance,
        )
    }

    fn go_on(&mut self, lease: LeaseId, work: Work<C>) -> Option<Event> {
        let Some(job) = self.paused.take() else {
            return Some(Event::Broken(lease, "it is not paused".to_owned()));
        };
        self.launch(lease, move |_| job, work)
    }

    /// Puts a job on the thread pool: everything that grows with its size happens there.
    fn launch(
        &mut self,
        lease: LeaseId,
        job: impl FnOnce(&C) -> Box<Job<C>> + Send + 'static,
        work: Work<C>,
    ) -> Option<Event> {
        let scene = self.current.as_ref().and_then(|(store, _)| self.site.terrain.scene(*store));
        let Some(scene) = scene else {
            return Some(Event::Broken(lease, "its terrain is not in memory".to_owned()));
        };
        let (caster, compress) = (self.site.caster.clone(), self.compress);
        let gate = self.site.gate.clone();
        self.spawn(
            move || {
                let outcome = work(job(&caster), &caster, &scene, &gate);
                // The tiles are free to change before anyone hears of the outcome.
                drop(scene);
                match outcome {
                    Ok(Outcome::Done(picture)) => match packed(lease, picture, compress) {
                        Ok((done, worked)) => Report::Done(Box::new(done), worked),
                        Err(why) => Report::Broken(lease, why),
                    },
                    Ok(Outcome::Missing(job, keys)) => Report::Missing(job, keys),
                    Ok(Outcome::Stopped) => Report::Stopped(lease),
                    Err(why) => Report::Broken(lease, why),
                }
            },
            move |panic| Report::Broken(lease, panic),
        );
        None
    }

    /// Updates the terrain by what the pool has done; says what it means to the session.
    fn judge(&mut self, report: Report<C>) -> Event {
        let terrain = &mut self.site.terrain;
        match report {
            Report::Absent(hash) => Event::Absent(hash),
            Report::Damaged(hash) => {
                self.site.damaged += 1;
                let damaged = self.site.damaged;
                warn!(%hash, damaged, "a terrain blob came damaged and is fetched again");
                Event::Damaged(hash)
            }
            Report::Early(hash, tile) => {
                match tile {
                    Some(tile) => terrain.stow(hash, tile),
                    None => terrain.leave_on_disk(hash),
                }
                Event::Stocked(hash)
            }
            Report::Fetched(blob) => Event::Fetched(blob),
            Report::Unfetched(hash) => Event::Unfetched(hash),
            Report::Glanced(store, due, keys) => {
                Event::Glanced(terrain.foresee_tiles(store, due, &keys))
            }
            Report::Spoiled(hash, why) => {
                terrain.give_up(hash);
                Event::Spoiled(hash, why)
            }
            Report::Index(hash, resident, prepared) => {
                terrain.add_store(hash, *resident, prepared);
                Event::Loaded(hash)
            }
            Report::Tile(hash, tile) => self.add_tile(hash, &tile),
            Report::Done(mut done, mut worked) => {
                let threads = self.site.pool.current_num_threads().max(1) as u32;
                worked.coreless /= threads;
                let unpacking = self.unpacking_ns.swap(0, Ordering::Relaxed);
                let unpacking = Duration::from_nanos(unpacking) / threads;
                done.timesheet = self.clock.tear_off(worked, unpacking, Instant::now());
                Event::Rendered(*done)
            }
            Report::Stopped(lease) => {
                self.clock.discard(Instant::now());
                Event::Stopped(lease)
            }
            Report::Broken(lease, why) => {
                self.clock.discard(Instant::now());
                Event::Broken(lease, why)
            }
            Report::Missing(job, keys) => {
                let lease = job.lease;
                let store = self.current.as_ref().map(|(store, _)| *store);
                let hashes = store.map(|store| terrain.await_tiles(store, &keys));
                match hashes {
                    Some(hashes) if !hashes.is_empty() => {
                        self.paused = Some(job);
                        Event::Paused(lease, hashes)
                    }
                    _ => Event::Broken(lease, "it asks for tiles that no store has".to_owned()),
                }
            }
        }
    }

    fn add_tile(&mut self, hash: BlobHash, tile: &Tile) -> Event {
        let terrain = &mut self.site.terrain;
        let added = terrain.add_tile(hash, tile);
        match added.err().or_else(|| terrain.over_limit()) {
            None => Event::Loaded(hash),
            Some(why) => Event::Spoiled(hash, why),
        }
    }

    fn stop_current(&mut self) {
        if let Some((_, stop)) = &self.current {
            stop.store(true, Ordering::Relaxed);
        }
    }

    /// Runs something on the thread pool and reports what came of it, or its panic.
    fn spawn(
        &self,
        run: impl FnOnce() -> Report<C> + Send + 'static,
        panicked: impl FnOnce(String) -> Report<C> + Send + 'static,
    ) {
        self.site.pool.spawn(reporting(self.reports.clone(), run, panicked));
    }
}

/// Does something and reports what came of it, or its panic.
fn reporting<C: Caster>(
    reports: mpsc::Sender<Report<C>>,
    run: impl FnOnce() -> Report<C>,
    panicked: impl FnOnce(String) -> Report<C>,
) -> impl FnOnce() {
    move || {
        let report = catch_unwind(AssertUnwindSafe(run));
        let report = report.unwrap_or_else(|panic| panicked(said(&*panic).to_owned()));
        // Nobody listens once the connection is lost.
        let _unheard = reports.blocking_send(report);
    }
}

/// Waits until the outbox has taken a message; for ever if there is none.
async fn send_waiting(outbox: &Outbox, message: Option<Message>) -> Result<(), LinkError> {
    match message {
        Some(message) => outbox.send(message).await,
        None => std::future::pending().await,
    }
}

/// Does something and adds the time that it takes to a count of nanoseconds.
fn counted<T>(into_ns: &AtomicU64, call: impl FnOnce() -> T) -> T {
    let began = Instant::now();
    let result = call();
    into_ns.fetch_add(began.elapsed().as_nanos() as u64, Ordering::Relaxed);
    result
}

/// A blob of the cache, if it is there and sound.
fn read(cache: &BlobCache, hash: &BlobHash) -> Option<Vec<u8>> {
    let before = cache.damaged();
    let found = cache.get(hash);
    let damaged = cache.damaged();
    if found.is_none() && damaged > before {
        warn!(%hash, damaged, "a terrain blob was damaged on disk and is fetched again");
    }
    found
}

/// Keeps a blob on disk, if there is a cache. A disk that has `failed` once is not spoken of
/// again: one that is full for a night, and takes a small tile now and then, is worth a line.
fn keep(cache: Option<&BlobCache>, failed: &AtomicBool, hash: &BlobHash, bytes: &[u8]) {
    if let Some(Err(error)) = cache.map(|cache| cache.put(hash, bytes)) {
        if failed.swap(true, Ordering::Relaxed) {
            debug!(%error, "a terrain blob was not kept");
        } else {
            warn!(%error, "terrain is not kept on disk, and fetched anew when it is needed again");
        }
    }
}

/// A blob says itself whether it is a tile; what is none should be an index.
fn decoded<C: Caster>(caster: &C, hash: BlobHash, bytes: &[u8]) -> Report<C> {
    match codec::decode(bytes) {
        Ok(tile) => return Report::Tile(hash, tile),
        Err(CodecError::NotATile) => {}
        Err(error) => return Report::Spoiled(hash, error.to_string()),
    }
    match decode_index(bytes) {
        Ok(index) => {
            let prepared = caster.prepare(&index);
            Report::Index(hash, Box::new(Resident::new(Arc::new(index))), prepared)
        }
        Err(why) => Report::Spoiled(hash, why),
    }
}

fn packed(lease: LeaseId, picture: Picture, compress: bool) -> Result<(Done, Worked), String> {
    let began = Instant::now();
    let pack = if compress { Pixels::compressed } else { Pixels::raw };
    let pixels = pack(picture.pixels.into()).map_err(|unfit| unfit.to_string())?;
    let report = RenderReport {
        cost_us: picture.spent.as_micros() as u64,
        rays: picture.stats.rays,
        steps: picture.stats.steps,
        fallbacks: picture.stats.fallbacks,
        coarser: picture.coarser,
        below_ground: picture.stats.below_ground,
    };
    let worked =
        Worked { render: picture.spent, coreless: picture.coreless, pack: began.elapsed() };
    // The sheet is filled in by the shift, which keeps the clock.
    let timesheet = Timesheet::default();
    Ok((Done { lease, report, timesheet, check: picture.errors, pixels }, worked))
}
