use crate::scene::Terrain;
use std::path::Path;
use std::sync::mpsc;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use terrafarm_common::accuracy::PixelError;
use terrafarm_common::id::BlobHash;
use terrafarm_common::region::Region;
use terrafarm_raycast::{Glimpse, Rendered, Stats, Unfit, Unseen, View};
use terrafarm_terrain::layout::{StoreIndex, TileKey};
use terrafarm_wire::Message;
use terrafarm_wire::link::{Connection, FarmToken, Trust, accept};
use terrafarm_wire::message::{Blob, Hello, NoBlob, Pong, WantBlobs};
use terrafarm_worker::office::Rules;
use terrafarm_worker::render::Scene;
use terrafarm_worker::{
    Caster, Ended, RayCaster, Reconnect, ShareTiles, Whereabouts, WorkerConfig, WorkerError,
    run_with,
};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

/// Longer than any test takes: whoever waits so long waits in vain.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// A coordinator of which the test is the brain.
pub struct Coordinator {
    pub listener: TcpListener,
}

/// One worker, as the coordinator sees it.
pub struct Peer {
    pub connection: Connection<TcpStream>,
    pub hello: Hello,
    /// What it has asked for.
    pub asked: Vec<BlobHash>,
}

/// A worker under test.
pub struct Running {
    pub ended: JoinHandle<Result<Ended, WorkerError>>,
    pub stop: oneshot::Sender<()>,
}

impl Coordinator {
    pub async fn new() -> Self {
        Coordinator { listener: TcpListener::bind("127.0.0.1:0").await.unwrap() }
    }

    pub fn config(&self, cache_dir: Option<&Path>) -> WorkerConfig {
        WorkerConfig {
            coordinator: Whereabouts::At(self.listener.local_addr().unwrap().to_string()),
            trust: Trust::Loopback,
            name: "pc-1".to_owned(),
            threads: 2,
            cache_dir: cache_dir.map(Path::to_owned),
            cache_limit_bytes: 1 << 30,
            memory_limit_bytes: 1 << 30,
            rules: Rules::default(),
            bandwidth_bytes_per_s: None,
            share: ShareTiles::Never,
            reconnect: Reconnect {
                attempts: Some(3),
                first: Duration::from_millis(1),
                longest: Duration::from_millis(5),
            },
            seed: 5,
            identity: 7,
        }
    }

    /// Whether no connection waits to be accepted.
    pub fn nobody_came(&self) -> bool {
        let mut context = std::task::Context::from_waker(std::task::Waker::noop());
        self.listener.poll_accept(&mut context).is_pending()
    }

    pub async fn welcome(&self) -> Peer {
        self.welcome_with(PATIENCE).await
    }

    pub async fn welcome_with(&self, silence: Duration) -> Peer {
        self.admit(None, silence).await
    }

    pub async fn welcome_by(&self, token: Option<&FarmToken>) -> Peer {
        self.admit(token, PATIENCE).await
    }

    async fn admit(&self, token: Option<&FarmToken>, silence: Duration) -> Peer {
        let accepted = tokio::time::timeout(PATIENCE, self.listener.accept());
        let (stream, _) = accepted.await.expect("a worker connects").unwrap();
        let greeting = accept(stream, token, "terrafarm test", PATIENCE).await.unwrap();
        let (connection, hello) = greeting.welcome(1, "tower", silence / 3, silence).await.unwrap();
        Peer { connection, hello, asked: Vec::new() }
    }
}

impl Peer {
    pub async fn send(&mut self, message: impl Into<Message>) {
        self.connection.send(&message.into()).await.unwrap();
    }

    /// The next message that does not say how fast the worker is, how it is off, or unasked
    /// that it lives; `None` at a clean end.
    pub async fn recv(&mut self) -> Option<Message> {
        loop {
            let received = tokio::time::timeout(PATIENCE, self.connection.recv());
            let message = received.await.expect("the worker says something").unwrap();
            let unasked = Pong { number: 0 }.into();
            if !matches!(message, Some(Message::Speed(_) | Message::Status(_)))
                && message.as_ref() != Some(&unasked)
            {
                return message;
            }
        }
    }

    /// The next message that is no question for blobs; those are answered, the last one
    /// first.
    pub async fn serve(&mut self, terrain: &Terrain) -> Option<Message> {
        loop {
            match self.recv().await {
                Some(Message::WantBlobs(WantBlobs { hashes, .. })) => {
                    self.asked.extend(&hashes);
                    for hash in hashes.into_iter().rev() {
                        match terrain.blobs.get(&hash) {
                            Some(bytes) => {
                                self.send(Blob { hash, bytes: bytes.clone().into() }).await;
                            }
                            None => {
                                let why = "the client has left".to_owned();
                                self.send(NoBlob { hash, why }).await;
                            }
                        }
                    }
                }
                other => return other,
            }
        }
    }
}

pub fn start(config: WorkerConfig) -> Running {
    start_with(config, RayCaster)
}

pub fn start_with(config: WorkerConfig, caster: impl Caster) -> Running {
    let (stop, stopped) = oneshot::channel();
    let shutdown = async {
        if stopped.await.is_err() {
            std::future::pending::<()>().await;
        }
    };
    Running { ended: tokio::spawn(run_with(config, caster, shutdown)), stop }
}

/// A ray caster for faults: it tells that it has begun a piece, then waits at a gate.
/// Two samples a side make it panic.
#[derive(Clone)]
pub struct Gated {
    begun: mpsc::Sender<()>,
    gate: Arc<Mutex<mpsc::Receiver<()>>>,
}

pub struct Gate {
    begun: Option<mpsc::Receiver<()>>,
    open: mpsc::Sender<()>,
}

pub fn gated() -> (Gated, Gate) {
    let (begun, has_begun) = mpsc::channel();
    let (open, gate) = mpsc::channel();
    let gate = Arc::new(Mutex::new(gate));
    (Gated { begun, gate }, Gate { begun: Some(has_begun), open })
}

impl Gate {
    /// Waits until a piece has begun.
    pub async fn has_begun(&mut self) {
        let begun = self.begun.take().unwrap();
        let waited = tokio::task::spawn_blocking(move || {
            begun.recv_timeout(PATIENCE).expect("a piece begins");
            begun
        });
        self.begun = Some(waited.await.unwrap());
    }

    /// Lets so many pieces pass.
    pub fn open(&self, pieces: usize) {
        (0..pieces).for_each(|_| self.open.send(()).unwrap());
    }
}

impl Caster for Gated {
    type Prepared = ();
    type Piece = Region;

    fn prepare(&self, _index: &StoreIndex) {}

    fn begin(&self, region: Region) -> Region {
        region
    }

    fn advance(&self, _: &Scene<()>, view: &View, _: &mut Region) -> Result<Vec<TileKey>, Unfit> {
        assert!(view.quality.samples_per_side != 2, "two samples are too many");
        self.begun.send(()).unwrap();
        self.gate.lock().unwrap().recv().unwrap();
        Ok(Vec::new())
    }

    fn finish(&self, piece: Region) -> Rendered {
        let pixels = vec![9; piece.area() as usize * 3];
        Rendered { pixels, missing: Vec::new(), stats: Stats::default() }
    }

    fn glimpse(&self, _: &Scene<()>, _: &View, _: Region) -> Result<Glimpse, Unseen> {
        unreachable!("nothing is missing")
    }

    fn gauge(&self, _: &Scene<()>, _: &View, _: u32, _: u32) -> Result<PixelError, Unseen> {
        Ok(PixelError { surface_px: 1.0, occlusion_px: 0.0, depth_m: None, mismatch: false })
    }
}
