//! Connecting to the coordinator: at the address that was told, or wherever one is found.

use crate::WorkerConfig;
use crate::search::{Search, Seeker};
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use terrafarm_wire::link::{Connection, HandshakeError, LinkError, Paced, Proved, Trust, prove};
use terrafarm_wire::message::{Hello, Role, Welcome};
use tokio::net::{TcpStream, ToSocketAddrs, lookup_host};
use tokio::time::timeout;
use tracing::warn;

/// How long finding the address of a name may take, proving the token, and the greeting.
pub(crate) const CONNECT_LIMIT: Duration = Duration::from_secs(10);
/// How long one address may take to answer at all. A system asks a second time after one
/// second, then after two, four, eight: when a link comes back, a new attempt is sooner.
const ANSWER_LIMIT: Duration = Duration::from_secs(2);
/// Most addresses of one name that are tried.
const ADDRESSES_MAX: usize = 4;

/// Where the coordinator is.
#[derive(Debug, Clone)]
pub enum Whereabouts {
    /// At this address, `host:port`, and nowhere else.
    At(String),
    /// Wherever one is found that lets this worker in, each time that there is none.
    Sought(Arc<dyn Search>),
}

/// A connection, what the coordinator said, and the addresses of both ends, ours first.
pub(crate) type Connected = (Connection<Paced<TcpStream>>, Welcome, [SocketAddr; 2]);

/// Why there is none.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NoLink {
    /// The one that was told.
    #[error(transparent)]
    There(#[from] HandshakeError),
    /// None was found, or none that lets this worker in.
    #[error("{0}")]
    Anywhere(String),
}

/// The way to the coordinator.
pub(crate) enum Dial {
    Told(String),
    Seeking(Box<Seeker>),
}

impl Dial {
    pub fn new(whereabouts: &Whereabouts) -> Self {
        match whereabouts {
            Whereabouts::At(address) => Dial::Told(address.clone()),
            Whereabouts::Sought(search) => Dial::Seeking(Box::new(Seeker::new(search.clone()))),
        }
    }

    /// A greeted connection. Cancel safe: what was begun is given up.
    pub async fn connect(&mut self, config: &WorkerConfig) -> Result<Connected, NoLink> {
        match self {
            Dial::Told(address) => {
                let line = Line::open(&**address, &Caller::of(config)).await?;
                Ok(line.greet(hello(config), CONNECT_LIMIT).await?)
            }
            Dial::Seeking(seeker) => seeker.connect(config).await.map_err(NoLink::Anywhere),
        }
    }
}

/// What a worker says of itself.
pub(crate) fn hello(config: &WorkerConfig) -> Hello {
    let threads = config.threads.max(1) as u32;
    let WorkerConfig { seed: incarnation, identity, .. } = *config;
    Hello::new(&config.name, Role::Worker { threads, incarnation, identity })
}

/// What is needed to open a line.
#[derive(Debug, Clone)]
pub(crate) struct Caller {
    trust: Trust,
    bandwidth_bytes_per_s: Option<u64>,
}

impl Caller {
    pub fn of(config: &WorkerConfig) -> Self {
        let WorkerConfig { trust, bandwidth_bytes_per_s, .. } = config;
        Caller { trust: trust.clone(), bandwidth_bytes_per_s: *bandwidth_bytes_per_s }
    }
}

/// A link over which both sides have proved the token, if there is one; nobody has greeted.
#[derive(Debug)]
pub(crate) struct Line {
    proved: Proved<Paced<TcpStream>>,
    own: SocketAddr,
    peer: SocketAddr,
}

impl Line {
    /// Connects and proves the token, at the first address that answers.
    pub async fn open(
        address: impl ToSocketAddrs,
        caller: &Caller,
    ) -> Result<Line, HandshakeError> {
        let stream = answering(address).await?;
        let peer = stream.peer_addr().map_err(LinkError::Io)?;
        let own = stream.local_addr().map_err(LinkError::Io)?;
        // Small messages must not wait for others to fill a packet.
        if let Err(error) = stream.set_nodelay(true) {
            warn!(%error, "the connection stays slow for small messages");
        }
        let token = caller.trust.token_for(peer.ip())?;
        let stream = Paced::new(stream, caller.bandwidth_bytes_per_s);
        let proved = prove(stream, token, CONNECT_LIMIT).await?;
        Ok(Line { proved, own, peer })
    }

    /// Who is at the other end.
    pub fn peer(&self) -> SocketAddr {
        self.peer
    }

    /// Greets whoever is at the other end.
    pub async fn greet(self, hello: Hello, limit: Duration) -> Result<Connected, HandshakeError> {
        let (connection, welcome) = self.proved.greet(hello, limit).await?;
        Ok((connection, welcome, [self.own, self.peer]))
    }
}

/// A connection to the first address that answers.
async fn answering(address: impl ToSocketAddrs) -> Result<TcpStream, HandshakeError> {
    let asking = timeout(CONNECT_LIMIT, lookup_host(address)).await;
    let addresses = asking.map_err(|_| HandshakeError::TimedOut(CONNECT_LIMIT))?;
    let mut why = HandshakeError::from(LinkError::Io(io::ErrorKind::AddrNotAvailable.into()));
    for address in addresses.map_err(LinkError::Io)?.take(ADDRESSES_MAX) {
        why = match timeout(ANSWER_LIMIT, TcpStream::connect(address)).await {
            Ok(Ok(stream)) => return Ok(stream),
            Ok(Err(refused)) => LinkError::Io(refused).into(),
            Err(_) => LinkError::Io(io::ErrorKind::TimedOut.into()).into(),
        };
    }
    Err(why)
}
