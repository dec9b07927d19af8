//! Messages to bytes and back, without I/O: what the link, the tests and the fuzzer share.
//!
//! A payload longer than [`PART_BYTES`] is cut: its beginning travels in frames of kind
//! `Part`, each naming the kind and the total length of what it belongs to; the message
//! itself comes last with the rest. Other messages without payload may pass between
//! them. The receiver's memory grows with what has arrived, never with what is claimed.

use crate::frame::{EncodedFrame, FRAME_BYTES_MAX, HEADER_BYTES, Header, checksum};
use crate::limits::{Class, NEWEST_VERSION, PART_BYTES};
use crate::message::{Message, PART_KIND, ReadError, Unfit, kind_class, kind_name};
use bytes::{Bytes, BytesMut};
use serde::{Deserialize, Serialize};

/// Why bytes are no message, or a message may not become bytes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// The other side is no terrafarm, or the stream is out of step.
    #[error(
        "the peer does not speak the terrafarm protocol (it sent {found:02x?}); is the address right?"
    )]
    NotOurs {
        /// What stood in the place of the magic.
        found: [u8; 4],
    },
    /// A frame of a version that was not agreed.
    #[error("a message of protocol version {found} where version {agreed} was agreed")]
    Version {
        /// The version of the frame.
        found: u16,
        /// The version agreed in the handshake.
        agreed: u16,
    },
    /// A declared length is above its limit; nothing was allocated for it.
    #[error("{} of {length} bytes; at most {limit} are allowed", named(*kind))]
    TooLong {
        /// Kind of the message.
        kind: u16,
        /// Length that was declared, bytes.
        length: u64,
        /// The limit, bytes.
        limit: u64,
    },
    /// The body is not what was sent.
    #[error("{} arrived damaged: its checksum is wrong", named(*kind))]
    Damaged {
        /// Kind of the message.
        kind: u16,
    },
    /// The head is not a message of its kind.
    #[error("{} cannot be read", named(*kind))]
    Malformed {
        /// Kind of the message.
        kind: u16,
    },
    /// The message can be read, but no honest peer sends these values.
    #[error("{} is refused: {why}", named(*kind))]
    Unfit {
        /// Kind of the message.
        kind: u16,
        /// What is wrong with it.
        why: Unfit,
    },
    /// A message that has no place here: parts that belong to nothing, or anything but
    /// a greeting before the greeting.
    #[error("{} is out of place", named(*kind))]
    OutOfPlace {
        /// Kind of the message.
        kind: u16,
    },
    /// The bytes end inside a message.
    #[error("the bytes end inside a message")]
    Truncated,
}

fn named(kind: u16) -> String {
    match kind {
        PART_KIND => "a part of a message".to_owned(),
        _ => format!("a message of kind {} ({kind:#06x})", kind_name(kind)),
    }
}

/// Head of a frame that holds a part of a payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct Part {
    /// Kind of the message it belongs to.
    kind: u16,
    /// Length of the whole payload, bytes.
    total: u32,
}

/// The frames of one message, made one at a time.
#[derive(Debug, Clone)]
pub struct Frames {
    version: u16,
    kind: u16,
    head: Vec<u8>,
    total: u32,
    rest: Bytes,
    finished: bool,
}

/// Begins to encode a message for a peer of this protocol version.
///
/// # Errors
/// [`WireError::Unfit`] and [`WireError::TooLong`], exactly where [`Decoder`] would.
pub fn encode(version: u16, message: &Message) -> Result<Frames, WireError> {
    let kind = message.kind();
    message.check().map_err(|why| WireError::Unfit { kind, why })?;
    let head = message.head().map_err(|_| WireError::Malformed { kind })?;
    let class = kind_class(kind).ok_or(WireError::OutOfPlace { kind })?;
    let rest = message.payload();
    for (length, limit) in [(head.len(), class.head_max()), (rest.len(), class.payload_max())] {
        if length > limit {
            let (length, limit) = (length as u64, limit as u64);
            return Err(WireError::TooLong { kind, length, limit });
        }
    }
    Ok(Frames { version, kind, head, total: rest.len() as u32, rest, finished: false })
}

impl Iterator for Frames {
    type Item = EncodedFrame;

    fn next(&mut self) -> Option<EncodedFrame> {
        if self.finished {
            return None;
        }
        if self.rest.len() > PART_BYTES {
            let part = Part { kind: self.kind, total: self.total };
            let head = postcard::to_stdvec(&part).expect("two numbers can be serialized");
            let chunk = self.rest.split_to(PART_BYTES);
            return Some(EncodedFrame::new(self.version, PART_KIND, &head, chunk));
        }
        self.finished = true;
        let rest = std::mem::take(&mut self.rest);
        Some(EncodedFrame::new(self.version, self.kind, &self.head, rest))
    }
}

/// How far a connection is, which decides what its decoder lets in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// Before the greeting: only handshake messages, of whatever version.
    Greeting,
    /// After it: everything of the agreed version.
    Open {
        /// The agreed version.
        version: u16,
    },
}

/// Turns a stream of bytes into messages.
#[derive(Debug)]
pub struct Decoder {
    phase: Phase,
    train: Option<Train>,
}

/// Parts that wait for their message.
#[derive(Debug)]
struct Train {
    part: Part,
    bytes: BytesMut,
    /// Whether its length was told.
    is_told: bool,
}

impl Decoder {
    /// A decoder at the beginning of a message.
    pub fn new(phase: Phase) -> Self {
        Decoder { phase, train: None }
    }

    /// The greeting is over: lets in everything of the agreed version.
    pub fn open(&mut self, version: u16) {
        self.phase = Phase::Open { version };
    }

    /// How long the payload will be whose first part has come, bytes; told once.
    pub fn take_claim(&mut self) -> Option<usize> {
        let train = self.train.as_mut().filter(|train| !train.is_told)?;
        train.is_told = true;
        Some(train.part.total as usize)
    }

    /// Whether parts of a message have come, but not yet the message.
    pub fn is_inside_message(&self) -> bool {
        self.train.is_some()
    }

    /// Takes the next message from the front of a buffer; `None` if more bytes are
    /// needed. Kinds that this version does not know are skipped. After an error the
    /// stream is out of step: close it.
    pub fn decode(&mut self, buffer: &mut BytesMut) -> Result<Option<Message>, WireError> {
        while let Some(start) = buffer.first_chunk::<HEADER_BYTES>() {
            let header = Header::read(start)?;
            let class = self.admit(&header)?;
            let frame_len = header.frame_len();
            if buffer.len() < frame_len {
                buffer.reserve(frame_len - buffer.len());
                return Ok(None);
            }
            let mut head = buffer.split_to(frame_len).freeze().split_off(HEADER_BYTES);
            let payload = head.split_off(header.head_len as usize);
            if checksum(&head, &payload) != header.checksum {
                return Err(WireError::Damaged { kind: header.kind });
            }
            if header.kind == PART_KIND {
                self.couple(&head, &payload)?;
            } else if let Some(class) = class {
                return self.read(header.kind, class, &head, payload).map(Some);
            }
        }
        Ok(None)
    }

    /// Judges a frame by its header; gives the class of a kind that is known.
    fn admit(&self, header: &Header) -> Result<Option<Class>, WireError> {
        let kind = header.kind;
        let class = if kind == PART_KIND { Some(Class::Blob) } else { kind_class(kind) };
        match self.phase {
            Phase::Greeting if class != Some(Class::Hello) => {
                return Err(WireError::OutOfPlace { kind });
            }
            Phase::Open { version } if header.version != version => {
                return Err(WireError::Version { found: header.version, agreed: version });
            }
            _ => {}
        }
        header.admit(class)?;
        Ok(class)
    }

    /// Appends a part to those before it.
    fn couple(&mut self, head: &[u8], payload: &[u8]) -> Result<(), WireError> {
        let out_of_place = WireError::OutOfPlace { kind: PART_KIND };
        let part: Part =
            postcard::from_bytes(head).map_err(|_| WireError::Malformed { kind: PART_KIND })?;
        let Some(class) = kind_class(part.kind) else {
            return Ok(());
        };
        let (length, limit) = (u64::from(part.total), class.payload_max() as u64);
        if length > limit {
            return Err(WireError::TooLong { kind: part.kind, length, limit });
        }
        let train = self.train.get_or_insert_with(|| Train {
            part,
            bytes: BytesMut::new(),
            is_told: false,
        });
        let fits = train.bytes.len() + payload.len() < part.total as usize;
        if train.part != part || payload.is_empty() || !fits {
            return Err(out_of_place);
        }
        train.bytes.extend_from_slice(payload);
        Ok(())
    }

    /// Reads a message whose bytes are all there.
    fn read(
        &mut self,
        kind: u16,
        class: Class,
        head: &[u8],
        payload: Bytes,
    ) -> Result<Message, WireError> {
        let payload = match self.train.take_if(|_| class.payload_max() > 0) {
            None => payload,
            Some(train) => train.complete(kind, &payload)?,
        };
        match Message::read(kind, head, payload) {
            None => Err(WireError::OutOfPlace { kind }),
            Some(Err(ReadError::Malformed)) => Err(WireError::Malformed { kind }),
            Some(Err(ReadError::Unfit(why))) => Err(WireError::Unfit { kind, why }),
            // Handshake messages may have grown in a later version; others may not.
            Some(Ok((_, 1..))) if class != Class::Hello => Err(WireError::Malformed { kind }),
            Some(Ok((message, _))) => Ok(message),
        }
    }
}

impl Train {
    /// The whole payload, if this is the message that the parts belong to.
    fn complete(mut self, kind: u16, rest: &[u8]) -> Result<Bytes, WireError> {
        let length = self.bytes.len() + rest.len();
        if self.part.kind != kind || self.part.total as usize != length {
            return Err(WireError::OutOfPlace { kind });
        }
        self.bytes.extend_from_slice(rest);
        Ok(self.bytes.freeze())
    }
}

/// All messages of a piece of an open stream of the newest version.
///
/// # Errors
/// As [`Decoder::decode`]; [`WireError::Truncated`] if the last message is not whole.
pub fn decode(bytes: &[u8]) -> Result<Vec<Message>, WireError> {
    let mut decoder = Decoder::new(Phase::Open { version: NEWEST_VERSION });
    let mut buffer = BytesMut::with_capacity(bytes.len().min(FRAME_BYTES_MAX));
    buffer.extend_from_slice(bytes);
    let mut messages = Vec::new();
    while let Some(message) = decoder.decode(&mut buffer)? {
        messages.push(message);
    }
    if buffer.is_empty() && !decoder.is_inside_message() {
        Ok(messages)
    } else {
        Err(WireError::Truncated)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::message::{Blob, Ping, Pong};
    use terrafarm_common::id::BlobHash;

    fn blob(length: usize) -> Message {
        let bytes = (0..length).map(|i| (i * 31 % 251) as u8).collect();
        Blob { hash: BlobHash([7; 32]), bytes }.into()
    }

    fn frames(message: &Message) -> Vec<EncodedFrame> {
        encode(NEWEST_VERSION, message).unwrap().collect()
    }

    fn bytes(frames: &[EncodedFrame]) -> Vec<u8> {
        frames.iter().flat_map(EncodedFrame::to_vec).collect()
    }

    #[test]
    fn long_payloads_travel_in_parts_and_arrive_whole() {
        for (length, count) in [
            (0, 1),
            (PART_BYTES, 1),
            (PART_BYTES + 1, 2),
            (2 * PART_BYTES, 2),
            (2 * PART_BYTES + 1, 3),
        ] {
            let message = blob(length);
            let frames = frames(&message);
            assert_eq!(frames.len(), count, "{length} bytes");
            assert!(frames.iter().all(|frame| frame.to_vec().len() <= FRAME_BYTES_MAX));
            assert_eq!(decode(&bytes(&frames)), Ok(vec![message]));
        }
    }

    #[test]
    fn the_length_of_a_long_payload_is_told_once_when_its_first_part_has_come() {
        let mut decoder = Decoder::new(Phase::Open { version: NEWEST_VERSION });
        let mut buffer = BytesMut::from(&bytes(&frames(&blob(PART_BYTES)))[..]);
        assert!(matches!(decoder.decode(&mut buffer), Ok(Some(_))));
        assert_eq!(decoder.take_claim(), None, "it came in one");
        for frame in &frames(&blob(3 * PART_BYTES))[..2] {
            buffer.extend_from_slice(&frame.to_vec());
        }
        assert_eq!(decoder.decode(&mut buffer), Ok(None));
        assert_eq!((decoder.take_claim(), decoder.take_claim()), (Some(3 * PART_BYTES), None));
    }

    #[test]
    fn a_heartbeat_passes_between_the_parts_of_a_blob() {
        let long = blob(3 * PART_BYTES);
        let mut train = frames(&long);
        let ping = Message::from(Ping { number: 9 });
        train.splice(1..1, frames(&ping));
        assert_eq!(decode(&bytes(&train)), Ok(vec![ping, long]));
    }

    #[test]
    fn parts_without_their_message_or_with_another_are_an_error() {
        let train = frames(&blob(3 * PART_BYTES));
        let start = bytes(&train[..1]);
        assert_eq!(decode(&start), Err(WireError::Truncated));
        let twice = [&train[0], &train[0], &train[0]].map(EncodedFrame::to_vec).concat();
        assert!(matches!(decode(&twice), Err(WireError::OutOfPlace { .. })));
        let other = [start, bytes(&frames(&blob(5)))].concat();
        assert!(matches!(decode(&other), Err(WireError::OutOfPlace { .. })));
    }

    #[test]
    fn a_part_that_claims_more_than_any_blob_has_is_refused() {
        let part = Part { kind: blob(0).kind(), total: u32::MAX };
        let head = postcard::to_stdvec(&part).unwrap();
        let frame = EncodedFrame::new(1, PART_KIND, &head, Bytes::from_static(b"x"));
        assert!(matches!(decode(&frame.to_vec()), Err(WireError::TooLong { .. })));
    }

    #[test]
    fn unknown_kinds_are_skipped_with_their_parts() {
        let unknown = EncodedFrame::new(1, 0x7777, b"anything", Bytes::from_static(b"at all"));
        let part = postcard::to_stdvec(&Part { kind: 0x7777, total: u32::MAX }).unwrap();
        let part = EncodedFrame::new(1, PART_KIND, &part, Bytes::from_static(b"more"));
        let pong = Message::from(Pong { number: 1 });
        let stream = [part.to_vec(), unknown.to_vec(), bytes(&frames(&pong))].concat();
        assert_eq!(decode(&stream), Ok(vec![pong]));
    }

    #[test]
    fn a_stranger_may_only_greet() {
        let mut decoder = Decoder::new(Phase::Greeting);
        let mut buffer = BytesMut::from(&bytes(&frames(&blob(10)))[..HEADER_BYTES]);
        assert!(matches!(decoder.decode(&mut buffer), Err(WireError::OutOfPlace { .. })));
    }

    #[test]
    fn another_version_than_agreed_is_refused() {
        let frame =
            EncodedFrame::new(2, Message::from(Ping { number: 0 }).kind(), &[0], Bytes::new());
        let found = decode(&frame.to_vec());
        assert_eq!(found, Err(WireError::Version { found: 2, agreed: 1 }));
    }

    #[test]
    fn the_encoder_refuses_what_the_decoder_would() {
        use crate::limits::{BLOB_BYTES_MAX, REASON_BYTES_MAX, WANT_BLOBS_MAX};
        use crate::message::{Goodbye, WantBlobs};
        let long: Message = Goodbye { reason: "x".repeat(REASON_BYTES_MAX + 1) }.into();
        assert!(matches!(encode(1, &long), Err(WireError::Unfit { .. })));
        let hashes = vec![BlobHash([0; 32]); WANT_BLOBS_MAX + 1];
        assert!(matches!(
            encode(1, &WantBlobs { hashes, elsewhere: true }.into()),
            Err(WireError::Unfit { .. })
        ));
        let huge = Blob { hash: BlobHash([0; 32]), bytes: vec![0; BLOB_BYTES_MAX + 1].into() };
        assert!(matches!(encode(1, &huge.into()), Err(WireError::TooLong { .. })));
    }

    #[test]
    fn the_longest_lists_fit_in_their_heads() {
        use crate::limits::{CAMERAS_MAX, FRAMES_MAX, WANT_BLOBS_MAX};
        use crate::message::{Cameras, WantBlobs};
        use terrafarm_common::camera::Camera;
        let position = glam::DVec3::new(f64::MAX, -1.0, 1e-300);
        let camera = Camera::from_angles(position, 77.7, -33.3, 5.0, 60.0, (16384, 16384));
        let first = FRAMES_MAX - CAMERAS_MAX as u32;
        let cameras = Cameras { number: u32::MAX, first, cameras: vec![camera; CAMERAS_MAX] };
        assert!(encode(1, &cameras.into()).is_ok());
        let hashes = vec![BlobHash([255; 32]); WANT_BLOBS_MAX];
        assert!(encode(1, &WantBlobs { hashes, elsewhere: true }.into()).is_ok());
    }
}
