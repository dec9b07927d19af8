//! The worker: takes jobs from a coordinator, renders them on all cores, sends pixels.
//!
//! [`run`] is the whole of it. Read in this order: [`session`] decides what to do about
//! what happens, purely; [`render`] spreads a job over the cores; [`terrain`] holds
//! decoded tiles within a memory limit; `shift` is the thin shell that carries out what
//! the session asks for over one connection; [`office`] says when and with how many threads
//! a worker on somebody's PC works; `share` passes terrain from worker to worker; `dial`
//! connects, [`search`] finds whom to connect to; `backoff` says when to try again, `clock` where the time goes, `trial` how fast this PC is. A [`sleeper`]
//! stands in for a worker where a coordinator is measured.
//!
//! The worker owns nothing that cannot be had again: whatever breaks, the coordinator
//! grants its leases to others. It needs no file but the tile cache, and works without.
//! Rendering and decoding happen on a thread pool of its own, never on the threads that
//! answer heartbeats.

mod backoff;
mod clock;
mod dial;
pub mod office;
pub mod render;
pub mod search;
pub mod session;
mod share;
mod shift;
pub mod sleeper;
pub mod terrain;
mod trial;

pub use backoff::Reconnect;
pub use dial::Whereabouts;
pub use render::{Caster, RayCaster};

use backoff::Backoff;
use dial::{Dial, NoLink};
use office::{Gate, Rules, Watch};
use share::{Others, Shelf};
use shift::{Shift, Site};
use std::net::SocketAddr;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Arc;
use terrafarm_terrain::cache::BlobCache;
use terrafarm_wire::link::{HandshakeError, Trust, is_this_pc};
use tokio_util::sync::CancellationToken;
use tracing::{debug, info, warn};

/// What a worker needs to know.
#[derive(Debug, Clone)]
pub struct WorkerConfig {
    /// Where the coordinator is.
    pub coordinator: Whereabouts,
    /// How it and the coordinator know each other.
    pub trust: Trust,
    /// What to call this worker; a host name, usually.
    pub name: String,
    /// Number of render threads, at least 1.
    pub threads: usize,
    /// Where fetched terrain is kept between runs; several workers may share it. Without
    /// one, each start fetches anew.
    pub cache_dir: Option<PathBuf>,
    /// Size of that folder, bytes.
    pub cache_limit_bytes: u64,
    /// Memory for decoded terrain, bytes. A height tile takes 0.4 MB, a photo tile 0.5 MB;
    /// a job whose own tiles take more fails.
    pub memory_limit_bytes: u64,
    /// When to work, and whether to make room for others on this PC.
    pub rules: Rules,
    /// Most that is sent and most that is received, bytes per second each; no limit if
    /// `None`.
    pub bandwidth_bytes_per_s: Option<u64>,
    /// Whether other workers of the farm are given tiles of the cache folder.
    pub share: ShareTiles,
    /// What to do when there is no connection.
    pub reconnect: Reconnect,
    /// A number of this process: the worker's incarnation and the seed of its back-off.
    /// Two workers should have different ones.
    pub seed: u64,
    /// A number of this PC that outlives the process; 0 if there is none. A coordinator that
    /// has found wrong pixels knows the PC by it.
    pub identity: u128,
}

/// Whether a worker gives its tiles to others of its farm, which spares the coordinator's
/// link. It listens on the address that it reaches the coordinator from, for those whom
/// [`WorkerConfig::trust`] lets in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ShareTiles {
    /// It does not listen.
    Never,
    /// At a free port, unless the coordinator is on this PC: then there is no link to spare.
    #[default]
    Beyond,
    /// At this port wherever the coordinator is; 0 is a free one.
    At(u16),
}

/// Why a worker has ended without an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// It was told to stop; every lease is answered.
    Stopped,
    /// The coordinator sent it away; every lease is answered.
    Drained,
}

/// Why a worker could not go on.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// The coordinator cannot be reached, and [`Reconnect`] says to give up.
    #[error(
        "cannot reach coordinator {address}: {why}; is \"terrafarm coordinator\" running there, and the port open?"
    )]
    Unreachable {
        /// The address that was tried.
        address: String,
        /// What the system or the peer said last.
        why: String,
    },
    /// No coordinator was found that lets this worker in, and [`Reconnect`] says to give up.
    #[error("{0}; name one with --coordinator HOST:PORT")]
    Nobody(String),
    /// The coordinator does not want this worker; trying again cannot help.
    #[error("coordinator {address} refuses this worker: {text}")]
    Refused {
        /// The address of the coordinator.
        address: String,
        /// Why, and what to do.
        text: String,
    },
    /// The coordinator is on another PC, and there is no farm token.
    #[error("coordinator {address}: {why}")]
    NoToken {
        /// The address of the coordinator.
        address: String,
        /// What to do.
        why: HandshakeError,
    },
    /// The operating system gives no threads.
    #[error("cannot start {threads} render threads: {why}; try fewer")]
    Threads {
        /// How many were asked for.
        threads: usize,
        /// What the system said.
        why: String,
    },
}

/// Works until `shutdown` completes or the coordinator sends the worker away.
///
/// On shutdown the job that runs is finished and sent, the others are handed back.
pub async fn run(
    config: WorkerConfig,
    shutdown: impl Future<Output = ()>,
) -> Result<Ended, WorkerError> {
    run_with(config, RayCaster, shutdown).await
}

/// As [`run`], with another way to cast rays.
pub async fn run_with<C: Caster>(
    config: WorkerConfig,
    caster: C,
    shutdown: impl Future<Output = ()>,
) -> Result<Ended, WorkerError> {
    let stop = CancellationToken::new();
    let work = work(config, caster, stop.clone());
    tokio::pin!(work);
    tokio::select! {
        ended = &mut work => return ended,
        () = shutdown => stop.cancel(),
    }
    work.await
}

async fn work<C: Caster>(
    config: WorkerConfig,
    caster: C,
    stop: CancellationToken,
) -> Result<Ended, WorkerError> {
    let mut site = site(&config, caster).await?;
    let mut backoff = Backoff::new(config.reconnect, config.seed);
    let mut watch = Watch::begin(&config.rules, config.threads, &site.gate);
    let mut dial = Dial::new(&config.coordinator);
    let mut welcomed = false;
    let mut said = None;
    loop {
        tokio::select! {
            () = watch.on_duty() => {}
            () = stop.cancelled() => return Ok(Ended::Stopped),
        }
        let connected = tokio::select! {
            connected = dial.connect(&config) => connected,
            () = stop.cancelled() => return Ok(Ended::Stopped),
        };
        let why = match connected {
            Ok((connection, welcome, [own, peer])) => {
                info!(coordinator = welcome.coordinator, peer = %peer, "connected");
                backoff.reset();
                (welcomed, said) = (true, None);
                share(&config, &mut site, own, peer).await;
                let shift = Shift::new(&mut site, !is_this_pc(peer.ip()), &welcome);
                let leave = stop.child_token();
                match watch.over(shift.work(connection, &leave), &leave).await {
                    Ok(()) if stop.is_cancelled() => return Ok(Ended::Stopped),
                    Ok(()) if leave.is_cancelled() => {
                        info!("off duty: this worker's hours are over");
                        continue;
                    }
                    Ok(()) => return Ok(Ended::Drained),
                    Err(lost) => NoLink::There(lost.into()),
                }
            }
            Err(why) => why,
        };
        let why = hopeful(why, &config.coordinator, welcomed)?;
        let Some(pause) = backoff.next() else {
            return Err(match &config.coordinator {
                Whereabouts::At(address) => {
                    WorkerError::Unreachable { address: address.clone(), why }
                }
                Whereabouts::Sought(_) => WorkerError::Nobody(why),
            });
        };
        let retry_in_ms = pause.as_millis() as u64;
        // A night without a coordinator is worth a line, not a thousand.
        if said.as_ref() == Some(&why) {
            debug!(why, retry_in_ms, "still no connection to the coordinator");
        } else {
            warn!(why, retry_in_ms, "no connection to the coordinator");
            said = Some(why);
        }
        tokio::select! {
            // Back-off: a coordinator that restarts is not stormed by its workers.
            () = tokio::time::sleep(pause) => {}
            () = stop.cancelled() => return Ok(Ended::Stopped),
        }
    }
}

/// Why there is no connection, in words; an error if trying again cannot help. Where a
/// coordinator is looked for, it always can.
fn hopeful(why: NoLink, coordinator: &Whereabouts, welcomed: bool) -> Result<String, WorkerError> {
    let (why, address) = match (why, coordinator) {
        (NoLink::There(why), Whereabouts::At(address)) => (why, address.clone()),
        (why, _) => return Ok(why.to_string()),
    };
    match why {
        HandshakeError::Refused { refusal, text } if !refusal.is_temporary() => {
            Err(WorkerError::Refused { address, text })
        }
        // Anyone on the way can say this: a token that was right once is right.
        why @ HandshakeError::TurnedAway(refusal) if !welcomed && !refusal.is_temporary() => {
            Err(WorkerError::Refused { address, text: why.to_string() })
        }
        why @ HandshakeError::NoToken => Err(WorkerError::NoToken { address, why }),
        why => Ok(why.to_string()),
    }
}

/// The threads, the caches: what outlives a connection.
async fn site<C: Caster>(config: &WorkerConfig, caster: C) -> Result<Site<C>, WorkerError> {
    let threads = config.threads.max(1);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|number| format!("render-{number}"))
        .build()
        .map_err(|error| WorkerError::Threads { threads, why: error.to_string() })?;
    let cache = match config.cache_dir.clone() {
        None => None,
        Some(folder) => {
            let limit = config.cache_limit_bytes;
            let opening = tokio::task::spawn_blocking(move || BlobCache::open(&folder, limit));
            match opening.await {
                Ok(Ok(cache)) => Some(Arc::new(cache)),
                Ok(Err(error)) => {
                    warn!(%error, "working without a tile cache");
                    None
                }
                Err(_) => None,
            }
        }
    };
    let terrain = terrain::Terrain::new(config.memory_limit_bytes);
    let caster = Arc::new(caster);
    let (tried, trial) = tokio::sync::oneshot::channel();
    let on_trial = caster.clone();
    pool.spawn(move || {
        // A trial that panics says as much as none.
        let speed = catch_unwind(AssertUnwindSafe(|| on_trial.trial()));
        let _unheard = tried.send(speed.ok().flatten());
    });
    let pixels_per_s = trial.await.ok().flatten();
    debug!(pixels_per_s, "tried how fast this worker is");
    let gate = Gate::new(threads);
    let others = Arc::new(Others::new(config.trust.clone(), &config.name));
    Ok(Site {
        pool,
        cache,
        cache_failed: Arc::default(),
        terrain,
        caster,
        gate,
        pixels_per_s,
        shelf: None,
        given_bytes: Arc::default(),
        others,
        damaged: 0,
    })
}

/// Opens the shelf for other workers on the address `own` that the coordinator, `peer`, is
/// reached from, unless it is open there already. Without one the worker works as well.
async fn share<C: Caster>(
    config: &WorkerConfig,
    site: &mut Site<C>,
    own: SocketAddr,
    peer: SocketAddr,
) {
    let port = match config.share {
        ShareTiles::Never => return,
        ShareTiles::Beyond if is_this_pc(peer.ip()) => return,
        ShareTiles::Beyond => 0,
        ShareTiles::At(port) => port,
    };
    let Some(cache) = site.cache.clone() else { return };
    if site.shelf.as_ref().is_some_and(|shelf| shelf.address().ip() == own.ip()) {
        return;
    }
    site.shelf = None;
    let given = site.given_bytes.clone();
    let mut address = own;
    address.set_port(port);
    match Shelf::open(address, cache, config.trust.clone(), &config.name, given).await {
        Ok(shelf) => {
            info!(address = %shelf.address(), "gives terrain to other workers");
            site.shelf = Some(shelf);
        }
        Err(error) => warn!(%address, %error, "cannot give terrain to other workers"),
    }
}
