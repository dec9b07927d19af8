//! The greeting: who speaks, and in which version.
//!
//! The side that connects calls [`greet`], the coordinator [`accept`]. Both have a time
//! limit, so that a peer that connects and says nothing costs one timer. A refusal says
//! what the user should do; for versions, which side to upgrade.

use super::{Connection, LinkError};
use crate::limits::{clip_name, clip_reason};
use crate::message::{Hello, Message, Refusal, Refused, Role, Versions, Welcome};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};

/// Why there is no connection.
#[derive(Debug, thiserror::Error)]
pub enum HandshakeError {
    /// The coordinator said no.
    #[error("{text}")]
    Refused {
        /// The kind of refusal: [`Refusal::is_temporary`] says whether to try again.
        refusal: Refusal,
        /// Why, and what to do.
        text: String,
    },
    /// No answer in time.
    #[error("the peer did not greet within {} ms; is it a terrafarm port?", .0.as_millis())]
    TimedOut(Duration),
    /// The peer closed instead of answering.
    #[error("the peer closed the connection before the greeting was over")]
    Hangup,
    /// The peer answered with something else.
    #[error("the peer answered the greeting with something else")]
    OutOfPlace,
    /// The stream or what came over it is broken.
    #[error(transparent)]
    Link(#[from] LinkError),
}

/// Greets a coordinator: sends the [`Hello`], waits for the answer.
pub async fn greet<S: AsyncRead + AsyncWrite>(
    stream: S,
    hello: Hello,
    limit: Duration,
) -> Result<(Connection<S>, Welcome), HandshakeError> {
    let mut connection = Connection::new(stream);
    let ours = hello.versions;
    let exchange = async {
        connection.send(&hello.into()).await?;
        connection.recv().await
    };
    match tokio::time::timeout(limit, exchange).await {
        Err(_) => Err(HandshakeError::TimedOut(limit)),
        Ok(Ok(Some(Message::Welcome(welcome)))) => {
            let spoken = ours.oldest..=ours.newest;
            if !spoken.contains(&welcome.version) {
                return Err(HandshakeError::OutOfPlace);
            }
            connection.open(welcome.version);
            Ok((connection, welcome))
        }
        Ok(Ok(Some(Message::Refused(Refused { refusal, text })))) => {
            Err(HandshakeError::Refused { refusal, text })
        }
        Ok(Ok(Some(_))) => Err(HandshakeError::OutOfPlace),
        Ok(Ok(None)) => Err(HandshakeError::Hangup),
        Ok(Err(broken)) => Err(broken.into()),
    }
}

/// A peer that has greeted and waits for an answer.
#[derive(Debug)]
pub struct Greeting<S> {
    connection: Connection<S>,
    hello: Hello,
    version: u16,
    limit: Duration,
}

/// Waits for the [`Hello`] of a peer. One without a common version, or one that sends
/// something else, is refused here.
///
/// `program` names this side in the refusal: program and version.
pub async fn accept<S: AsyncRead + AsyncWrite>(
    stream: S,
    program: &str,
    limit: Duration,
) -> Result<Greeting<S>, HandshakeError> {
    let mut connection = Connection::new(stream);
    let (refusal, text) = match tokio::time::timeout(limit, connection.recv()).await {
        Err(_) => return Err(HandshakeError::TimedOut(limit)),
        Ok(Ok(None)) => return Err(HandshakeError::Hangup),
        Ok(Ok(Some(Message::Hello(hello)))) => match Versions::OURS.common(hello.versions) {
            Some(version) => return Ok(Greeting { connection, hello, version, limit }),
            None => (Refusal::Version, version_advice(program, &hello)),
        },
        Ok(Ok(Some(_))) => (Refusal::Malformed, "expected a greeting".to_owned()),
        Ok(Err(LinkError::Wire(error))) => (Refusal::Malformed, error.to_string()),
        Ok(Err(broken)) => return Err(broken.into()),
    };
    refuse(connection, refusal, &text, limit).await
}

impl<S: AsyncRead + AsyncWrite> Greeting<S> {
    /// What the peer said.
    pub fn hello(&self) -> &Hello {
        &self.hello
    }

    /// Opens the connection. `heartbeat` and `silence` are told to the peer; `id` is its
    /// number from now on.
    pub async fn welcome(
        mut self,
        id: u64,
        coordinator: &str,
        heartbeat: Duration,
        silence: Duration,
    ) -> Result<(Connection<S>, Hello), HandshakeError> {
        let welcome = Welcome {
            version: self.version,
            id,
            coordinator: clip_name(coordinator),
            heartbeat_us: heartbeat.as_micros() as u64,
            silence_us: silence.as_micros() as u64,
        };
        match tokio::time::timeout(self.limit, self.connection.send(&welcome.into())).await {
            Err(_) => Err(HandshakeError::TimedOut(self.limit)),
            Ok(sent) => {
                sent?;
                self.connection.open(self.version);
                Ok((self.connection, self.hello))
            }
        }
    }

    /// Refuses the connection and closes it.
    pub async fn refuse(self, refusal: Refusal, text: &str) {
        let refused: Result<(), _> = refuse(self.connection, refusal, text, self.limit).await;
        drop(refused);
    }
}

/// Says no. Whether the peer still hears it does not matter.
async fn refuse<S: AsyncRead + AsyncWrite, T>(
    mut connection: Connection<S>,
    refusal: Refusal,
    text: &str,
    limit: Duration,
) -> Result<T, HandshakeError> {
    let text = clip_reason(text);
    let refused = Refused { refusal, text: text.clone() }.into();
    let farewell = async {
        connection.send(&refused).await?;
        connection.writer.close().await
    };
    let _unheard = tokio::time::timeout(limit, farewell).await;
    Err(HandshakeError::Refused { refusal, text })
}

/// Which side to upgrade.
fn version_advice(program: &str, hello: &Hello) -> String {
    let Hello { versions: theirs, program: their_program, name, role } = hello;
    let ours = Versions::OURS;
    let older = if theirs.newest < ours.oldest { role.name() } else { "coordinator" };
    format!(
        "the coordinator ({program}) speaks protocol {}, the {} {name} ({their_program}) speaks {}: \
         upgrade the {older}",
        range(ours),
        role.name(),
        range(*theirs),
    )
}

fn range(versions: Versions) -> String {
    match versions {
        Versions { oldest, newest } if oldest == newest => format!("version {newest}"),
        Versions { oldest, newest } => format!("versions {oldest} to {newest}"),
    }
}

/// The name of this program and its version, for [`Hello::program`].
pub fn program() -> String {
    concat!("terrafarm ", env!("CARGO_PKG_VERSION")).to_owned()
}

impl Hello {
    /// The greeting of this program.
    pub fn new(name: &str, role: Role) -> Self {
        Hello { versions: Versions::OURS, program: program(), name: clip_name(name), role }
    }
}
