//! One message of each kind in a sound frame: first byte the kind, two bytes the length
//! of the head, then head and payload. What is read can be written again and reads the
//! same.

#![no_main]

use terrafarm_wire::frame::{HEADER_BYTES, MAGIC};
use terrafarm_wire::limits::NEWEST_VERSION;
use terrafarm_wire::{Message, decode, encode};
use xxhash_rust::xxh3::xxh3_64;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let frames = terrafarm_fuzz::seeds::golden_frames();
    let seed = |frame: &Vec<u8>| {
        let kind = u16::from_le_bytes([frame[6], frame[7]]);
        let number = Message::KINDS.iter().position(|known| known.0 == kind);
        let number = number.expect("a golden message has a known kind") as u8;
        [&[number, frame[8], frame[9]], &frame[HEADER_BYTES..]].concat()
    };
    frames.iter().map(seed).collect()
}

fn accepts(input: &[u8]) -> bool {
    let Some((&[number, low, high], body)) = input.split_first_chunk() else { return false };
    let kind = Message::KINDS[usize::from(number) % Message::KINDS.len()].0;
    let head_len = usize::from(u16::from_le_bytes([low, high])).min(body.len());
    let mut frame = MAGIC.to_vec();
    frame.extend(NEWEST_VERSION.to_le_bytes());
    frame.extend(kind.to_le_bytes());
    frame.extend((head_len as u32).to_le_bytes());
    frame.extend(((body.len() - head_len) as u32).to_le_bytes());
    frame.extend(xxh3_64(body).to_le_bytes());
    frame.extend(body);
    let Ok(messages) = decode(&frame) else { return false };
    for message in &messages {
        let frames = encode(NEWEST_VERSION, message).expect("what was read may be written");
        let bytes: Vec<u8> = frames.flat_map(|frame| frame.to_vec()).collect();
        assert_eq!(decode(&bytes).as_deref(), Ok(&[message.clone()][..]));
    }
    true
}
