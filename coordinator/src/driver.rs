//! The driver task: owns the [`Farm`], a clock and the outboxes, and nothing else.
//!
//! Queues. Events of all peers share one bounded channel; when it is full, peers' readers
//! wait, and TCP slows the senders down. Each peer's outbox is bounded; a peer whose
//! outbox is full does not read, and is dropped.

use crate::api::{self, Budget, Desk, Link, Web};
use crate::blobs::ClientId;
use crate::farm::{Farm, Greeting, Out, Peer, PeerEvent};
use crate::journal::{self, Journal, JournalError};
use crate::order::{Order, OrderError};
use crate::peer::{self, Admission};
use crate::queue::{Queue, QueueConfig, QueueError, QueueTask};
use crate::thumbnails::Thumbnails;
use crate::view::FarmView;
use std::collections::HashMap;
use std::future::Future;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use terrafarm_common::id::WorkerId;
use terrafarm_sched::{LostReason, Micros};
use terrafarm_wire::link::{self, Meter, Outbox, OutboxEnd, Trust, Unsent, is_this_pc};
use terrafarm_wire::message::{Goodbye, Message};
use terrafarm_wire::pixels::Pixels;
use tokio::net::TcpListener;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

/// Events of peers that may wait for the driver.
const EVENTS: usize = 1024;
/// Pause after the system refused to accept a connection (out of file handles, say).
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// How often a new view of the farm is published.
const LOOK: Duration = Duration::from_millis(250);
/// How long peers have to hear that the coordinator stops.
const FAREWELL: Duration = Duration::from_secs(2);

/// Settings of a coordinator.
#[derive(Debug, Clone)]
pub struct Config {
    /// What it calls itself towards peers.
    pub name: String,
    /// Memory for terrain blobs on their way to workers, bytes.
    pub blob_memory_bytes: usize,
    /// Bytes of terrain that may wait for links to workers before workers are sent to each
    /// other for it.
    pub redirect_above_bytes: u64,
    /// Most connections at once, greeting or greeted.
    pub connections_max: usize,
    /// Most desks at once, each a line of someone who asks the API; others wait for their
    /// turn.
    pub desks_max: usize,
    /// Most bytes of long bodies of the API in memory at once, of requests and of answers to
    /// desks.
    pub bodies_bytes_max: usize,
    /// How long a body waits for memory before it is turned away.
    pub bodies_patience: Duration,
    /// Whom it lets in.
    pub trust: Trust,
    /// Most connections that have not greeted yet; the oldest of them gives way to a new
    /// one.
    pub strangers_max: usize,
    /// How long a stranger may take to greet.
    pub greeting_limit: Duration,
    /// Seed of the scheduler.
    pub seed: u64,
    /// Settings of the scheduler; heartbeat and silence are told to the workers.
    pub scheduler: terrafarm_sched::Config,
    /// The queue on disk, if there is to be one.
    pub queue: Option<QueueConfig>,
    /// File for a journal of the scheduler, if there is to be one.
    pub journal: Option<PathBuf>,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            name: "terrafarm".into(),
            blob_memory_bytes: 512 << 20,
            redirect_above_bytes: 8 << 20,
            connections_max: 16_896,
            desks_max: 128,
            bodies_bytes_max: 512 << 20,
            bodies_patience: Duration::from_secs(60),
            trust: Trust::Loopback,
            strangers_max: 256,
            greeting_limit: Duration::from_secs(5),
            seed: 1,
            scheduler: terrafarm_sched::Config::default(),
            queue: None,
            journal: None,
        }
    }
}

/// Why a coordinator ended before it was told to.
#[derive(Debug, thiserror::Error)]
pub enum CoordinatorError {
    /// The listening socket is of no use.
    #[error("cannot read the address listened on: {0}")]
    Listener(std::io::Error),
    /// Other PCs can reach it, and it could not tell friends from strangers.
    #[error(
        "{0} can be reached from other PCs, and there is no farm token to tell friends from \
         strangers; give one, or say --plain on a network you trust"
    )]
    NoToken(SocketAddr),
    /// The queue on disk cannot be used.
    #[error(transparent)]
    Queue(#[from] QueueError),
    /// The journal cannot be begun.
    #[error(transparent)]
    Journal(#[from] JournalError),
}

/// Serves a farm on a listening socket until `shutdown` is done, without a page. Peers are
/// told, and the function returns when every connection has ended.
///
/// # Errors
/// As [`Coordinator::open`]; refused connections and lost peers are normal work and only
/// logged.
pub async fn run(
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
) -> Result<(), CoordinatorError> {
    Coordinator::open(config, listener, None).await?.serve(shutdown).await;
    Ok(())
}

/// A coordinator that has all it needs: nothing keeps it from serving any more.
pub struct Coordinator {
    config: Config,
    listener: TcpListener,
    web: Option<Web>,
    inbox: mpsc::Receiver<ToDriver>,
    views: watch::Sender<Arc<FarmView>>,
    farm: FarmLine,
    queue: Option<(Queue, QueueTask)>,
    journal: Option<(Journal, PathBuf)>,
}

impl Coordinator {
    /// Takes the folder of the queue and begins the journal, if there are to be such.
    /// Connections wait until it serves. `web` brings the API by HTTP and the page.
    ///
    /// # Errors
    /// If the socket, the queue on disk or the journal cannot be used.
    pub async fn open(
        config: Config,
        listener: TcpListener,
        web: Option<Web>,
    ) -> Result<Self, CoordinatorError> {
        let address = listener.local_addr().map_err(CoordinatorError::Listener)?;
        if matches!(config.trust, Trust::Loopback) && !is_this_pc(address.ip()) {
            return Err(CoordinatorError::NoToken(address));
        }
        let (events, inbox) = mpsc::channel(EVENTS);
        let (views, view) = watch::channel(Arc::default());
        let farm = FarmLine { events, view, last_shot: Arc::default() };
        // Before any client, so that no number of a shot is given twice.
        let queue = match config.queue.clone() {
            Some(queue) => Some(Queue::open(queue, farm.clone()).await?),
            None => None,
        };
        let journal = config.journal.as_deref();
        let journal = journal.map(|path| journal::begin(path, &config.scheduler, config.seed));
        let journal = journal.transpose()?;
        Ok(Coordinator { config, listener, web, inbox, views, farm, queue, journal })
    }

    /// The file of the journal, if there is one.
    pub fn journal(&self) -> Option<&Path> {
        self.journal.as_ref().map(|(_, path)| path.as_path())
    }

    /// Serves until `shutdown` is done. Peers are told, and the function returns when every
    /// connection has ended.
    pub async fn serve(self, shutdown: impl Future<Output = ()>) {
        let Coordinator { config, listener, web, inbox, views, farm, queue, journal } = self;
        let stop = CancellationToken::new();
        let tasks = TaskTracker::new();
        let queue = queue.map(|(queue, task)| {
            tasks.spawn(task.run(stop.clone()));
            queue
        });
        let thumbnails = Arc::<Thumbnails>::default();
        let sight = Sight { views, thumbnails: thumbnails.clone(), unsent: Meter::default() };
        let unsent = sight.unsent.clone();
        let events = farm.events.clone();
        let mind = Farm::new(config.scheduler.clone(), config.seed, config.blob_memory_bytes);
        let mut mind = mind.counted_by(farm.last_shot.clone());
        mind.redirect_above(config.redirect_above_bytes);
        if let Some((journal, _)) = journal {
            mind = mind.recorded_in(journal);
        }
        let driver = tasks.spawn(drive(mind, inbox, sight, stop.clone()));
        let budget = Budget::new(config.bodies_bytes_max, config.bodies_patience);
        let desk = Desk::new(&config.name, farm, queue, thumbnails, budget, stop.clone());
        if let Some(web) = web {
            tasks.spawn(api::serve(web, desk.clone(), stop.clone()));
        }
        let admission = Admission::new(&config, events, Link::new(desk), unsent, stop.clone());
        admit(&listener, &admission, &tasks, shutdown).await;
        stop.cancel();
        // The admission holds a way to the driver; the driver ends when the last one is gone.
        drop(admission);
        let _ = driver.await;
        tasks.close();
        let _ = tokio::time::timeout(FAREWELL, tasks.wait()).await;
    }
}

/// Lets peers in until `shutdown` is done.
async fn admit(
    listener: &TcpListener,
    admission: &Admission,
    tasks: &TaskTracker,
    shutdown: impl Future<Output = ()>,
) {
    tokio::pin!(shutdown);
    loop {
        tokio::select! {
            () = &mut shutdown => break,
            accepted = listener.accept() => match accepted {
                Ok((stream, address)) => {
                    if let Some(seat) = admission.seat() {
                        tasks.spawn(peer::serve(stream, address, admission.clone(), seat));
                    }
                }
                Err(error) => {
                    tracing::warn!("cannot accept a connection: {error}");
                    // Out of file handles, say: at once it would only fail again.
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            },
        }
    }
}

/// What the driver receives.
pub enum ToDriver {
    /// A peer has greeted; here is how to answer it.
    Open(Peer, Outbox, CancellationToken, peer::PeerTraits),
    /// Something happened at its connection.
    Event(Peer, PeerEvent),
    /// Someone at the desk wants something.
    Order(Order, oneshot::Sender<Result<String, OrderError>>),
}

/// The way from the desk to the driver.
#[derive(Clone)]
pub struct FarmLine {
    events: mpsc::Sender<ToDriver>,
    view: watch::Receiver<Arc<FarmView>>,
    last_shot: Arc<AtomicU64>,
}

impl FarmLine {
    /// A line at whose other end nobody is.
    pub fn to_nobody() -> Self {
        let (events, _) = mpsc::channel(1);
        let (_, view) = watch::channel(Arc::default());
        FarmLine { events, view, last_shot: Arc::default() }
    }
}

/// Messages that may wait for a client inside this process, on each lane.
const INSIDE_QUEUE: usize = 4096;

impl FarmLine {
    /// Opens a client inside this process: what the farm says to it comes out of the end,
    /// which closes when the farm gives the client up.
    ///
    /// # Errors
    /// If the coordinator is stopping.
    pub async fn join(&self, client: ClientId, name: &str) -> Result<OutboxEnd, OrderError> {
        let (outbox, end) = link::outbox(INSIDE_QUEUE, INSIDE_QUEUE);
        let greeting = Greeting { name: name.to_owned(), threads: 0, identity: 0, address: None };
        let traits = peer::PeerTraits { greeting, loopback: true };
        let open = ToDriver::Open(Peer::Client(client), outbox, CancellationToken::new(), traits);
        self.events.send(open).await.map_err(|_| OrderError::Stopping)?;
        Ok(end)
    }

    /// Passes on what such a client says.
    ///
    /// # Errors
    /// If the coordinator is stopping.
    pub async fn tell(&self, client: ClientId, event: PeerEvent) -> Result<(), OrderError> {
        let event = ToDriver::Event(Peer::Client(client), event);
        self.events.send(event).await.map_err(|_| OrderError::Stopping)
    }

    /// The counter of all shots.
    pub fn last_shot(&self) -> &AtomicU64 {
        &self.last_shot
    }

    /// Has an order carried out and waits for what came of it.
    ///
    /// # Errors
    /// If it cannot be carried out, or the coordinator is stopping.
    pub async fn order(&self, order: Order) -> Result<String, OrderError> {
        let (answer, answered) = oneshot::channel();
        let sent = self.events.send(ToDriver::Order(order, answer)).await;
        sent.map_err(|_| OrderError::Stopping)?;
        answered.await.map_err(|_| OrderError::Stopping)?
    }

    /// The newest view of the farm.
    pub fn view(&self) -> Arc<FarmView> {
        self.view.borrow().clone()
    }
}

struct Line {
    outbox: Outbox,
    /// Ends the connection's reader.
    hang_up: CancellationToken,
    loopback: bool,
}

/// Where the driver puts what is to be seen, and what it looks at.
struct Sight {
    views: watch::Sender<Arc<FarmView>>,
    thumbnails: Arc<Thumbnails>,
    /// Of what waits for links to workers.
    unsent: Meter,
}

async fn drive(
    mut farm: Farm,
    mut inbox: mpsc::Receiver<ToDriver>,
    sight: Sight,
    stop: CancellationToken,
) {
    let epoch = Instant::now();
    let now = || Micros(epoch.elapsed().as_micros() as u64);
    let mut lines: HashMap<Peer, Line> = HashMap::new();
    let mut looks = tokio::time::interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        let due = farm.next_deadline().map(|at| epoch + Duration::from_micros(at.0));
        tokio::select! {
            () = stop.cancelled() => break,
            () = sleep_until(due) => farm.tick(now()),
            received = inbox.recv() => match received {
                Some(ToDriver::Open(peer, outbox, hang_up, traits)) => {
                    lines.insert(peer, Line { outbox, hang_up, loopback: traits.loopback });
                    farm.handle(now(), peer, PeerEvent::Joined(traits.greeting));
                }
                Some(ToDriver::Event(peer, event)) => {
                    let gone = matches!(event, PeerEvent::Gone(..));
                    farm.set_unsent(sight.unsent.bytes());
                    farm.handle(now(), peer, event);
                    if gone {
                        lines.remove(&peer);
                    }
                }
                Some(ToDriver::Order(order, answer)) => {
                    // Who asked may have gone.
                    let _ = answer.send(farm.order(now(), order));
                }
                None => break,
            },
            _ = looks.tick() => {
                sight.views.send_if_modified(|view| {
                    *view = Arc::new(farm.view(now(), wall_s()));
                    true
                });
            }
        }
        while let Some(out) = farm.poll_out() {
            if let Some((peer, why)) = carry(out, &mut lines, &sight.thumbnails) {
                farm.handle(now(), peer, PeerEvent::Gone(LostReason::Broken, why));
            }
        }
    }
    farm.finish_journal();
    for line in lines.values() {
        let _ = line.outbox.try_send(Goodbye { reason: "the coordinator stops".into() });
        line.hang_up.cancel();
    }
}

/// Seconds since 1970 began.
fn wall_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

async fn sleep_until(due: Option<Instant>) {
    match due {
        // The scheduler's own deadline; an event comes first by the select around this.
        Some(due) => tokio::time::sleep_until(due.into()).await,
        None => std::future::pending().await,
    }
}

/// Carries out one order. Returns a peer that has to be given up, and why.
fn carry(
    out: Out,
    lines: &mut HashMap<Peer, Line>,
    thumbnails: &Arc<Thumbnails>,
) -> Option<(Peer, String)> {
    match out {
        Out::Send(peer, message) => {
            let line = lines.get(&peer)?;
            let optional = matches!(message, Message::Progress(_));
            match line.outbox.try_send(message) {
                Err(Unsent::Full) if !optional => give_up(lines, peer),
                // Where the connection has ended, its reader says how: perhaps with a goodbye
                // that is still on its way to here.
                Err(Unsent::Full | Unsent::Closed) | Ok(()) => None,
            }
        }
        Out::SendFrame(client, head, picture) => {
            let peer = Peer::Client(client);
            let line = lines.get(&peer)?;
            let (outbox, hang_up) = (line.outbox.clone(), line.hang_up.clone());
            let loopback = line.loopback;
            let thumbnails = thumbnails.clone();
            // At most as many at once as frames may be in flight.
            tokio::task::spawn_blocking(move || {
                let (shot, frame) = head.place();
                thumbnails.keep(shot, frame, &picture);
                let pixels = picture.into_pixels().into();
                let packed =
                    if loopback { Pixels::raw(pixels) } else { Pixels::compressed(pixels) };
                match packed {
                    Ok(pixels) => {
                        // A frame that cannot be queued is one that never comes: better
                        // no connection than a client that waits for ever.
                        if outbox.try_send(head.with(pixels)).is_err() {
                            hang_up.cancel();
                        }
                    }
                    Err(why) => tracing::error!("cannot pack a frame: {why}"),
                }
            });
            None
        }
        Out::Close(peer, _why) => {
            // Dropping the outbox ends the writer after what is queued; the reader ends
            // when told.
            if let Some(line) = lines.remove(&peer) {
                line.hang_up.cancel();
            }
            None
        }
    }
}

fn give_up(lines: &mut HashMap<Peer, Line>, peer: Peer) -> Option<(Peer, String)> {
    let line = lines.remove(&peer)?;
    line.hang_up.cancel();
    Some((peer, "does not read what is sent to it".into()))
}

/// Numbers of connections, in the order of their greeting.
pub fn peer_of(id: u64, is_worker: bool) -> Peer {
    if is_worker { Peer::Worker(WorkerId(id)) } else { Peer::Client(ClientId(id)) }
}

#[cfg(test)]
impl FarmLine {
    /// A farm of its own without sockets, until it is told to stop.
    pub fn to_new_farm(config: Config, stop: CancellationToken) -> Self {
        let (events, inbox) = mpsc::channel(EVENTS);
        let (views, view) = watch::channel(Arc::default());
        let line = FarmLine { events, view, last_shot: Arc::default() };
        let unsent = Meter::default();
        let sight = Sight { views, thumbnails: Arc::default(), unsent };
        let farm = Farm::new(config.scheduler, config.seed, config.blob_memory_bytes);
        let farm = farm.counted_by(line.last_shot.clone());
        tokio::spawn(drive(farm, inbox, sight, stop));
        line
    }

    /// A worker inside this process; what the farm says to it comes out of the end.
    pub async fn hire(&self, worker: WorkerId) -> OutboxEnd {
        let (outbox, end) = link::outbox(INSIDE_QUEUE, INSIDE_QUEUE);
        let greeting =
            Greeting { name: format!("{worker}"), threads: 2, identity: 0, address: None };
        let traits = peer::PeerTraits { greeting, loopback: true };
        let open = ToDriver::Open(Peer::Worker(worker), outbox, CancellationToken::new(), traits);
        let _ = self.events.send(open).await;
        end
    }

    /// Passes on what such a worker says; false if the farm has ended.
    pub async fn work(&self, worker: WorkerId, message: impl Into<Message>) -> bool {
        let event = ToDriver::Event(Peer::Worker(worker), PeerEvent::Said(message.into()));
        self.events.send(event).await.is_ok()
    }
}
