//! The greeting: who speaks, and in which version.
//!
//! The side that connects calls [`greet`], the coordinator [`accept`]. Both have a time
//! limit, so that a peer that connects and says nothing costs one timer. A refusal says
//! what the user should do; for versions, which side to upgrade.
//!
//! With a token the secure channel is opened first, and the greeting travels inside it.
//! Whoever does not prove the token gets one and the same refusal, in plain, whatever was
//! wrong. The side that connects believes no word of such a refusal but its kind: anyone
//! on the way can send one.

use super::channel::{self, ChannelError, Opening, PROOF_BYTES};
use super::{Connection, FarmToken, LinkError};
use crate::codec::WireError;
use crate::frame;
use crate::limits::{clip_name, clip_reason};
use crate::message::{Hello, Message, Refusal, Refused, Role, Versions, Welcome};
use std::io;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};

/// What is still read of a peer that was refused, bytes: closing a socket with something
/// unread in it can take the refusal away from the peer.
const UNREAD_MAX: u64 = 64 << 10;

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
    /// The coordinator said no before it had proved that it is one: do not believe it for
    /// ever. [`Refusal::is_temporary`] as above.
    #[error("the coordinator {}", unproven_advice(*.0))]
    TurnedAway(Refusal),
    /// The peer is on another PC, and there is no farm token.
    #[error(
        "it is another PC, and there is no farm token here to prove; on the coordinator's PC \
         \"terrafarm token\" prints it, here \"terrafarm token --enter\" takes it; on a network you \
         trust, say --plain on both sides"
    )]
    NoToken,
    /// So many greetings were under way that this one had to give way.
    #[error("it did not greet before others needed its place")]
    Crowded,
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

/// Greets a coordinator: proves the token and has it proved if there is one, sends the
/// [`Hello`], waits for the answer.
pub async fn greet<S: AsyncRead + AsyncWrite>(
    stream: S,
    token: Option<&FarmToken>,
    hello: Hello,
    limit: Duration,
) -> Result<(Connection<S>, Welcome), HandshakeError> {
    let exchange = async { approach(stream, token).await?.exchange(hello).await };
    tokio::time::timeout(limit, exchange).await.map_err(|_| HandshakeError::TimedOut(limit))?
}

/// The first half of [`greet`], for a choice among several coordinators: proves the token and
/// has it proved if there is one. Nobody has been greeted: whoever is not chosen sees a
/// stranger leave.
pub async fn prove<S: AsyncRead + AsyncWrite>(
    stream: S,
    token: Option<&FarmToken>,
    limit: Duration,
) -> Result<Proved<S>, HandshakeError> {
    let proving = tokio::time::timeout(limit, approach(stream, token));
    proving.await.map_err(|_| HandshakeError::TimedOut(limit))?
}

/// A link to a coordinator that has proved the token, if there is one.
#[derive(Debug)]
pub struct Proved<S>(Connection<S>);

async fn approach<S: AsyncRead + AsyncWrite>(
    stream: S,
    token: Option<&FarmToken>,
) -> Result<Proved<S>, HandshakeError> {
    let mut connection = Connection::new(stream);
    if let Some(token) = token {
        open_channel(&mut connection, token).await?;
    }
    Ok(Proved(connection))
}

impl<S: AsyncRead + AsyncWrite> Proved<S> {
    /// The second half of [`greet`].
    pub async fn greet(
        self,
        hello: Hello,
        limit: Duration,
    ) -> Result<(Connection<S>, Welcome), HandshakeError> {
        let exchange = tokio::time::timeout(limit, self.exchange(hello));
        exchange.await.map_err(|_| HandshakeError::TimedOut(limit))?
    }

    async fn exchange(self, hello: Hello) -> Result<(Connection<S>, Welcome), HandshakeError> {
        let Proved(mut connection) = self;
        let ours = hello.versions;
        connection.send(&hello.into()).await?;
        match connection.recv().await? {
            Some(Message::Welcome(welcome)) => {
                let spoken = ours.oldest..=ours.newest;
                if !spoken.contains(&welcome.version) {
                    return Err(HandshakeError::OutOfPlace);
                }
                connection.open(welcome.version);
                Ok((connection, welcome))
            }
            Some(Message::Refused(Refused { refusal, text })) => {
                Err(HandshakeError::Refused { refusal, text })
            }
            Some(_) => Err(HandshakeError::OutOfPlace),
            None => Err(HandshakeError::Hangup),
        }
    }
}

/// The channel of the side that connects.
async fn open_channel<S: AsyncRead + AsyncWrite>(
    connection: &mut Connection<S>,
    token: &FarmToken,
) -> Result<(), HandshakeError> {
    let (opening, bytes) = Opening::new(token).map_err(LinkError::from)?;
    connection.writer.stream.write_all(&bytes).await.map_err(LinkError::from)?;
    connection.writer.stream.flush().await.map_err(LinkError::from)?;
    let reader = &mut connection.reader;
    let mut magic = [0; 4];
    reader.stream.read_exact(&mut magic).await.map_err(ended)?;
    if magic == frame::MAGIC {
        // Not a proof: the only thing that can come in plain is a refusal.
        reader.buffer.extend_from_slice(&magic);
        return Err(match reader.recv().await? {
            Some(Message::Refused(refused)) => HandshakeError::TurnedAway(refused.refusal),
            Some(_) => HandshakeError::OutOfPlace,
            None => HandshakeError::Hangup,
        });
    }
    let mut version = [0; 2];
    let mut proof = [0; PROOF_BYTES];
    if magic != channel::MAGIC {
        return Err(LinkError::from(WireError::NotOurs { found: magic }).into());
    }
    reader.stream.read_exact(&mut version).await.map_err(ended)?;
    reader.stream.read_exact(&mut proof).await.map_err(ended)?;
    if version != channel::PREAMBLE[4..] {
        return Err(HandshakeError::TurnedAway(Refusal::Version));
    }
    let (sealer, opener) = opening.finish(&proof).map_err(LinkError::from)?;
    connection.secure(sealer, opener);
    Ok(())
}

/// A stream that ends inside a greeting is a peer that hung up.
fn ended(error: io::Error) -> HandshakeError {
    match error.kind() {
        io::ErrorKind::UnexpectedEof => HandshakeError::Hangup,
        _ => LinkError::from(error).into(),
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

/// Waits for the [`Hello`] of a peer, behind the proof of the token if there is one. A
/// peer without a common version, one that does not prove the token, or one that sends
/// something else, is refused here. `limit` is for all of that together.
///
/// `program` names this side in the refusal: program and version.
pub async fn accept<S: AsyncRead + AsyncWrite>(
    stream: S,
    token: Option<&FarmToken>,
    program: &str,
    limit: Duration,
) -> Result<Greeting<S>, HandshakeError> {
    let mut connection = Connection::new(stream);
    let hearing = hear(&mut connection, token, program);
    let (refusal, text) = match tokio::time::timeout(limit, hearing).await {
        Err(_) => return Err(HandshakeError::TimedOut(limit)),
        Ok(Ok((hello, version))) => return Ok(Greeting { connection, hello, version, limit }),
        Ok(Err(No::Lost(why))) => return Err(why),
        Ok(Err(No::Say(refusal, text))) => (refusal, text),
    };
    refuse(connection, refusal, &text, limit).await
}

/// Why a peer is not let in.
enum No {
    /// It is told.
    Say(Refusal, String),
    /// Nobody is there to be told, or nobody whom it would help.
    Lost(HandshakeError),
}

impl<E: Into<LinkError>> From<E> for No {
    fn from(why: E) -> Self {
        match why.into() {
            LinkError::Wire(WireError::NotOurs { found: channel::MAGIC }) => {
                No::Say(Refusal::PlainOnly, PLAIN_ONLY.to_owned())
            }
            LinkError::Wire(error) => No::Say(Refusal::Malformed, error.to_string()),
            broken => No::Lost(broken.into()),
        }
    }
}

/// Hears a peer out: its greeting and the version to speak.
async fn hear<S: AsyncRead + AsyncWrite>(
    connection: &mut Connection<S>,
    token: Option<&FarmToken>,
    program: &str,
) -> Result<(Hello, u16), No> {
    if let Some(token) = token {
        admit(connection, token).await?;
    }
    match connection.recv().await? {
        None => Err(No::Lost(HandshakeError::Hangup)),
        Some(Message::Hello(hello)) => match Versions::OURS.common(hello.versions) {
            Some(version) => Ok((hello, version)),
            None => Err(No::Say(Refusal::Version, version_advice(program, &hello))),
        },
        Some(_) => Err(No::Say(Refusal::Malformed, "expected a greeting".to_owned())),
    }
}

/// The channel of the side that is connected to.
async fn admit<S: AsyncRead + AsyncWrite>(
    connection: &mut Connection<S>,
    token: &FarmToken,
) -> Result<(), No> {
    let unproven = || No::Say(Refusal::Token, UNPROVEN.to_owned());
    let reader = &mut connection.reader.stream;
    let (mut magic, mut version, mut proof) = ([0; 4], [0; 2], [0; PROOF_BYTES]);
    let hung_up = |error| No::Lost(ended(error));
    reader.read_exact(&mut magic).await.map_err(hung_up)?;
    if magic != channel::MAGIC {
        return Err(unproven());
    }
    reader.read_exact(&mut version).await.map_err(hung_up)?;
    if version != channel::PREAMBLE[4..] {
        return Err(No::Say(Refusal::Version, CHANNEL_VERSION.to_owned()));
    }
    reader.read_exact(&mut proof).await.map_err(hung_up)?;
    let (answer, sealer, opener) = match channel::answer(token, &proof) {
        Ok(admitted) => admitted,
        Err(ChannelError::Unproven) => return Err(unproven()),
        Err(why) => return Err(why.into()),
    };
    let writer = &mut connection.writer.stream;
    writer.write_all(&answer).await?;
    writer.flush().await?;
    connection.secure(sealer, opener);
    Ok(())
}

/// What a peer is told that does not prove the token: always the same.
const UNPROVEN: &str = "this farm lets in who proves its token; \"terrafarm token\" prints it on \
                        the coordinator's PC, \"terrafarm token --enter\" takes it here";
/// What a peer with a token is told by a side without one.
const PLAIN_ONLY: &str = "this farm has no token and speaks plain links only";
/// What a peer is told whose secure channel is of another version.
const CHANNEL_VERSION: &str = "this farm speaks another version of secure links: upgrade the \
                               older side";

/// What a refusal means that came before the coordinator had proved itself.
fn unproven_advice(refusal: Refusal) -> &'static str {
    match refusal {
        Refusal::Token => {
            "does not accept the farm token that was given here; on its PC \"terrafarm token\" \
             prints the right one, here \"terrafarm token --enter\" takes it"
        }
        Refusal::PlainOnly => {
            "has no farm token, but one was given here, so nothing was sent in plain; start it \
             with the token, or say --plain here"
        }
        Refusal::Version => "speaks another version of secure links; upgrade the older side",
        Refusal::Full => "is full",
        Refusal::Closing => "is shutting down",
        Refusal::Malformed => "did not understand the greeting; is it the same program?",
    }
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
        connection.writer.close().await?;
        let mut unread = (&mut connection.reader.stream).take(UNREAD_MAX);
        tokio::io::copy(&mut unread, &mut tokio::io::sink()).await?;
        Ok::<_, LinkError>(())
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
