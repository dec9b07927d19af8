//! The one module that awaits: messages over any byte stream.
//!
//! [`greet`] and [`accept`] do the handshake and give a [`Connection`], which splits
//! into a [`Reader`] and a [`Writer`]. The rest of the program sees whole messages.
//! [`outbox()`] keeps small messages from waiting behind long ones.
//!
//! A stream that ends between two messages is a clean end, `Ok(None)`; one that ends
//! inside a message is an error, and the difference is kept.

pub mod handshake;
pub mod outbox;

pub use handshake::{Greeting, HandshakeError, accept, greet, program};
pub use outbox::{Outbox, OutboxEnd, Unsent, outbox};

use crate::codec::{Decoder, Phase, WireError, encode};
use crate::frame::EncodedFrame;
use crate::limits::NEWEST_VERSION;
use crate::message::Message;
use bytes::{Buf, BytesMut};
use std::io;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadHalf, WriteHalf};
use tokio::time::{Instant, timeout_at};

/// Why a connection has ended other than cleanly.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The operating system says so.
    #[error("the connection broke: {0}")]
    Io(#[from] io::Error),
    /// The peer sent what it must not, or we were about to.
    #[error(transparent)]
    Wire(#[from] WireError),
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
            },
            writer: Writer { stream: write, version: NEWEST_VERSION },
        }
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

/// The half that receives.
#[derive(Debug)]
pub struct Reader<R> {
    stream: R,
    buffer: BytesMut,
    decoder: Decoder,
    /// When the last byte came.
    heard: Instant,
}

impl<R: AsyncRead + Unpin> Reader<R> {
    /// The next message; `None` when the peer has closed between two messages.
    ///
    /// Cancel safe: what has arrived is kept for the next call.
    pub async fn recv(&mut self) -> Result<Option<Message>, LinkError> {
        self.next(None).await
    }

    /// As [`Reader::recv`], but fails with [`LinkError::Silent`] when not one byte has come
    /// for so long, cancelled calls included. A long message that trickles in is not
    /// silence.
    pub async fn recv_within(&mut self, silence: Duration) -> Result<Option<Message>, LinkError> {
        self.next(Some(silence)).await
    }

    async fn next(&mut self, silence: Option<Duration>) -> Result<Option<Message>, LinkError> {
        loop {
            if let Some(message) = self.decoder.decode(&mut self.buffer)? {
                return Ok(Some(message));
            }
            let read = self.stream.read_buf(&mut self.buffer);
            let count = match silence {
                None => read.await?,
                Some(limit) => {
                    let silent = self.heard + limit;
                    timeout_at(silent, read).await.map_err(|_| LinkError::Silent(limit))??
                }
            };
            if count == 0 {
                let clean = self.buffer.is_empty() && !self.decoder.is_inside_message();
                return if clean { Ok(None) } else { Err(LinkError::Cut) };
            }
            self.heard = Instant::now();
        }
    }
}

/// The half that sends.
#[derive(Debug)]
pub struct Writer<W> {
    stream: W,
    version: u16,
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
        let mut bytes = frame.start.chain(frame.payload);
        while bytes.has_remaining() {
            if self.stream.write_buf(&mut bytes).await? == 0 {
                return Err(io::Error::from(io::ErrorKind::WriteZero).into());
            }
        }
        Ok(())
    }
}
