use crate::round_trip::bytes;
use crate::transport::{LIMIT, hello, memory, token};
use proptest::prelude::*;
use std::time::Duration;
use terrafarm_wire::link::{Connection, FarmToken, HandshakeError, LinkError, accept, greet};
use terrafarm_wire::message::{Ping, Refusal};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, ReadHalf, WriteHalf, split};
use tokio::task::JoinHandle;

type Link = Connection<DuplexStream>;
type Met = (Result<Link, HandshakeError>, Result<Link, HandshakeError>);

/// What is done to the bytes of one direction.
#[derive(Debug, Clone, Copy)]
enum Meddling {
    None,
    /// The byte at a place is changed by these bits.
    Flip(usize, u8),
    /// Everything ends before a place.
    Cut(usize),
    /// This byte comes in between.
    Insert(usize, u8),
}

/// Passes bytes on to the end of the stream, or to a cut; returns what it has seen.
async fn pass(
    mut from: ReadHalf<DuplexStream>,
    mut to: WriteHalf<DuplexStream>,
    meddling: Meddling,
) -> Vec<u8> {
    let mut seen = Vec::new();
    let mut buffer = [0; 1 << 16];
    while let Ok(length @ 1..) = from.read(&mut buffer).await {
        let start = seen.len();
        seen.extend_from_slice(&buffer[..length]);
        let mut piece = seen[start..].to_vec();
        let inside = |place: usize| place.checked_sub(start).filter(|place| *place < length);
        match meddling {
            Meddling::None => {}
            Meddling::Flip(place, bits) => {
                if let Some(place) = inside(place) {
                    piece[place] ^= bits;
                }
            }
            Meddling::Insert(place, byte) => {
                if let Some(place) = inside(place) {
                    piece.insert(place, byte);
                }
            }
            Meddling::Cut(place) => {
                piece.truncate(place.saturating_sub(start));
                if piece.len() < length {
                    let _ = to.write_all(&piece).await;
                    break;
                }
            }
        }
        if to.write_all(&piece).await.is_err() {
            break;
        }
    }
    let _ = to.shutdown().await;
    seen
}

/// Two ends with someone in between, who meddles with what the near end sends and with
/// what it gets.
fn cable(out: Meddling, back: Meddling) -> (DuplexStream, DuplexStream, [JoinHandle<Vec<u8>>; 2]) {
    let ((near, near_side), (far_side, far)) = (memory(), memory());
    let ((near_read, near_write), (far_read, far_write)) = (split(near_side), split(far_side));
    let there = tokio::spawn(pass(near_read, far_write, out));
    let back = tokio::spawn(pass(far_read, near_write, back));
    (near, far, [there, back])
}

/// Both sides of a greeting, each with its token.
async fn meet(
    (near, far): (DuplexStream, DuplexStream),
    near_token: Option<FarmToken>,
    far_token: Option<FarmToken>,
) -> Met {
    let worker = greet(near, near_token.as_ref(), hello(), LIMIT);
    let coordinator = async {
        let greeting = accept(far, far_token.as_ref(), "terrafarm test", LIMIT).await?;
        assert_eq!(greeting.hello(), &hello());
        let (beat, silence) = (Duration::from_secs(1), Duration::from_secs(3));
        Ok(greeting.welcome(1, "tower", beat, silence).await?.0)
    };
    let (worker, coordinator) = tokio::join!(worker, coordinator);
    (worker.map(|(connection, _)| connection), coordinator)
}

#[tokio::test]
async fn another_token_is_refused_and_the_coordinator_is_not_believed_for_ever() {
    let other = FarmToken::from_bytes([8; 32]);
    let (worker, coordinator) = meet(memory(), Some(other), Some(token())).await;
    assert!(matches!(&worker, Err(HandshakeError::TurnedAway(Refusal::Token))), "{worker:?}");
    assert!(matches!(coordinator, Err(HandshakeError::Refused { refusal: Refusal::Token, .. })));
    let said = worker.unwrap_err().to_string();
    assert!(said.contains("terrafarm token --enter"), "{said}");
}

#[tokio::test]
async fn a_peer_without_the_token_is_told_so() {
    let (worker, coordinator) = meet(memory(), None, Some(token())).await;
    match worker {
        Err(HandshakeError::Refused { refusal: Refusal::Token, text }) => {
            assert!(text.contains("terrafarm token"), "{text}");
        }
        other => panic!("{other:?}"),
    }
    assert!(coordinator.is_err());
}

#[tokio::test]
async fn a_peer_with_a_token_never_falls_back_to_plain() {
    let (near, far, [there, _]) = cable(Meddling::None, Meddling::None);
    let (worker, coordinator) = meet((near, far), Some(token()), None).await;
    assert!(matches!(worker, Err(HandshakeError::TurnedAway(Refusal::PlainOnly))), "{worker:?}");
    assert!(coordinator.is_err());
    assert_eq!(there.await.unwrap().len(), OPENING_BYTES, "and sent nothing but its opening");
}

/// Preamble, key and tag.
const OPENING_BYTES: usize = 6 + 32 + 16;

/// What a coordinator with a token answers to bytes from a stranger.
async fn answer_to(stranger: &[u8]) -> Vec<u8> {
    let (mut near, far) = memory();
    near.write_all(stranger).await.unwrap();
    near.shutdown().await.unwrap();
    let refused = accept(far, Some(&token()), "terrafarm test", LIMIT).await;
    assert!(refused.is_err());
    let mut answer = Vec::new();
    near.read_to_end(&mut answer).await.unwrap();
    answer
}

#[tokio::test]
async fn whatever_was_wrong_the_refusal_is_the_same() {
    let of_garbage = answer_to(b"GET / HTTP/1.1\r\n\r\n").await;
    assert!(!of_garbage.is_empty());
    assert_eq!(answer_to(&bytes(&hello().into())).await, of_garbage, "a plain greeting");
    let opening = |proof: &[u8; 48]| [b"TFRS\x01\0", &proof[..]].concat();
    assert_eq!(answer_to(&opening(&[0; 48])).await, of_garbage, "an opening of zeros");
    let noise = std::array::from_fn(|index| (index as u8).wrapping_mul(37));
    assert_eq!(answer_to(&opening(&noise)).await, of_garbage, "an opening of noise");
    assert_eq!(answer_to(&[opening(&noise), vec![9; 9999]].concat()).await, of_garbage);
}

#[tokio::test]
async fn another_version_of_the_channel_is_named() {
    let (mut near, far) = memory();
    near.write_all(b"TFRS\x02\0").await.unwrap();
    near.shutdown().await.unwrap();
    let refused = accept(far, Some(&token()), "terrafarm test", LIMIT).await;
    assert!(
        matches!(refused, Err(HandshakeError::Refused { refusal: Refusal::Version, .. })),
        "{refused:?}"
    );
}

#[tokio::test]
async fn nothing_of_what_is_said_can_be_read_on_the_way() {
    let (near, far, seen) = cable(Meddling::None, Meddling::None);
    let (worker, coordinator) = meet((near, far), Some(token()), Some(token())).await;
    drop((worker.unwrap(), coordinator.unwrap()));
    for seen in seen {
        let seen = seen.await.unwrap();
        assert!(seen.len() > OPENING_BYTES);
        for word in [&b"TFRM"[..], b"pc-1", b"tower", b"terrafarm"] {
            assert!(!seen.windows(word.len()).any(|window| window == word), "{word:?}");
        }
    }
}

#[tokio::test]
async fn a_link_that_is_cut_inside_a_record_is_no_clean_end() {
    let (near, far, _seen) = cable(Meddling::None, Meddling::None);
    let (worker, coordinator) = meet((near, far), Some(token()), Some(token())).await;
    drop((worker, coordinator));
    let greeting = _seen.into_iter().next().unwrap().await.unwrap().len();

    let (near, far, _seen) = cable(Meddling::Cut(greeting + 20), Meddling::None);
    let (worker, coordinator) = meet((near, far), Some(token()), Some(token())).await;
    let (mut worker, mut coordinator) = (worker.unwrap(), coordinator.unwrap());
    worker.send(&Ping { number: 1 }.into()).await.unwrap();
    assert!(matches!(coordinator.recv().await, Err(LinkError::Cut)));
}

#[tokio::test]
async fn a_byte_that_is_changed_after_the_greeting_ends_the_link() {
    let (near, far, seen) = cable(Meddling::None, Meddling::None);
    drop(meet((near, far), Some(token()), Some(token())).await);
    let [there, _] = seen;
    let greeting = there.await.unwrap().len();
    for place in [greeting + 2, greeting + 15, greeting + 25] {
        let (near, far, _) = cable(Meddling::Flip(place, 0x10), Meddling::None);
        let (worker, coordinator) = meet((near, far), Some(token()), Some(token())).await;
        let (mut worker, mut coordinator) = (worker.unwrap(), coordinator.unwrap());
        worker.send(&Ping { number: 1 }.into()).await.unwrap();
        let received = coordinator.recv().await;
        assert!(matches!(received, Err(LinkError::Channel(_))), "{received:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_greeting_that_trickles_in_for_too_long_is_given_up() {
    let (mut near, far) = memory();
    let trickle = tokio::spawn(async move {
        for byte in b"TFRS\x01\0 and so on, never enough" {
            // A slow peer is what is tested; nothing waits for a state here.
            tokio::time::sleep(LIMIT / 10).await;
            if near.write_all(&[*byte]).await.is_err() {
                return;
            }
        }
        panic!("nobody gave this peer up");
    });
    let began = tokio::time::Instant::now();
    let late = accept(far, Some(&token()), "terrafarm test", LIMIT).await;
    assert!(matches!(late, Err(HandshakeError::TimedOut(_))), "{late:?}");
    assert!(began.elapsed() <= LIMIT, "{:?}", began.elapsed());
    trickle.await.unwrap();
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build().unwrap()
}

fn meddling() -> impl Strategy<Value = Meddling> {
    prop_oneof![
        (0..220usize, 1u8..).prop_map(|(place, bits)| Meddling::Flip(place, bits)),
        (0..220usize, any::<u8>()).prop_map(|(place, byte)| Meddling::Insert(place, byte)),
        (0..220usize).prop_map(Meddling::Cut),
    ]
}

proptest! {
    /// A greeting that was touched opens no link in that direction; one that was not, does.
    #[test]
    fn whoever_meddles_with_a_greeting_gets_no_link(out in meddling(), outward: bool) {
        let (link, seen) = runtime().block_on(async {
            let (there, back) = if outward { (out, Meddling::None) } else { (Meddling::None, out) };
            let (near, far, [there, back]) = cable(there, back);
            let (worker, coordinator) = meet((near, far), Some(token()), Some(token())).await;
            // The side that listens to the direction that was touched.
            let (worker, coordinator) = (worker.map(drop), coordinator.map(drop));
            let link = if outward { coordinator } else { worker };
            let seen = if outward { there } else { back };
            (link, seen.await.unwrap())
        });
        let touched = match out {
            Meddling::None => false,
            Meddling::Flip(place, _) | Meddling::Insert(place, _) | Meddling::Cut(place) => {
                place < seen.len()
            }
        };
        prop_assert_eq!(link.is_err(), touched, "{:?} of {} bytes: {:?}", out, seen.len(), link);
    }
}
