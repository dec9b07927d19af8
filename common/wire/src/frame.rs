//! The frame: the bytes around one message, or around one part of a long one.
//!
//! ```text
//! offset  size  field
//!      0     4  magic, "TFRM"
//!      4     2  protocol version
//!      6     2  kind of the message
//!      8     4  length of the head, bytes
//!     12     4  length of the payload, bytes
//!     16     8  xxh3-64 over head and payload
//!     24        head: the message in postcard; then the payload: raw bytes
//! ```
//! All numbers are little-endian. This layout never changes, so that any two versions
//! can at least refuse each other politely. The checksum finds damage, not malice.

use crate::codec::WireError;
use crate::limits::{Class, PART_BYTES, SUBMISSION_HEAD_MAX};
use bytes::{BufMut, Bytes, BytesMut};
use xxhash_rust::xxh3::Xxh3;

/// The first bytes of every frame.
pub const MAGIC: [u8; 4] = *b"TFRM";
/// Length of the header, bytes.
pub const HEADER_BYTES: usize = 24;
/// The longest frame there is, bytes: what a receiver must be ready to hold.
pub const FRAME_BYTES_MAX: usize = HEADER_BYTES + SUBMISSION_HEAD_MAX + PART_BYTES;

/// What is known of a frame before its body has arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// Protocol version of the message.
    pub version: u16,
    /// Number of the message's kind.
    pub kind: u16,
    /// Length of the head, bytes.
    pub head_len: u32,
    /// Length of the payload, bytes.
    pub payload_len: u32,
    /// xxh3-64 over head and payload.
    pub checksum: u64,
}

impl Header {
    /// Reads a header. Only the magic is judged here; see [`Header::admit`].
    pub fn read(bytes: &[u8; HEADER_BYTES]) -> Result<Self, WireError> {
        let [m0, m1, m2, m3, v0, v1, k0, k1, rest @ ..] = *bytes;
        let magic = [m0, m1, m2, m3];
        if magic != MAGIC {
            return Err(WireError::NotOurs { found: magic });
        }
        let [h0, h1, h2, h3, p0, p1, p2, p3, checksum @ ..] = rest;
        Ok(Header {
            version: u16::from_le_bytes([v0, v1]),
            kind: u16::from_le_bytes([k0, k1]),
            head_len: u32::from_le_bytes([h0, h1, h2, h3]),
            payload_len: u32::from_le_bytes([p0, p1, p2, p3]),
            checksum: u64::from_le_bytes(checksum),
        })
    }

    /// Refuses lengths above the limits of a class; `None` is a kind this version does
    /// not know, which is skipped as long as it fits in a frame at all.
    pub fn admit(&self, class: Option<Class>) -> Result<(), WireError> {
        let head_max = class.map_or(SUBMISSION_HEAD_MAX, Class::head_max);
        let payload_max = class.map_or(PART_BYTES, |class| class.payload_max().min(PART_BYTES));
        for (length, limit) in [(self.head_len, head_max), (self.payload_len, payload_max)] {
            if length as usize > limit {
                let length = u64::from(length);
                return Err(WireError::TooLong { kind: self.kind, length, limit: limit as u64 });
            }
        }
        Ok(())
    }

    /// Length of the whole frame, bytes. Call after [`Header::admit`].
    pub fn frame_len(&self) -> usize {
        HEADER_BYTES + self.head_len as usize + self.payload_len as usize
    }
}

/// A frame ready to be written: header and head together, then the payload, which is
/// shared with whoever made it and not copied.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodedFrame {
    /// Header and head.
    pub start: Bytes,
    /// Payload, possibly empty.
    pub payload: Bytes,
}

impl EncodedFrame {
    /// Puts a header before a head and a payload whose lengths have been checked.
    pub(crate) fn new(version: u16, kind: u16, head: &[u8], payload: Bytes) -> Self {
        let mut start = BytesMut::with_capacity(HEADER_BYTES + head.len());
        start.put_slice(&MAGIC);
        start.put_u16_le(version);
        start.put_u16_le(kind);
        start.put_u32_le(head.len() as u32);
        start.put_u32_le(payload.len() as u32);
        start.put_u64_le(checksum(head, &payload));
        start.put_slice(head);
        EncodedFrame { start: start.freeze(), payload }
    }

    /// The frame as one piece.
    pub fn to_vec(&self) -> Vec<u8> {
        [&self.start[..], &self.payload[..]].concat()
    }
}

/// xxh3-64 over head and payload.
pub(crate) fn checksum(head: &[u8], payload: &[u8]) -> u64 {
    let mut state = Xxh3::new();
    state.update(head);
    state.update(payload);
    state.digest()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header_of(frame: &EncodedFrame) -> Header {
        let bytes: [u8; HEADER_BYTES] = frame.start[..HEADER_BYTES].try_into().expect("a header");
        Header::read(&bytes).expect("our magic")
    }

    #[test]
    fn a_header_reads_back_as_written() {
        let frame = EncodedFrame::new(3, 0x51, b"head", Bytes::from_static(b"payload"));
        let header = header_of(&frame);
        assert_eq!((header.version, header.kind), (3, 0x51));
        assert_eq!((header.head_len, header.payload_len), (4, 7));
        assert_eq!(header.checksum, checksum(b"head", b"payload"));
        assert_eq!(header.frame_len(), frame.to_vec().len());
    }

    #[test]
    fn lengths_above_the_limit_of_their_class_are_refused() {
        let mut header = header_of(&EncodedFrame::new(1, 1, b"", Bytes::new()));
        header.head_len = u32::MAX;
        for class in [None, Some(Class::Hello), Some(Class::Control), Some(Class::Pixels)] {
            assert!(matches!(header.admit(class), Err(WireError::TooLong { .. })));
        }
        header.head_len = 0;
        header.payload_len = 1;
        assert!(header.admit(Some(Class::Control)).is_err(), "control has no payload");
        assert!(header.admit(Some(Class::Blob)).is_ok());
        header.payload_len = PART_BYTES as u32 + 1;
        assert!(header.admit(Some(Class::Blob)).is_err(), "long payloads travel in parts");
        assert!(header.admit(None).is_err());
    }
}
