//! One connection: greeting, then one task that reads and one that writes.

use crate::api::Link;
use crate::driver::{Config, ToDriver, peer_of};
use crate::farm::{Greeting, PeerEvent};
use crate::strangers::Strangers;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use terrafarm_sched::LostReason;
use terrafarm_wire::link::{
    self, Connection, HandshakeError, Heard, LinkError, Meter, Trust, handshake,
};
use terrafarm_wire::message::{Message, Pong, Refusal, Role};
use tokio::net::TcpStream;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// Messages that may wait for a peer on each lane: grants and questions on one, blobs and
/// frames on the other. A worker asks for no more blobs at once than its own limit.
const URGENT_QUEUE: usize = 4096;
const BULK_QUEUE: usize = 4096;

/// A client is given up after this many times the silence that a worker may keep.
const CLIENT_PATIENCE: u32 = 4;

/// How long a long body may take to come when there is memory for it.
const BODY_LIMIT: Duration = Duration::from_secs(600);
/// How long a desk may take to take an answer.
const ANSWER_LIMIT: Duration = Duration::from_secs(60);

/// What every new connection needs to know.
#[derive(Clone)]
pub struct Admission {
    name: Arc<str>,
    greeting_limit: Duration,
    heartbeat: Duration,
    silence: Duration,
    trust: Trust,
    seats: Arc<Semaphore>,
    strangers: Arc<Strangers>,
    last_id: Arc<AtomicU64>,
    events: mpsc::Sender<ToDriver>,
    /// What answers desks, and how many more there may be.
    api: Link,
    desks: Arc<Semaphore>,
    stop: CancellationToken,
    /// Of what waits for links to workers.
    unsent: Meter,
}

/// What the driver has to know of a peer.
pub struct PeerTraits {
    /// What it said of itself.
    pub greeting: Greeting,
    /// Whether it is on this PC: then pixels need no packing.
    pub loopback: bool,
}

impl Admission {
    /// Lets in as many peers as the configuration says.
    pub fn new(
        config: &Config,
        events: mpsc::Sender<ToDriver>,
        api: Link,
        unsent: Meter,
        stop: CancellationToken,
    ) -> Self {
        Admission {
            name: config.name.as_str().into(),
            greeting_limit: config.greeting_limit,
            heartbeat: Duration::from_micros(config.scheduler.heartbeat_us),
            silence: Duration::from_micros(config.scheduler.silence_us),
            trust: config.trust.clone(),
            seats: Arc::new(Semaphore::new(config.connections_max)),
            strangers: Arc::new(Strangers::new(config.strangers_max)),
            last_id: Arc::default(),
            events,
            api,
            desks: Arc::new(Semaphore::new(config.desks_max)),
            stop,
            unsent,
        }
    }

    /// A place for one connection; `None` when all are taken: the connection is closed.
    pub fn seat(&self) -> Option<OwnedSemaphorePermit> {
        self.seats.clone().try_acquire_owned().ok()
    }
}

/// Serves one connection to its end.
pub async fn serve(
    stream: TcpStream,
    address: SocketAddr,
    admission: Admission,
    _seat: OwnedSemaphorePermit,
) {
    // Grants are small and must not wait for company.
    let _ = stream.set_nodelay(true);
    let greeted = match hear(stream, address, &admission).await {
        Ok(greeted) => greeted,
        Err(why) => {
            tracing::info!(%address, "connection refused: {why}");
            return;
        }
    };
    if matches!(greeted.hello().role, Role::Peer) {
        let text = "a coordinator serves workers and clients; a peer asks workers";
        return greeted.refuse(Refusal::Malformed, text).await;
    }
    let place = match greeted.hello().role {
        Role::Desk => match place(&admission).await {
            Some(place) => Some(place),
            None => {
                let text = "as many are served at the desk as there are places; try again in a \
                            moment";
                return greeted.refuse(Refusal::Full, text).await;
            }
        },
        _ => None,
    };
    let id = admission.last_id.fetch_add(1, Ordering::Relaxed) + 1;
    let welcomed = greeted.welcome(id, &admission.name, admission.heartbeat, admission.silence);
    let (connection, hello) = match welcomed.await {
        Ok(open) => open,
        Err(why) => {
            tracing::info!(%address, "greeting not finished: {why}");
            return;
        }
    };
    let (is_worker, threads, identity) = match hello.role {
        Role::Worker { threads, identity, .. } => (true, threads, identity),
        Role::Client | Role::Peer => (false, 0, 0),
        Role::Desk => {
            desk(connection, &admission).await;
            return drop(place);
        }
    };
    let peer = peer_of(id, is_worker);
    let (mut reader, writer) = connection.split();
    let meter = if is_worker { admission.unsent.clone() } else { Meter::default() };
    let (outbox, queues) = link::metered(URGENT_QUEUE, BULK_QUEUE, meter);
    let hang_up = CancellationToken::new();
    let mut writing = tokio::spawn(writer.run(queues));
    let traits = PeerTraits {
        greeting: Greeting { name: hello.name, threads, identity, address: Some(address.ip()) },
        loopback: link::is_this_pc(address.ip()),
    };
    if admission.events.send(ToDriver::Open(peer, outbox, hang_up.clone(), traits)).await.is_err() {
        return;
    }
    // Workers are the scheduler's to watch, which probes them. A client pings by itself;
    // one that is silent for so long is gone, and its shots hold the farm for nobody.
    let patience = (!is_worker).then_some(admission.silence * CLIENT_PATIENCE);
    let (mut leaving, mut is_written, mut unsent) = (false, false, None);
    let how = loop {
        tokio::select! {
            () = hang_up.cancelled() => break Ok(()),
            heard = reader.hear(patience) => {
                let event = match heard {
                    Ok(Heard::Message(message)) => {
                        leaving |= matches!(message, Message::Goodbye(_));
                        PeerEvent::Said(message)
                    }
                    Ok(Heard::More) if is_worker => PeerEvent::Stirred,
                    Ok(Heard::More | Heard::Claim(_)) => continue,
                    Ok(Heard::End) => break Ok(()),
                    Err(why) => break Err(why),
                };
                if admission.events.send(ToDriver::Event(peer, event)).await.is_err() {
                    break Ok(());
                }
            }
            // A link that broke is noticed by reading, too, behind what was still to be heard.
            written = &mut writing, if !is_written => {
                is_written = true;
                if let Ok(Err(LinkError::Wire(why))) = written {
                    tracing::error!(?peer, "a message that cannot be sent: {why}");
                    unsent = Some(why.to_string());
                    break Ok(());
                }
            }
        }
    };
    let (reason, text) = match (unsent, how) {
        (Some(why), _) => (LostReason::Broken, why),
        (None, Ok(())) if leaving => (LostReason::Left, "said goodbye".to_owned()),
        (None, Ok(())) => (LostReason::Broken, "the connection was closed".to_owned()),
        (None, Err(why @ LinkError::Wire(_))) => (LostReason::Misbehaved, why.to_string()),
        (None, Err(why)) => (LostReason::Broken, why.to_string()),
    };
    let _ = admission.events.send(ToDriver::Event(peer, PeerEvent::Gone(reason, text))).await;
    // The driver has dropped the outbox by now or will; what is queued is still sent, but
    // not for ever.
    if !is_written && tokio::time::timeout(admission.greeting_limit, &mut writing).await.is_err() {
        writing.abort();
    }
}

/// A place at the desk, for which whoever comes waits for a moment; `None` if all stay taken.
async fn place(admission: &Admission) -> Option<OwnedSemaphorePermit> {
    // The other side gives up a greeting that takes too long.
    let patience = admission.greeting_limit / 2;
    tokio::select! {
        () = admission.stop.cancelled() => None,
        taken = tokio::time::timeout(patience, admission.desks.clone().acquire_owned()) => {
            taken.ok()?.ok()
        }
    }
}

async fn sleep_until(due: Option<Instant>) {
    match due {
        // Someone who sends a byte now and then holds memory that others wait for.
        Some(due) => tokio::time::sleep_until(due).await,
        None => std::future::pending().await,
    }
}

/// Answers the requests of one desk, one after the other.
async fn desk(connection: Connection<TcpStream>, admission: &Admission) {
    let (mut reader, mut writer) = connection.split();
    let patience = admission.silence * CLIENT_PATIENCE;
    // Of the body that is coming, and when it has to be there.
    let (mut share, mut due) = (None, None::<Instant>);
    loop {
        let received = tokio::select! {
            () = admission.stop.cancelled() => return,
            () = sleep_until(due) => return,
            received = reader.hear(Some(patience)) => received,
        };
        let (answer, _claim): (Message, _) = match received {
            Ok(Heard::More) => continue,
            Ok(Heard::Claim(bytes)) => {
                let claim = tokio::select! {
                    () = admission.stop.cancelled() => return,
                    claim = admission.api.claim(bytes) => claim,
                };
                // There is no request yet that could be answered.
                let Some(claim) = claim else { return };
                (share, due) = (Some(claim), Some(Instant::now() + BODY_LIMIT));
                continue;
            }
            Ok(Heard::Message(Message::Request(request))) => {
                due = None;
                let (response, claim) = admission.api.answer(request, share.take()).await;
                (response.into(), claim)
            }
            Ok(Heard::Message(Message::Ping(ping))) => (Pong { number: ping.number }.into(), None),
            _ => return,
        };
        match tokio::time::timeout(ANSWER_LIMIT, writer.send(&answer)).await {
            Ok(Ok(())) => {}
            _ => return,
        }
    }
}

/// Hears a stranger out, for so long as newer ones leave it its place.
async fn hear(
    stream: TcpStream,
    address: SocketAddr,
    admission: &Admission,
) -> Result<link::Greeting<TcpStream>, HandshakeError> {
    let token = admission.trust.token_for(address.ip())?;
    let program = handshake::program();
    let place = admission.strangers.enter();
    tokio::select! {
        () = place.given_away() => Err(HandshakeError::Crowded),
        greeted = link::accept(stream, token, &program, admission.greeting_limit) => greeted,
    }
}
