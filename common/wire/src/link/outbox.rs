//! Two queues before one writer, so that a heartbeat never waits for a whole picture.
//!
//! Messages of [`Lane::Urgent`] pass between the parts of a message of [`Lane::Bulk`].
//! Both queues are bounded; a sender that awaits is held back, one that must not wait
//! uses [`Outbox::try_send`].

use super::{LinkError, Writer};
use crate::codec::{Frames, encode};
use crate::message::{Lane, Message};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tokio::io::{AsyncWrite, AsyncWriteExt};
use tokio::sync::mpsc;

/// Where messages for one peer go. Clones feed the same connection.
#[derive(Debug, Clone)]
pub struct Outbox {
    urgent: mpsc::Sender<Message>,
    bulk: mpsc::Sender<(Message, Load)>,
    meter: Meter,
}

/// The other end, for [`Writer::run`].
#[derive(Debug)]
pub struct OutboxEnd {
    urgent: mpsc::Receiver<Message>,
    bulk: mpsc::Receiver<(Message, Load)>,
}

/// Bytes behind the messages that wait in outboxes, or are being written; clones count
/// together.
#[derive(Debug, Clone, Default)]
pub struct Meter(Arc<AtomicU64>);

impl Meter {
    /// How many they are now.
    pub fn bytes(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }

    fn load(&self, message: &Message) -> Load {
        let bytes = message.payload().len() as u64;
        self.0.fetch_add(bytes, Ordering::Relaxed);
        Load { meter: self.clone(), bytes }
    }
}

/// The bytes behind one message; counted until it is dropped.
#[derive(Debug)]
struct Load {
    meter: Meter,
    bytes: u64,
}

impl Drop for Load {
    fn drop(&mut self) {
        self.meter.0.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

/// Why a message was not queued.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unsent {
    /// Its lane is full: the peer takes less than it is given.
    Full,
    /// The connection has ended.
    Closed,
}

/// Two queues of these capacities, messages.
///
/// # Panics
/// If a capacity is 0.
pub fn outbox(urgent: usize, bulk: usize) -> (Outbox, OutboxEnd) {
    metered(urgent, bulk, Meter::default())
}

/// The same, with a meter of what waits.
///
/// # Panics
/// If a capacity is 0.
pub fn metered(urgent: usize, bulk: usize, meter: Meter) -> (Outbox, OutboxEnd) {
    let (urgent_in, urgent_out) = mpsc::channel(urgent);
    let (bulk_in, bulk_out) = mpsc::channel(bulk);
    let outbox = Outbox { urgent: urgent_in, bulk: bulk_in, meter };
    (outbox, OutboxEnd { urgent: urgent_out, bulk: bulk_out })
}

impl Outbox {
    /// Queues a message on its lane; waits while that lane is full.
    pub async fn send(&self, message: impl Into<Message>) -> Result<(), LinkError> {
        let message = message.into();
        match message.lane() {
            Lane::Urgent => self.urgent.send(message).await.map_err(|_| LinkError::Closed),
            Lane::Bulk => {
                let load = self.meter.load(&message);
                self.bulk.send((message, load)).await.map_err(|_| LinkError::Closed)
            }
        }
    }

    /// Queues a message if there is room on its lane; it is dropped if there is none, or
    /// if the connection is closed.
    pub fn try_send(&self, message: impl Into<Message>) -> Result<(), Unsent> {
        let message = message.into();
        match message.lane() {
            Lane::Urgent => self.urgent.try_send(message).map_err(unsent),
            Lane::Bulk => {
                let load = self.meter.load(&message);
                self.bulk.try_send((message, load)).map_err(unsent)
            }
        }
    }

    /// Whether the connection has ended.
    pub fn is_closed(&self) -> bool {
        self.urgent.is_closed()
    }
}

fn unsent<T>(refused: mpsc::error::TrySendError<T>) -> Unsent {
    match refused {
        mpsc::error::TrySendError::Full(_) => Unsent::Full,
        mpsc::error::TrySendError::Closed(_) => Unsent::Closed,
    }
}

/// What the writer does next.
enum Next {
    Urgent(Message),
    Bulk(Message, Load),
    Part,
    End,
}

impl<W: AsyncWrite + Unpin> Writer<W> {
    /// Sends what comes out of the queues until every [`Outbox`] is dropped and all is
    /// sent, then closes the stream.
    pub async fn run(mut self, mut queues: OutboxEnd) -> Result<(), LinkError> {
        let mut train: Option<(Frames, Load)> = None;
        loop {
            match queues.next(train.is_some()).await {
                Next::Urgent(message) => self.send(&message).await?,
                Next::Bulk(message, load) => {
                    train = Some((encode(self.version, &message)?, load));
                }
                Next::End => return self.close().await,
                Next::Part => match train.as_mut().and_then(|(frames, _)| frames.next()) {
                    Some(frame) => self.write(frame).await?,
                    None => {
                        train = None;
                        self.stream.flush().await?;
                    }
                },
            }
        }
    }
}

impl OutboxEnd {
    /// The next message, urgent ones first, for a peer inside this process; `None` when
    /// every [`Outbox`] is dropped and all is taken. Cancel safe.
    pub async fn recv(&mut self) -> Option<Message> {
        match self.next(false).await {
            Next::Urgent(message) | Next::Bulk(message, _) => Some(message),
            Next::Part | Next::End => None,
        }
    }

    async fn next(&mut self, in_train: bool) -> Next {
        if in_train {
            return self.urgent.try_recv().map_or(Next::Part, Next::Urgent);
        }
        tokio::select! {
            biased;
            Some(message) = self.urgent.recv() => Next::Urgent(message),
            Some((message, load)) = self.bulk.recv() => Next::Bulk(message, load),
            else => Next::End,
        }
    }
}
