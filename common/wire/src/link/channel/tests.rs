#![allow(clippy::unwrap_used)]
use super::*;
use proptest::prelude::*;

fn token(byte: u8) -> FarmToken {
    FarmToken::from_bytes([byte; 32])
}

/// The proof within an opening.
fn proof(opening: &[u8; OPENING_BYTES]) -> &[u8; PROOF_BYTES] {
    opening[PREAMBLE.len()..].try_into().unwrap()
}

/// A channel of fixed keys: both openings, and the two halves of each side.
#[expect(clippy::type_complexity, reason = "it is taken apart at once")]
fn channel() -> ([[u8; OPENING_BYTES]; 2], (Sealer, Opener), (Sealer, Opener)) {
    let token = token(7);
    let fixed = |key| builder(&token).fixed_ephemeral_key_for_testing_only(key);
    let initiator = fixed(&[1; 32]).build_initiator().unwrap();
    let (opening, first) = Opening::begin(initiator).unwrap();
    let responder = fixed(&[2; 32]).build_responder().unwrap();
    let (second, sealer, opener) = answer_by(responder, proof(&first)).unwrap();
    ([first, second], opening.finish(proof(&second)).unwrap(), (sealer, opener))
}

/// Everything that opens, up to the first error, of bytes that come in pieces.
fn open_all(
    opener: &mut Opener,
    bytes: &[u8],
    piece: usize,
) -> (Vec<u8>, Result<usize, ChannelError>) {
    let (mut arrived, mut plain) = (BytesMut::new(), BytesMut::new());
    for piece in bytes.chunks(piece) {
        arrived.extend_from_slice(piece);
        loop {
            match opener.open(&mut arrived, &mut plain) {
                Ok(true) => {}
                Ok(false) => break,
                Err(why) => return (plain.to_vec(), Err(why)),
            }
        }
    }
    (plain.to_vec(), Ok(arrived.len()))
}

/// Texts as one record each.
fn records(sealer: &mut Sealer, texts: &[Vec<u8>]) -> Vec<Vec<u8>> {
    let seal = |text: &Vec<u8>| {
        let mut record = BytesMut::new();
        sealer.seal(text, &mut record).unwrap();
        record.to_vec()
    };
    texts.iter().map(seal).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[test]
fn the_bytes_of_version_1_never_change() {
    let ([first, second], (mut sealer, _), (mut back, _)) = channel();
    let there = records(&mut sealer, &[b"terrain".to_vec()]).concat();
    let back = records(&mut back, &[b"terrain".to_vec()]).concat();
    assert_eq!([&first[..], &second, &there, &back].map(hex), GOLDEN);
}

const GOLDEN: [&str; 4] = [
    "544652530100a4e09292b651c278b9772c569f5fa9bb13d906b46ab68c9df9dc2b4409f8a209\
     7e50da31ea850c2e1fe82a55d6db8799",
    "544652530100ce8d3ad1ccb633ec7b70c17814a5c76ecd029685050d344745ba05870e587d59\
     bde7f3f9a6f420ebe72d2fdd134b00d8",
    "1700331d699ec9cb4d46e01c8238e63c66ebb2287772bfb62f",
    "1700fbbc8accffed6df4ddf5440bff3a92ed7dcb4f84e4ba16",
];

#[test]
fn no_two_openings_are_the_same() {
    let (_, one) = Opening::new(&token(1)).unwrap();
    let (_, other) = Opening::new(&token(1)).unwrap();
    assert_ne!(one, other);
}

#[test]
fn another_token_opens_nothing_on_either_side() {
    let (opening, first) = Opening::new(&token(1)).unwrap();
    assert_eq!(answer(&token(2), proof(&first)).unwrap_err(), ChannelError::Unproven);
    let (_, other) = Opening::new(&token(2)).unwrap();
    let (second, ..) = answer(&token(2), proof(&other)).unwrap();
    assert_eq!(opening.finish(proof(&second)).unwrap_err(), ChannelError::Unproven);
}

#[test]
fn every_flipped_bit_of_an_opening_is_noticed() {
    for bit in 0..PROOF_BYTES * 8 {
        let (opening, first) = Opening::new(&token(1)).unwrap();
        let mut flipped = *proof(&first);
        flipped[bit / 8] ^= 1 << (bit % 8);
        assert!(answer(&token(1), &flipped).is_err(), "bit {bit} of the first");
        let (second, ..) = answer(&token(1), proof(&first)).unwrap();
        let mut flipped = *proof(&second);
        flipped[bit / 8] ^= 1 << (bit % 8);
        assert!(opening.finish(&flipped).is_err(), "bit {bit} of the second");
    }
}

#[test]
fn a_repeated_opening_gives_no_way_to_write_a_record() {
    let (opening, first) = Opening::new(&token(1)).unwrap();
    let (second, ..) = answer(&token(1), proof(&first)).unwrap();
    let (mut sealer, _) = opening.finish(proof(&second)).unwrap();
    let recorded = records(&mut sealer, &[b"hello".to_vec()]).concat();
    // Who listened sends all of it again.
    let (_, _, mut opener) = answer(&token(1), proof(&first)).unwrap();
    let (plain, end) = open_all(&mut opener, &recorded, usize::MAX);
    assert_eq!((plain.len(), end), (0, Err(ChannelError::Tampered)));
}

#[test]
fn a_record_of_one_direction_does_not_open_in_the_other() {
    let (_, (mut sealer, mut opener), _) = channel();
    let record = records(&mut sealer, &[b"mirror".to_vec()]).concat();
    let (_, end) = open_all(&mut opener, &record, usize::MAX);
    assert_eq!(end, Err(ChannelError::Tampered));
}

#[test]
fn every_flipped_bit_of_a_record_is_noticed() {
    let (_, (mut sealer, _), _) = channel();
    let record = records(&mut sealer, &[b"pixels".to_vec()]).concat();
    for bit in 0..record.len() * 8 {
        let mut flipped = record.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        let (_, _, (_, mut opener)) = channel();
        let (plain, end) = open_all(&mut opener, &flipped, usize::MAX);
        // A longer length waits for bytes that do not come: the stream ends inside.
        assert!(end != Ok(0) && plain.is_empty(), "bit {bit}: {end:?}");
    }
}

#[test]
fn records_too_short_for_anything_are_refused_before_they_are_whole() {
    let (_, (_, mut opener), _) = channel();
    for length in 0..=TAG_BYTES as u16 {
        let (_, end) = open_all(&mut opener, &length.to_le_bytes(), usize::MAX);
        assert_eq!(end, Err(ChannelError::Length(length)));
    }
}

#[test]
fn long_texts_travel_in_several_records_and_no_text_in_none() {
    let (_, (mut sealer, _), (_, mut opener)) = channel();
    let text: Vec<u8> = (0..RECORD_MAX * 2 + 5).map(|index| (index * 31) as u8).collect();
    let mut sealed = BytesMut::new();
    sealer.seal(&[], &mut sealed).unwrap();
    assert!(sealed.is_empty());
    sealer.seal(&text, &mut sealed).unwrap();
    assert_eq!(sealed.len(), text.len() + 3 * (LENGTH_BYTES + TAG_BYTES));
    let (plain, end) = open_all(&mut opener, &sealed, 10_007);
    assert_eq!((plain == text, end), (true, Ok(0)));
}

fn texts() -> impl Strategy<Value = Vec<Vec<u8>>> {
    prop::collection::vec(prop::collection::vec(any::<u8>(), 1..60), 2..7)
}

proptest! {
    #[test]
    fn texts_arrive_however_their_bytes_are_split(texts in texts(), piece in 1usize..90) {
        let (_, (mut sealer, _), (_, mut opener)) = channel();
        let sealed = records(&mut sealer, &texts).concat();
        let (plain, end) = open_all(&mut opener, &sealed, piece);
        prop_assert_eq!((plain, end), (texts.concat(), Ok(0)));
    }

    #[test]
    fn a_cut_stream_gives_what_was_whole_and_no_more(texts in texts(), cut: prop::sample::Index) {
        let (_, (mut sealer, _), (_, mut opener)) = channel();
        let sealed = records(&mut sealer, &texts).concat();
        let cut = cut.index(sealed.len());
        let (plain, end) = open_all(&mut opener, &sealed[..cut], usize::MAX);
        prop_assert!(end.is_ok());
        prop_assert!(texts.concat().starts_with(&plain));
        prop_assert!(plain.len() < texts.concat().len());
    }

    #[test]
    fn records_that_are_moved_repeated_or_left_out_open_up_to_there(
        texts in texts(),
        from: prop::sample::Index,
        to: prop::sample::Index,
        kind in 0..3,
    ) {
        let (_, (mut sealer, _), (_, mut opener)) = channel();
        let mut sealed = records(&mut sealer, &texts);
        let (from, to) = (from.index(sealed.len()), to.index(sealed.len()));
        let first_wrong = match kind {
            0 => {
                prop_assume!(from != to);
                sealed.swap(from, to);
                from.min(to)
            }
            1 => {
                sealed.insert(from + 1, sealed[from].clone());
                from + 1
            }
            _ => {
                prop_assume!(from + 1 < sealed.len());
                sealed.remove(from);
                from
            }
        };
        let (plain, end) = open_all(&mut opener, &sealed.concat(), usize::MAX);
        prop_assert_eq!(end, Err(ChannelError::Tampered));
        prop_assert_eq!(plain, texts[..first_wrong].concat());
    }

    #[test]
    fn no_bytes_panic(noise in prop::collection::vec(any::<u8>(), 0..300), piece in 1usize..300) {
        let (_, _, (_, mut opener)) = channel();
        let (plain, _) = open_all(&mut opener, &noise, piece);
        prop_assert!(plain.is_empty());
    }
}
