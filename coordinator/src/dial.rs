//! Connecting to a coordinator, and greeting it.

use std::time::Duration;
use terrafarm_wire::link::{self, Connection, HandshakeError, Trust};
use terrafarm_wire::message::{Hello, Role, Welcome};
use tokio::net::TcpStream;

/// How long connecting, greeting and taking leave may take, each.
pub(crate) const GREETING_LIMIT: Duration = Duration::from_secs(5);

/// Why a coordinator cannot be talked to.
#[derive(Debug, thiserror::Error)]
pub enum DialError {
    /// Nobody answers.
    #[error(
        "cannot reach coordinator {address}: {source}; is \"terrafarm coordinator\" running there, \
         and the port open?"
    )]
    Connect {
        /// Where.
        address: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// Somebody answers, but no coordinator that lets us in.
    #[error("coordinator {address}: {source}")]
    Handshake {
        /// Where.
        address: String,
        /// What went wrong.
        source: HandshakeError,
    },
}

/// Connects to a coordinator and greets it over a link that `trust` allows.
///
/// # Errors
/// If there is no coordinator, or it does not let us in.
pub(crate) async fn dial(
    address: &str,
    trust: &Trust,
    name: &str,
    role: Role,
) -> Result<(Connection<TcpStream>, Welcome), DialError> {
    let unreachable = |source| DialError::Connect { address: address.into(), source };
    let connecting = tokio::time::timeout(GREETING_LIMIT, TcpStream::connect(address));
    let late = |_| unreachable(std::io::ErrorKind::TimedOut.into());
    let stream = connecting.await.map_err(late)?.map_err(unreachable)?;
    let _ = stream.set_nodelay(true);
    let refused = |source| DialError::Handshake { address: address.into(), source };
    let peer = stream.peer_addr().map_err(unreachable)?;
    let token = trust.token_for(peer.ip()).map_err(refused)?;
    let hello = Hello::new(name, role);
    link::greet(stream, token, hello, GREETING_LIMIT).await.map_err(refused)
}
