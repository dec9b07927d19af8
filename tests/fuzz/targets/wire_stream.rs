//! A stream of frames, in both phases, whole and in pieces. What is read can be written
//! again and reads the same.

#![no_main]

use bytes::BytesMut;
use terrafarm_wire::codec::Phase;
use terrafarm_wire::frame::{HEADER_BYTES, Header};
use terrafarm_wire::limits::NEWEST_VERSION;
use terrafarm_wire::{Decoder, Message, WireError, decode, encode};
use xxhash_rust::xxh3::xxh3_64;

/// Bits of the first byte; the rest of it is the length of the pieces.
const SEALED: u8 = 1;
const GREETING: u8 = 2;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let frames = terrafarm_fuzz::seeds::golden_frames();
    let all = frames.concat();
    let mut seeds: Vec<Vec<u8>> =
        frames.iter().map(|frame| [&[SEALED], &frame[..]].concat()).collect();
    seeds.extend(frames[..4].iter().map(|frame| [&[SEALED | GREETING], &frame[..]].concat()));
    seeds.push([&[7 << 2], &all[..]].concat());
    seeds
}

fn accepts(input: &[u8]) -> bool {
    let Some((&first, stream)) = input.split_first() else { return false };
    let mut stream = stream.to_vec();
    if first & SEALED != 0 {
        seal(&mut stream);
    }
    let greeting = first & GREETING != 0;
    let phase = if greeting { Phase::Greeting } else { Phase::Open { version: NEWEST_VERSION } };
    let (messages, error) = read(phase, &stream, usize::MAX);
    let piece = usize::from(first >> 2).max(1);
    assert_eq!(read(phase, &stream, piece), (messages.clone(), error.clone()));
    for message in &messages {
        let frames = encode(NEWEST_VERSION, message).expect("what was read may be written");
        let bytes: Vec<u8> = frames.flat_map(|frame| frame.to_vec()).collect();
        assert_eq!(decode(&bytes).as_deref(), Ok(&[message.clone()][..]));
    }
    error.is_none() && !messages.is_empty()
}

/// Reads a stream that arrives in pieces, up to the first error.
fn read(phase: Phase, stream: &[u8], piece: usize) -> (Vec<Message>, Option<WireError>) {
    let mut decoder = Decoder::new(phase);
    let (mut buffer, mut messages) = (BytesMut::new(), Vec::new());
    for piece in stream.chunks(piece) {
        buffer.extend_from_slice(piece);
        loop {
            match decoder.decode(&mut buffer) {
                Ok(Some(message)) => messages.push(message),
                Ok(None) => break,
                Err(error) => return (messages, Some(error)),
            }
        }
    }
    (messages, None)
}

/// Sets the check sums of all whole frames right.
fn seal(stream: &mut [u8]) {
    let mut rest = stream;
    while let Some(start) = rest.first_chunk::<HEADER_BYTES>() {
        let Ok(header) = Header::read(start) else { return };
        let frame_len =
            HEADER_BYTES as u64 + u64::from(header.head_len) + u64::from(header.payload_len);
        let whole = std::mem::take(&mut rest);
        let Some((frame, after)) = whole.split_at_mut_checked(frame_len as usize) else { return };
        let check = xxh3_64(&frame[HEADER_BYTES..]);
        frame[16..HEADER_BYTES].copy_from_slice(&check.to_le_bytes());
        rest = after;
    }
}
