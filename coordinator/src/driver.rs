//! The driver task: owns the [`Farm`], a clock and the outboxes, and nothing else.
//!
//! Queues. Events of all peers share one bounded channel; when it is full, peers' readers
//! wait, and TCP slows the senders down. Each peer's outbox is bounded; a peer whose
//! outbox is full does not read, and is dropped.

use crate::blobs::ClientId;
use crate::farm::{Farm, Out, Peer, PeerEvent};
use crate::peer::{self, Admission};
use std::collections::HashMap;
use std::future::Future;
use std::net::SocketAddr;
use std::time::{Duration, Instant};
use terrafarm_common::id::WorkerId;
use terrafarm_sched::{LostReason, Micros};
use terrafarm_wire::link::{Meter, Outbox, Trust, is_this_pc};
use terrafarm_wire::message::{Goodbye, Message};
use terrafarm_wire::pixels::Pixels;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

/// Events of peers that may wait for the driver.
const EVENTS: usize = 1024;
/// Pause after the system refused to accept a connection (out of file handles, say).
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
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
}

impl Default for Config {
    fn default() -> Self {
        Config {
            name: "terrafarm".into(),
            blob_memory_bytes: 512 << 20,
            redirect_above_bytes: 8 << 20,
            connections_max: 4608,
            trust: Trust::Loopback,
            strangers_max: 256,
            greeting_limit: Duration::from_secs(5),
            seed: 1,
            scheduler: terrafarm_sched::Config::default(),
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
}

/// Serves a farm on a listening socket until `shutdown` is done. Peers are told, and the
/// function returns when every connection has ended.
///
/// # Errors
/// If the socket cannot be used at all; refused connections and lost peers are normal
/// work and only logged.
pub async fn run(
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
) -> Result<(), CoordinatorError> {
    let address = listener.local_addr().map_err(CoordinatorError::Listener)?;
    if matches!(config.trust, Trust::Loopback) && !is_this_pc(address.ip()) {
        return Err(CoordinatorError::NoToken(address));
    }
    let (events, inbox) = mpsc::channel(EVENTS);
    let stop = CancellationToken::new();
    let tasks = TaskTracker::new();
    let unsent = Meter::default();
    let driver = tasks.spawn(drive(config.clone(), inbox, stop.clone(), unsent.clone()));
    tokio::pin!(shutdown);
    let admission = Admission::new(&config, events, unsent);
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
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            },
        }
    }
    stop.cancel();
    // The admission holds a way to the driver; the driver ends when the last one is gone.
    drop(admission);
    let _ = driver.await;
    tasks.close();
    let _ = tokio::time::timeout(FAREWELL, tasks.wait()).await;
    Ok(())
}

/// What the driver receives.
pub enum ToDriver {
    /// A peer has greeted; here is how to answer it.
    Open(Peer, Outbox, CancellationToken, peer::PeerTraits),
    /// Something happened at its connection.
    Event(Peer, PeerEvent),
}

struct Line {
    outbox: Outbox,
    /// Ends the connection's reader.
    hang_up: CancellationToken,
    loopback: bool,
}

async fn drive(
    config: Config,
    mut inbox: mpsc::Receiver<ToDriver>,
    stop: CancellationToken,
    unsent: Meter,
) {
    let epoch = Instant::now();
    let now = || Micros(epoch.elapsed().as_micros() as u64);
    let mut farm = Farm::new(config.scheduler, config.seed, config.blob_memory_bytes);
    farm.redirect_above(config.redirect_above_bytes);
    let mut lines: HashMap<Peer, Line> = HashMap::new();
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
                    farm.set_unsent(unsent.bytes());
                    farm.handle(now(), peer, event);
                    if gone {
                        lines.remove(&peer);
                    }
                }
                None => break,
            },
        }
        while let Some(out) = farm.poll_out() {
            if let Some((peer, why)) = carry(out, &mut lines) {
                farm.handle(now(), peer, PeerEvent::Gone(LostReason::Broken, why));
            }
        }
    }
    for line in lines.values() {
        let _ = line.outbox.try_send(Goodbye { reason: "the coordinator stops".into() });
        line.hang_up.cancel();
    }
}

async fn sleep_until(due: Option<Instant>) {
    match due {
        Some(due) => tokio::time::sleep_until(due.into()).await,
        None => std::future::pending().await,
    }
}

/// Carries out one order. Returns a peer that has to be given up, and why.
fn carry(out: Out, lines: &mut HashMap<Peer, Line>) -> Option<(Peer, String)> {
    match out {
        Out::Send(peer, message) => {
            let line = lines.get(&peer)?;
            let optional = matches!(message, Message::Progress(_));
            if line.outbox.try_send(message).is_err() && !optional {
                return give_up(lines, peer);
            }
            None
        }
        Out::SendFrame(client, head, picture) => {
            let peer = Peer::Client(client);
            let line = lines.get(&peer)?;
            let (outbox, hang_up) = (line.outbox.clone(), line.hang_up.clone());
            let loopback = line.loopback;
            // At most as many at once as frames may be in flight.
            tokio::task::spawn_blocking(move || {
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
