//! Packed pixels: two bytes their length, then what came over the wire.

#![no_main]

use bytes::Bytes;
use terrafarm_common::id::LeaseId;
use terrafarm_wire::frame::HEADER_BYTES;
use terrafarm_wire::limits::NEWEST_VERSION;
use terrafarm_wire::message::{Done, RenderReport};
use terrafarm_wire::pixels::Pixels;
use terrafarm_wire::{Message, decode, encode};
use xxhash_rust::xxh3::xxh3_64;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let pictures = [vec![7; 3000], (0..900u32).map(|k| (k / 3 % 16) as u8).collect(), vec![1, 2]];
    let seed = |pixels: Vec<u8>| {
        let length = (pixels.len() as u16).to_le_bytes();
        [&length[..], &frame_of(&pixels)[HEADER_BYTES + head_len(&frame_of(&pixels))..]].concat()
    };
    pictures.into_iter().map(seed).collect()
}

fn accepts(input: &[u8]) -> bool {
    let Some((&length, payload)) = input.split_first_chunk() else { return false };
    let length = usize::from(u16::from_le_bytes(length));
    // Pixels that are all alike give the head of a message whose payload is packed.
    let mut frame = frame_of(&vec![0; length]);
    let head_len = head_len(&frame);
    frame.truncate(HEADER_BYTES + head_len);
    frame.extend(payload);
    frame[12..16].copy_from_slice(&(payload.len() as u32).to_le_bytes());
    let check = xxh3_64(&frame[HEADER_BYTES..]);
    frame[16..24].copy_from_slice(&check.to_le_bytes());
    let mut messages = decode(&frame).unwrap_or_default();
    let Some(Message::Done(done)) = messages.pop() else { return false };
    let Ok(pixels) = done.pixels.unpack(length) else { return false };
    assert_eq!(pixels.len(), length);
    let again = Pixels::compressed(pixels.clone()).expect("few pixels");
    assert_eq!(again.unpack(length), Ok(pixels));
    true
}

fn frame_of(pixels: &[u8]) -> Vec<u8> {
    let report = RenderReport { cost_us: 1, rays: 2, steps: 3, ..RenderReport::default() };
    let pixels = Pixels::compressed(Bytes::copy_from_slice(pixels)).expect("few pixels");
    let done =
        Done { lease: LeaseId(1), report, timesheet: Default::default(), check: None, pixels };
    let frames = encode(NEWEST_VERSION, &done.into()).expect("an honest message");
    frames.flat_map(|frame| frame.to_vec()).collect()
}

fn head_len(frame: &[u8]) -> usize {
    u32::from_le_bytes([frame[8], frame[9], frame[10], frame[11]]) as usize
}
