//! The one module that awaits: messages over any byte stream.
//!
//! [`greet`] and [`accept`] do the handshake and give a [`Connection`], which splits
//! into a [`Reader`] and a [`Writer`]. The rest of the program sees whole messages.
//! [`outbox()`] keeps small messages from waiting behind long ones.
//!
//! With a [`FarmToken`] everything is encrypted and both sides prove that they have it
//! before the first message (`channel`); [`Trust`] says where a link may do without.
//!
//! A stream that ends between two messages is a clean end, `Ok(None)`; one that ends
//! inside a message is an error, and the difference is kept.

mod channel;
pub mod handshake;
pub mod outbox;
mod pace;
mod token;
mod trust;

pub use channel::ChannelError;
pub use handshake::{Greeting, HandshakeError, Proved, accept, greet, program, prove};
pub use outbox::{Meter, Outbox, OutboxEnd, Unsent, metered, outbox};
pub use pace::Paced;
pub use token::{FarmToken, NoRandomness, TOKEN_BYTES, TokenError};
pub use trust::{Trust, is_this_pc};

use crate::codec::{Decoder, Phase, WireError, encode};
use crate::frame::EncodedFrame;
use crate::limits::NEWEST_VERSION;
use crate::message::Message;
use bytes::{Buf, BytesMut};
use channel::{Opener, RECORD_BYTES_MAX, RECORD_MAX, Sealer};
use std::io;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadHalf, WriteHalf};
use tokio::time::{Instant, timeout_at};

/// A peer that watches another, or is watched, makes something of a long message so often
/// while it comes: on a slow link a heartbeat would wait behind it.
pub const WHILE_IT_COMES: Duration = Duration::from_millis(50);

/// Why a connection has ended other than cleanly.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The operating system says so.
    #[error("the connection broke: {0}")]
    Io(#[from] io::Error),
    /// The peer sent what it must not, or we were about to.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// What came over a secure link is not what the peer sealed.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The stream ended inside a message: the peer died.
    #[error("the peer vanished in the middle of a message")]
    Cut,
    /// Not a byte for longer than agreed.
    #[error("the peer has been silent for {} ms", .0.as_millis())]
    Silent(Duration),
    /// The task that writes has ended.
    #[error("the connection is closed")]
    Closed,
}

/// A byte stream as a stream of messages, both ways.
#[derive(Debug)]
pub struct Connection<S> {
    reader: Reader<ReadHalf<S>>,
    writer: Writer<WriteHalf<S>>,
}

impl<S: AsyncRead + AsyncWrite> Connection<S> {
    /// Over a fresh stream on which only greetings have a place.
    fn new(stream: S) -> Self {
        let (read, write) = tokio::io::split(stream);
        let decoder = Decoder::new(Phase::Greeting);
        Connection {
            reader: Reader {
                stream: read,
                buffer: BytesMut::new(),
                decoder,
                heard: Instant::now(),
                told: None,
                secure: None,
            },
            writer: Writer { stream: write, version: NEWEST_VERSION, secure: None },
        }
    }

    /// From now on all bytes of both directions are records of a channel. Nothing has
    /// been read beyond its openings.
    fn secure(&mut self, sealer: Sealer, opener: Opener) {
        self.writer.secure = Some((sealer, BytesMut::new()));
        self.reader.secure = Some((opener, BytesMut::new()));
    }

    /// The handshake is over: both sides speak this version now.
    fn open(&mut self, version: u16) {
        self.reader.decoder.open(version);
        self.writer.version = version;
    }

    /// The halves, for two tasks.
    pub fn split(self) -> (Reader<ReadHalf<S>>, Writer<WriteHalf<S>>) {
        (self.reader, self.writer)
    }

    /// As [`Reader::recv`].
    pub async fn recv(&mut self) -> Result<Option<Message>, LinkError> {
        self.reader.recv().await
    }

    /// As [`Writer::send`].
    pub async fn send(&mut self, message: &Message) -> Result<(), LinkError> {
        self.writer.send(message).await
    }
}

/// What comes from a peer.
#[derive(Debug, Clone, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "nearly all of it are messages")]
pub enum Heard {
    /// A message.
    Message(Message),
    /// The first part of a payload of so many bytes: the rest is on its way.
    Claim(usize),
    /// More of a message that is not whole yet: the peer lives.
    More,
    /// The end: the peer has closed between two messages.
    End,
}

/// The half that receives.
#[derive(Debug)]
pub struct Reader<R> {
    stream: R,
    buffer: BytesMut,
    decoder: Decoder,
    /// When the last byte came.
    heard: Instant,
    /// When a message that is not whole began to come, or was last told of.
    told: Option<Instant>,
    /// Of a secure link: what opens its records, and what has arrived of them.
    secure: Option<(Opener, BytesMut)>,
}

impl<R: AsyncRead + Unpin> Reader<R> {
    /// The next message; `None` when the peer has closed between two messages.
    ///
    /// Cancel safe: what has arrived is kept for the next call.
    pub async fn recv(&mut self) -> Result<Option<Message>, LinkError> {
        self.next_message(None).await
    }

    /// As [`Reader::recv`], but fails with [`LinkError::Silent`] when not one byte has come
    /// for so long, cancelled calls included. A long message that trickles in is not
    /// silence.
    pub async fn recv_within(&mut self, silence: Duration) -> Result<Option<Message>, LinkError> {
        self.next_message(Some(silence)).await
    }

    async fn next_message(
        &mut self,
        silence: Option<Duration>,
    ) -> Result<Option<Message>, LinkError> {
        loop {
            match self.hear(silence).await? {
                Heard::Message(message) => return Ok(Some(message)),
                Heard::Claim(_) | Heard::More => {}
                Heard::End => return Ok(None),
            }
        }
    }

    /// As [`Reader::recv_within`] where there is a limit, else as [`Reader::recv`]; but says
    /// when a long payload begins, before more than a few parts of it are taken: a receiver
    /// with little memory calls again when it has some, and until then the sender is held
    /// back. And while a message comes for longer than [`WHILE_IT_COMES`], it says so after
    /// each such time in which bytes of it came.
    pub async fn hear(&mut self, silence: Option<Duration>) -> Result<Heard, LinkError> {
        let mut has_read = false;
        loop {
            if let Some(message) = self.decoder.decode(&mut self.buffer)? {
                self.told = None;
                return Ok(Heard::Message(message));
            }
            if let Some(bytes) = self.decoder.take_claim() {
                return Ok(Heard::Claim(bytes));
            }
            let arrived = match &mut self.secure {
                None => &mut self.buffer,
                Some((opener, arrived)) => {
                    if opener.open(arrived, &mut self.buffer)? {
                        continue;
                    }
                    arrived.reserve(RECORD_BYTES_MAX.saturating_sub(arrived.len()).max(1));
                    arrived
                }
            };
            if std::mem::take(&mut has_read) {
                let told = *self.told.get_or_insert(self.heard);
                if self.heard - told >= WHILE_IT_COMES {
                    self.told = Some(self.heard);
                    return Ok(Heard::More);
                }
            }
            let read = self.stream.read_buf(arrived);
            let count = match silence {
                None => read.await?,
                Some(limit) => {
                    let silent = self.heard + limit;
                    timeout_at(silent, read).await.map_err(|_| LinkError::Silent(limit))??
                }
            };
            if count == 0 {
                let whole = self.secure.as_ref().is_none_or(|(_, arrived)| arrived.is_empty());
                let clean = whole && self.buffer.is_empty() && !self.decoder.is_inside_message();
                return if clean { Ok(Heard::End) } else { Err(LinkError::Cut) };
            }
            self.heard = Instant::now();
            has_read = true;
        }
    }
}

/// The half that sends.
#[derive(Debug)]
pub struct Writer<W> {
    stream: W,
    version: u16,
    /// Of a secure link: what makes its records, and those to be written.
    secure: Option<(Sealer, BytesMut)>,
}

impl<W: AsyncWrite + Unpin> Writer<W> {
    /// Sends one message, in parts if it is long. Not cancel safe: after a cancelled
    /// call the stream is out of step.
    pub async fn send(&mut self, message: &Message) -> Result<(), LinkError> {
        for frame in encode(self.version, message)? {
            self.write(frame).await?;
        }
        self.stream.flush().await?;
        Ok(())
    }

    /// Tells the peer that nothing follows.
    pub async fn close(&mut self) -> Result<(), LinkError> {
        Ok(self.stream.shutdown().await?)
    }

    /// Writes one frame: start and payload together where the stream can.
    async fn write(&mut self, frame: EncodedFrame) -> Result<(), LinkError> {
        let Some((sealer, records)) = &mut self.secure else {
            return write_all(&mut self.stream, &mut frame.start.chain(frame.payload)).await;
        };
        // Record by record, so that the first one is on its way while the next is sealed.
        records.clear();
        sealer.seal(&frame.start, records)?;
        for piece in frame.payload.chunks(RECORD_MAX) {
            sealer.seal(piece, records)?;
            write_all(&mut self.stream, records).await?;
        }
        write_all(&mut self.stream, records).await
    }
}

async fn write_all(
    stream: &mut (impl AsyncWrite + Unpin),
    bytes: &mut impl Buf,
) -> Result<(), LinkError> {
    while bytes.has_remaining() {
        if stream.write_buf(bytes).await? == 0 {
            return Err(io::Error::from(io::ErrorKind::WriteZero).into());
        }
    }
    Ok(())
}
