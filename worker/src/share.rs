//! Terrain from worker to worker, where the coordinator's link is the limit.
//!
//! A worker that keeps tiles on disk gives them to others of its farm ([`Shelf`]): over the
//! same encrypted link and greeting as all else, by hash alone, a few connections at a time,
//! one blob each, at a bounded rate, and never from memory that its own jobs use. The
//! coordinator says who may have what; [`Others`] asks them and believes nobody: what comes
//! is hashed, and whoever is silent, gone or wrong is left alone for a while. Nothing is
//! lost then but time, for the coordinator has every blob.

use std::collections::HashMap;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use terrafarm_common::id::BlobHash;
use terrafarm_terrain::cache::BlobCache;
use terrafarm_terrain::store::hash_of;
use terrafarm_wire::Message;
use terrafarm_wire::link::{Connection, HandshakeError, LinkError, Trust, accept, greet, program};
use terrafarm_wire::message::{Blob, Elsewhere, Hello, NoBlob, Refusal, Role, WantBlobs};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Mutex as AsyncMutex, Semaphore};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tracing::{debug, warn};

/// Most workers that are served at once; more are turned away and ask the coordinator.
const GUESTS_MAX: usize = 16;
/// Longest blob that is given, bytes. Tiles have a few hundred kilobytes; what is longer is
/// the index of a huge store, and the coordinator's to give.
const GIVEN_MAX: u64 = 8 << 20;
/// What all guests together are given at most, bytes a second: a quarter of gigabit
/// Ethernet, and a few percent of a core for reading and hashing.
const RATE: f64 = 32e6;
/// How long a guest may take to greet, to take a blob, or to ask for the next one.
const GREETING_LIMIT: Duration = Duration::from_secs(5);
const TAKING_LIMIT: Duration = Duration::from_secs(10);
const IDLE_LIMIT: Duration = Duration::from_secs(60);
/// A blob that is not here may be on its way here: how long, and how often it is looked for.
const ON_ITS_WAY: Duration = Duration::from_secs(1);
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// How long another worker may take to greet, and to answer.
const ANSWER_LIMIT: Duration = Duration::from_secs(2);
/// How long all of them together may take for one blob.
const FETCH_LIMIT: Duration = Duration::from_secs(6);
/// How long one that failed is left alone.
const SHUNNED_FOR: Duration = Duration::from_secs(60);
/// Most other workers that are remembered.
const KNOWN_MAX: usize = 64;

/// Where a worker gives its blobs to others.
#[derive(Debug)]
pub(crate) struct Shelf {
    address: SocketAddr,
    serving: JoinHandle<()>,
}

impl Shelf {
    /// Listens on an address of this PC; port 0 is any free one. What it gives is added to
    /// the count of bytes.
    pub async fn open(
        address: SocketAddr,
        cache: Arc<BlobCache>,
        trust: Trust,
        name: &str,
        given_bytes: Arc<AtomicU64>,
    ) -> io::Result<Shelf> {
        let listener = TcpListener::bind(address).await?;
        let address = listener.local_addr()?;
        let house = Arc::new(House {
            cache,
            trust,
            name: name.to_owned(),
            guests: Arc::new(Semaphore::new(GUESTS_MAX)),
            given_bytes,
            pace: AsyncMutex::new(Instant::now()),
        });
        let serving = tokio::spawn(house.serve(listener));
        Ok(Shelf { address, serving })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Shelf {
    fn drop(&mut self) {
        self.serving.abort();
    }
}

struct House {
    cache: Arc<BlobCache>,
    trust: Trust,
    name: String,
    guests: Arc<Semaphore>,
    given_bytes: Arc<AtomicU64>,
    /// When the next byte may go.
    pace: AsyncMutex<Instant>,
}

impl House {
    async fn serve(self: Arc<Self>, listener: TcpListener) {
        let mut guests = tokio::task::JoinSet::new();
        loop {
            tokio::select! {
                accepted = listener.accept() => match accepted {
                    Ok((stream, address)) => {
                        // Without a seat the stream is closed: the guest asks elsewhere.
                        if let Ok(seat) = self.guests.clone().try_acquire_owned() {
                            let house = self.clone();
                            guests.spawn(async move {
                                let ended = house.host(stream, address.ip()).await;
                                debug!(%address, ?ended, "a worker has had its terrain");
                                drop(seat);
                            });
                        }
                    }
                    // Out of file handles, say.
                    Err(_) => sleep(LOOK_EVERY).await,
                },
                Some(_) = guests.join_next() => {}
            }
        }
    }

    async fn host(&self, stream: TcpStream, guest: IpAddr) -> Result<(), HandshakeError> {
        let token = self.trust.token_for(guest)?;
        let greeting = accept(stream, token, &program(), GREETING_LIMIT).await?;
        if greeting.hello().role != Role::Peer {
            let text =
                "this is a worker, which gives terrain to other workers; name the coordinator";
            greeting.refuse(Refusal::Malformed, text).await;
            return Ok(());
        }
        let welcome = greeting.welcome(0, &self.name, IDLE_LIMIT / 2, IDLE_LIMIT);
        let (mut connection, _) = welcome.await?;
        while let Ok(received) = timeout(IDLE_LIMIT, connection.recv()).await {
            let Some(Message::WantBlobs(want)) = received? else { break };
            for hash in want.hashes {
                let answer: Message = match self.find(hash).await {
                    Some(bytes) => {
                        self.wait_for_turn(bytes.len()).await;
                        Blob { hash, bytes: bytes.into() }.into()
                    }
                    None => NoBlob { hash, why: "it is not here".to_owned() }.into(),
                };
                match timeout(TAKING_LIMIT, connection.send(&answer)).await {
                    Ok(sent) => {
                        sent?;
                        if let Message::Blob(blob) = &answer {
                            let bytes = blob.bytes.len() as u64;
                            self.given_bytes.fetch_add(bytes, Ordering::Relaxed);
                        }
                    }
                    Err(_) => return Err(HandshakeError::TimedOut(TAKING_LIMIT)),
                }
            }
        }
        Ok(())
    }

    /// A sound blob of the cache; one that is not there yet is waited for a little.
    async fn find(&self, hash: BlobHash) -> Option<Vec<u8>> {
        let deadline = Instant::now() + ON_ITS_WAY;
        loop {
            let cache = self.cache.clone();
            let read = move || match cache.length(&hash) {
                Some(length) if length > GIVEN_MAX => Err(()),
                Some(_) => cache.get(&hash).map(Some).ok_or(()),
                None => Ok(None),
            };
            match tokio::task::spawn_blocking(read).await {
                Ok(Ok(Some(bytes))) => return Some(bytes),
                // It may be written meanwhile, and a disk does not call.
                Ok(Ok(None)) if Instant::now() < deadline => sleep(LOOK_EVERY).await,
                _ => return None,
            }
        }
    }

    /// Keeps all guests together within the rate.
    async fn wait_for_turn(&self, bytes: usize) {
        let turn = {
            let mut next = self.pace.lock().await;
            let turn = (*next).max(Instant::now());
            *next = turn + Duration::from_secs_f64(bytes as f64 / RATE);
            turn
        };
        // The pause is the purpose: it is the rate.
        sleep_until(turn).await;
    }
}

/// The other workers, as one that needs their blobs knows them.
#[derive(Debug)]
pub(crate) struct Others {
    trust: Trust,
    name: String,
    known: Mutex<HashMap<SocketAddr, Known>>,
    damaged: AtomicU64,
}

type Line = Arc<AsyncMutex<Option<Connection<TcpStream>>>>;

#[derive(Debug)]
struct Known {
    line: Line,
    shunned_until: Option<Instant>,
}

/// Why another worker gave no blob.
#[derive(Debug, thiserror::Error)]
enum Ungiven {
    #[error(transparent)]
    Handshake(#[from] HandshakeError),
    #[error(transparent)]
    Link(#[from] LinkError),
    #[error("no answer within {} ms", ANSWER_LIMIT.as_millis())]
    Silent,
    #[error("it sent something else")]
    OutOfPlace,
    #[error("what it sent has another hash")]
    Damaged,
}

impl Others {
    /// Knows nobody yet.
    pub fn new(trust: Trust, name: &str) -> Others {
        Others { trust, name: name.to_owned(), known: Mutex::default(), damaged: AtomicU64::new(0) }
    }

    /// Blobs of others that were not what they should be.
    pub fn damaged(&self) -> u64 {
        self.damaged.load(Ordering::Relaxed)
    }

    /// A blob whose hash is right, from the first that gives it.
    pub async fn fetch(&self, elsewhere: &Elsewhere) -> Option<Blob> {
        let hash = elsewhere.hash;
        let asking = async {
            for &address in &elsewhere.workers {
                let Some(line) = self.line_to(address) else { continue };
                match self.ask(&line, address, hash).await {
                    Ok(Some(blob)) => return Some(blob),
                    Ok(None) => {}
                    Err(why) => {
                        if matches!(why, Ungiven::Damaged) {
                            let damaged = self.damaged.fetch_add(1, Ordering::Relaxed) + 1;
                            warn!(%address, %hash, damaged, "a worker gave a damaged terrain blob");
                        }
                        debug!(%address, %hash, "no terrain from another worker: {why}");
                        self.shun(address);
                    }
                }
            }
            None
        };
        timeout(FETCH_LIMIT, asking).await.ok().flatten()
    }

    /// Asks one of them; `None` if it does not have it.
    async fn ask(
        &self,
        line: &Line,
        address: SocketAddr,
        hash: BlobHash,
    ) -> Result<Option<Blob>, Ungiven> {
        let mut line = line.lock().await;
        if self.line_to(address).is_none() {
            // Another question has failed meanwhile.
            return Ok(None);
        }
        // It is put back after a whole answer only: one that was broken off is out of step.
        let mut connection = match line.take() {
            Some(connection) => connection,
            None => timeout(ANSWER_LIMIT, self.connect(address))
                .await
                .map_err(|_| Ungiven::Silent)??,
        };
        let want = WantBlobs { hashes: vec![hash], elsewhere: false };
        let exchange = async {
            connection.send(&want.into()).await?;
            connection.recv().await
        };
        let answer = timeout(ANSWER_LIMIT, exchange).await.map_err(|_| Ungiven::Silent)??;
        let given = match answer {
            Some(Message::Blob(blob)) if blob.hash == hash => {
                if hash_of(&blob.bytes) != hash {
                    return Err(Ungiven::Damaged);
                }
                Some(blob)
            }
            Some(Message::NoBlob(no)) if no.hash == hash => None,
            Some(_) => return Err(Ungiven::OutOfPlace),
            None => return Err(LinkError::Closed.into()),
        };
        *line = Some(connection);
        Ok(given)
    }

    async fn connect(&self, address: SocketAddr) -> Result<Connection<TcpStream>, HandshakeError> {
        let token = self.trust.token_for(address.ip())?;
        let stream = TcpStream::connect(address).await.map_err(LinkError::Io)?;
        stream.set_nodelay(true).map_err(LinkError::Io)?;
        let hello = Hello::new(&self.name, Role::Peer);
        let (connection, _) = greet(stream, token, hello, ANSWER_LIMIT).await?;
        Ok(connection)
    }

    /// The line to a worker; `None` while it is shunned.
    fn line_to(&self, address: SocketAddr) -> Option<Line> {
        let mut known = self.lock();
        if known.len() >= KNOWN_MAX && !known.contains_key(&address) {
            known.clear();
        }
        let unknown = || Known { line: Line::default(), shunned_until: None };
        let worker = known.entry(address).or_insert_with(unknown);
        let shunned = worker.shunned_until.is_some_and(|until| Instant::now() < until);
        (!shunned).then(|| worker.line.clone())
    }

    fn shun(&self, address: SocketAddr) {
        if let Some(worker) = self.lock().get_mut(&address) {
            worker.shunned_until = Some(Instant::now() + SHUNNED_FOR);
        }
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<SocketAddr, Known>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
