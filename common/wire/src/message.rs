//! What travels: every message, by who sends it.
//!
//! [`hello`] opens and keeps a connection, [`blob`] moves terrain, [`work`] passes
//! between coordinator and worker, [`shot`] between client and coordinator, [`desk`] carries
//! requests to the coordinator's API. The table at
//! the foot of this file gives each its number, which is never reused.
//!
//! A [`Message`] in memory is always fit: the decoder checks it before anyone sees it,
//! the encoder before it leaves. Bytes behind a message (blobs, pixels) are a field of
//! it, so they cannot get lost or join the wrong kind.

pub mod blob;
pub mod desk;
pub mod hello;
pub mod shot;
pub mod work;

pub use blob::{Blob, Elsewhere, NoBlob, Sharing, WantBlobs};
pub use desk::{Request, Response, Verb};
pub use hello::{Goodbye, Hello, Ping, Pong, Refusal, Refused, Role, Versions, Welcome};
pub use shot::{
    Accepted, Cameras, Cancel, Frame, FrameFailed, FrameTaken, Progress, Rejected, ShotDone,
    ShotFailed, Submit, WorkerShare,
};
pub use work::{
    Ahead, CloseShot, Done, Drain, Failed, Grant, HandBack, OpenShot, RenderReport, Revoke, Speed,
    Status, Timesheet,
};

use crate::limits::{Class, NAME_BYTES_MAX, REASON_BYTES_MAX};
use bytes::Bytes;
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Why a value may not travel: what is wrong with it, in words.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Unfit(pub String);

impl Unfit {
    /// `Ok` if the condition holds.
    pub(crate) fn unless(holds: bool, what: &str) -> Result<(), Unfit> {
        if holds { Ok(()) } else { Err(Unfit(what.to_owned())) }
    }
}

/// How one message is written, read and checked.
pub(crate) trait Body: Sized {
    /// What is serialized: the message itself or its twin.
    type Wire: Serialize + DeserializeOwned;

    /// The twin of this message.
    fn to_wire(&self) -> Self::Wire;

    /// The message of a twin.
    fn from_wire(wire: Self::Wire) -> Result<Self, Unfit>;

    /// Whether every value is one that an honest peer sends.
    fn check(&self) -> Result<(), Unfit> {
        Ok(())
    }

    /// The bytes behind the message.
    fn payload(&self) -> Bytes {
        Bytes::new()
    }

    /// Puts the bytes behind the message in their place.
    fn set_payload(&mut self, _payload: Bytes) {}
}

/// The functions of [`Body`] for a message that is its own twin.
macro_rules! own_twin {
    () => {
        type Wire = Self;

        fn to_wire(&self) -> Self {
            self.clone()
        }

        fn from_wire(wire: Self) -> Result<Self, $crate::message::Unfit> {
            Ok(wire)
        }
    };
}
pub(crate) use own_twin;

/// Refuses names that are too long.
pub(crate) fn fit_name(name: &str) -> Result<(), Unfit> {
    Unfit::unless(name.len() <= NAME_BYTES_MAX, "a name is too long")
}

/// Refuses reasons that are too long; [`crate::limits::clip_reason`] shortens them.
pub(crate) fn fit_reason(reason: &str) -> Result<(), Unfit> {
    Unfit::unless(reason.len() <= REASON_BYTES_MAX, "a reason is too long")
}

macro_rules! messages {
    ($($(#[$doc:meta])* $name:ident = $kind:literal, $class:ident;)*) => {
        /// Any message.
        #[derive(Debug, Clone, PartialEq)]
        pub enum Message {
            $($(#[$doc])* $name($name),)*
        }

        $(impl From<$name> for Message {
            fn from(message: $name) -> Self {
                Message::$name(message)
            }
        })*

        impl Message {
            /// Every kind there is: number, name and class.
            pub const KINDS: &[(u16, &'static str, Class)] =
                &[$(($kind, stringify!($name), Class::$class),)*];

            /// Number of the kind on the wire.
            pub fn kind(&self) -> u16 {
                match self {
                    $(Message::$name(_) => $kind,)*
                }
            }

            /// Whether every value is one that an honest peer sends.
            pub(crate) fn check(&self) -> Result<(), Unfit> {
                match self {
                    $(Message::$name(message) => message.check(),)*
                }
            }

            /// The bytes behind the message.
            pub(crate) fn payload(&self) -> Bytes {
                match self {
                    $(Message::$name(message) => message.payload(),)*
                }
            }

            /// The head in postcard.
            pub(crate) fn head(&self) -> Result<Vec<u8>, postcard::Error> {
                match self {
                    $(Message::$name(message) => postcard::to_stdvec(&message.to_wire()),)*
                }
            }

            /// Reads the head of a kind: the message and how many bytes were left over.
            /// `None` for a kind that this version does not know.
            pub(crate) fn read(
                kind: u16,
                head: &[u8],
                payload: Bytes,
            ) -> Option<Result<(Message, usize), ReadError>> {
                match kind {
                    $($kind => Some(read_body::<$name>(head, payload)
                        .map(|(message, left)| (Message::$name(message), left))),)*
                    _ => None,
                }
            }
        }
    };
}

/// Why a head could not be read.
pub(crate) enum ReadError {
    /// The bytes are no such message.
    Malformed,
    /// They are, but the values are unfit.
    Unfit(Unfit),
}

fn read_body<B: Body>(head: &[u8], payload: Bytes) -> Result<(B, usize), ReadError> {
    let (wire, left) =
        postcard::take_from_bytes::<B::Wire>(head).map_err(|_| ReadError::Malformed)?;
    let mut message = B::from_wire(wire).map_err(ReadError::Unfit)?;
    message.set_payload(payload);
    message.check().map_err(ReadError::Unfit)?;
    Ok((message, left.len()))
}

/// Name of a kind for people; `unknown` if this version does not know it.
pub fn kind_name(kind: u16) -> &'static str {
    Message::KINDS.iter().find(|known| known.0 == kind).map_or("unknown", |known| known.1)
}

/// Class of a kind; `None` if this version does not know it.
pub fn kind_class(kind: u16) -> Option<Class> {
    Message::KINDS.iter().find(|known| known.0 == kind).map(|known| known.2)
}

/// Kind of a frame that holds a part of a long payload; the codec knows no others than
/// these and never shows them. See [`crate::codec`].
pub(crate) const PART_KIND: u16 = 0x0F;

/// Which messages may overtake others on one connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lane {
    /// Small and soon: passes between the parts of a long message.
    Urgent,
    /// Long, or only true once the long ones before it have arrived.
    Bulk,
}

impl Message {
    /// The lane of this message. Within a lane, order is kept.
    pub fn lane(&self) -> Lane {
        match self {
            Message::Blob(_)
            | Message::Done(_)
            | Message::Frame(_)
            | Message::ShotDone(_)
            | Message::Request(_)
            | Message::Response(_)
            | Message::ShotFailed(_)
            | Message::Goodbye(_) => Lane::Bulk,
            _ => Lane::Urgent,
        }
    }
}

messages! {
    /// Both ways: who speaks.
    Hello = 0x01, Hello;
    /// The answer that opens the connection.
    Welcome = 0x02, Hello;
    /// The answer that does not.
    Refused = 0x03, Hello;
    /// Both ways: are you there.
    Ping = 0x04, Control;
    /// Both ways: yes.
    Pong = 0x05, Control;
    /// Both ways: this connection ends on purpose.
    Goodbye = 0x06, Control;

    /// Worker to coordinator and coordinator to client: blobs needed.
    WantBlobs = 0x10, Control;
    /// The answer, one a blob.
    Blob = 0x11, Blob;
    /// The answer when there is no such blob.
    NoBlob = 0x12, Control;
    /// Coordinator to worker: the answer when others should be asked.
    Elsewhere = 0x13, Control;
    /// Worker to coordinator: others may ask it for blobs.
    Sharing = 0x14, Control;

    /// Coordinator to worker: what the following grants belong to.
    OpenShot = 0x20, Control;
    /// Coordinator to worker: one job.
    Grant = 0x21, Control;
    /// Coordinator to worker: stop that job.
    Revoke = 0x22, Control;
    /// Coordinator to worker: no more grants of that shot.
    CloseShot = 0x23, Control;
    /// Coordinator to worker: finish what runs, hand back the rest, leave.
    Drain = 0x24, Control;
    /// Coordinator to worker: where its cameras will be.
    Ahead = 0x25, Control;

    /// Worker to coordinator: a job's pixels.
    Done = 0x30, Pixels;
    /// Worker to coordinator: a job could not be done.
    Failed = 0x31, Control;
    /// Worker to coordinator: jobs not begun.
    HandBack = 0x32, Control;
    /// Worker to coordinator: how fast it is.
    Speed = 0x33, Control;
    /// Worker to coordinator: what its caches hold, and how many threads it uses.
    Status = 0x34, Control;

    /// Client to coordinator: a new shot.
    Submit = 0x40, Submission;
    /// Client to coordinator: its cameras, in pieces.
    Cameras = 0x41, Submission;
    /// Client to coordinator: a frame is safely stored.
    FrameTaken = 0x42, Control;
    /// Client to coordinator: the shot is no longer wanted.
    Cancel = 0x43, Control;

    /// Coordinator to client: the shot's number on the farm.
    Accepted = 0x50, Control;
    /// Coordinator to client: the shot was not taken.
    Rejected = 0x51, Control;
    /// Coordinator to client: a finished frame.
    Frame = 0x52, Pixels;
    /// Coordinator to client: a frame that could not be made.
    FrameFailed = 0x53, Control;
    /// Coordinator to client: how far it is.
    Progress = 0x54, Control;
    /// Coordinator to client: all frames are made or have failed.
    ShotDone = 0x55, Control;
    /// Coordinator to client: the shot has been given up.
    ShotFailed = 0x56, Control;

    /// Desk to coordinator: something of the API.
    Request = 0x60, Desk;
    /// Coordinator to desk: the answer.
    Response = 0x61, Desk;
}
