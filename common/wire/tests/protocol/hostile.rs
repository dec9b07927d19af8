use crate::round_trip::bytes;
use crate::samples;
use bytes::BytesMut;
use proptest::prelude::*;
use terrafarm_common::id::{LeaseId, ShotId};
use terrafarm_common::region::Region;
use terrafarm_wire::codec::Phase;
use terrafarm_wire::frame::{FRAME_BYTES_MAX, HEADER_BYTES};
use terrafarm_wire::limits::NEWEST_VERSION;
use terrafarm_wire::message::Grant;
use terrafarm_wire::{Decoder, WireError, decode, encode};
use xxhash_rust::xxh3::xxh3_64;

#[test]
fn every_truncation_of_every_message_is_an_error() {
    for (name, message) in samples::all() {
        let whole = bytes(&message);
        for length in 1..whole.len() {
            assert_eq!(decode(&whole[..length]), Err(WireError::Truncated), "{name} at {length}");
        }
    }
}

#[test]
fn every_flipped_bit_of_every_message_is_noticed() {
    for (name, message) in samples::all() {
        let whole = bytes(&message);
        for bit in 0..whole.len() * 8 {
            let mut flipped = whole.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            let read = decode(&flipped);
            // A flipped kind may be a kind to skip, or one of the same shape; it never
            // gives the message that was sent.
            assert_ne!(read, Ok(vec![message.clone()]), "{name}, bit {bit}");
            if !(48..64).contains(&bit) {
                assert!(read.is_err(), "{name}, bit {bit}: {read:?}");
            }
        }
    }
}

/// A frame that is whole and sound, whatever it holds.
fn sealed(kind: u16, head: &[u8], payload: &[u8]) -> Vec<u8> {
    let body = [head, payload].concat();
    let mut frame = b"TFRM".to_vec();
    frame.extend(NEWEST_VERSION.to_le_bytes());
    frame.extend(kind.to_le_bytes());
    frame.extend((head.len() as u32).to_le_bytes());
    frame.extend((payload.len() as u32).to_le_bytes());
    frame.extend(xxh3_64(&body).to_le_bytes());
    [frame, body].concat()
}

proptest! {
    #[test]
    fn random_bytes_are_an_error(noise in prop::collection::vec(any::<u8>(), 1..400)) {
        prop_assert!(decode(&noise).is_err());
    }

    #[test]
    fn random_bodies_under_a_sound_header_never_panic(
        kind in prop_oneof![0u16..0x60, any::<u16>()],
        head in prop::collection::vec(any::<u8>(), 0..300),
        payload in prop::collection::vec(any::<u8>(), 0..50),
    ) {
        if let Ok(messages) = decode(&sealed(kind, &head, &payload)) {
            for message in messages {
                prop_assert!(encode(NEWEST_VERSION, &message).is_ok(), "{message:?}");
            }
        }
    }

    #[test]
    fn damaged_heads_under_a_sound_header_never_panic(
        sample in prop::sample::select(samples::all()),
        at: prop::sample::Index,
        value: u8,
    ) {
        let whole = bytes(&sample.1);
        let head_len = u32::from_le_bytes(whole[8..12].try_into().unwrap()) as usize;
        let (head, payload) = whole[HEADER_BYTES..].split_at(head_len);
        let mut head = head.to_vec();
        if !head.is_empty() {
            let at = at.index(head.len());
            head[at] = value;
        }
        if let Ok(messages) = decode(&sealed(sample.1.kind(), &head, payload)) {
            for message in messages {
                prop_assert!(encode(NEWEST_VERSION, &message).is_ok(), "{message:?}");
            }
        }
    }
}

#[test]
fn a_declared_length_of_four_gigabytes_is_refused_without_allocation() {
    for (_, message) in samples::all() {
        for field in [8, 12] {
            let mut header = bytes(&message)[..HEADER_BYTES].to_vec();
            header[field..field + 4].copy_from_slice(&u32::MAX.to_le_bytes());
            let mut buffer = BytesMut::from(&header[..]);
            let before = buffer.capacity();
            let mut decoder = Decoder::new(Phase::Open { version: NEWEST_VERSION });
            assert!(matches!(decoder.decode(&mut buffer), Err(WireError::TooLong { .. })));
            assert_eq!(buffer.capacity(), before);
        }
    }
}

#[test]
fn a_list_that_claims_2_to_the_40_entries_is_refused() {
    let claim = [0x80, 0x80, 0x80, 0x80, 0x80, 0x20];
    for kind in [0x10, 0x32] {
        assert_eq!(decode(&sealed(kind, &claim, &[])), Err(WireError::Malformed { kind }));
    }
    let cameras = [&[5, 0][..], &claim].concat();
    assert_eq!(decode(&sealed(0x41, &cameras, &[])), Err(WireError::Malformed { kind: 0x41 }));
}

#[test]
fn a_receiver_never_holds_more_than_one_frame() {
    let mut decoder = Decoder::new(Phase::Open { version: NEWEST_VERSION });
    for (_, message) in samples::all() {
        let whole = bytes(&message);
        let mut buffer = BytesMut::new();
        for byte in whole {
            buffer.extend_from_slice(&[byte]);
            decoder.decode(&mut buffer).unwrap();
            assert!(buffer.capacity() <= 2 * FRAME_BYTES_MAX);
        }
        assert!(buffer.is_empty());
    }
}

#[test]
fn a_region_outside_its_camera_is_refused_by_both_sides() {
    let region = Region { x: 1919, y: 0, width: 2, height: 1 };
    let camera = samples::camera();
    let grant = Grant { lease: LeaseId(1), shot: ShotId(1), frame: 0, region, camera };
    assert!(matches!(encode(1, &grant.into()), Err(WireError::Unfit { .. })));
}

#[test]
fn a_camera_that_is_no_number_is_refused_by_both_sides() {
    let region = Region { x: 0, y: 0, width: 2, height: 1 };
    let mut camera = samples::camera();
    let fit = Grant { lease: LeaseId(1), shot: ShotId(1), frame: 0, region, camera };
    camera.position.x = f64::NAN;
    assert!(encode(1, &Grant { camera, ..fit }.into()).is_err());

    let whole = bytes(&fit.into());
    let sent = samples::camera().position.x.to_le_bytes();
    let at = whole.windows(8).position(|window| window == sent).unwrap() - HEADER_BYTES;
    let mut head = whole[HEADER_BYTES..].to_vec();
    head[at..at + 8].copy_from_slice(&f64::NAN.to_le_bytes());
    assert!(matches!(decode(&sealed(0x21, &head, &[])), Err(WireError::Unfit { .. })));
}
