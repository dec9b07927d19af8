use crate::round_trip::bytes;
use crate::samples;
use std::fmt::Debug;
use std::time::Duration;
use terrafarm_common::id::BlobHash;
use terrafarm_wire::Message;
use terrafarm_wire::limits::PART_BYTES;
use terrafarm_wire::link::{
    Connection, FarmToken, HandshakeError, Heard, LinkError, Paced, Unsent, WHILE_IT_COMES, accept,
    greet, outbox,
};
use terrafarm_wire::message::*;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, DuplexStream, duplex};
use tokio::net::{TcpListener, TcpStream};

pub const LIMIT: Duration = Duration::from_secs(20);

/// Whether a link of the suite is secure.
type Token = Option<FarmToken>;

pub fn token() -> FarmToken {
    FarmToken::from_bytes([7; 32])
}

trait Stream: AsyncRead + AsyncWrite + Unpin + Send + Debug + 'static {}
impl<S: AsyncRead + AsyncWrite + Unpin + Send + Debug + 'static> Stream for S {}

pub fn memory() -> (DuplexStream, DuplexStream) {
    duplex(64 << 10)
}

async fn tcp() -> (TcpStream, TcpStream) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let (near, far) = tokio::join!(TcpStream::connect(address), listener.accept());
    (near.unwrap(), far.unwrap().0)
}

pub fn hello() -> Hello {
    Hello::new("pc-1", Role::Worker { threads: 4, incarnation: 8, identity: 9 })
}

async fn connect<S: Stream>(pair: (S, S)) -> (Connection<S>, Connection<S>) {
    connect_by(pair, None).await
}

async fn connect_by<S: Stream>(
    (near, far): (S, S),
    token: Token,
) -> (Connection<S>, Connection<S>) {
    let token = token.as_ref();
    let coordinator = async {
        let greeting = accept(far, token, "terrafarm test", LIMIT).await.unwrap();
        assert_eq!(greeting.hello(), &hello());
        let (beat, silence) = (Duration::from_secs(1), Duration::from_secs(3));
        greeting.welcome(42, "tower", beat, silence).await.unwrap().0
    };
    let (worker, coordinator) = tokio::join!(greet(near, token, hello(), LIMIT), coordinator);
    let (worker, welcome) = worker.unwrap();
    assert_eq!((welcome.id, welcome.version), (42, 1));
    assert_eq!(welcome.silence_us, 3_000_000);
    (worker, coordinator)
}

/// What holds of a connection, whatever it runs over.
async fn every_message_passes_both_ways<S: Stream>(pair: (S, S), token: Token) {
    let (mut worker, mut coordinator) = connect_by(pair, token).await;
    for (_, message) in samples::all() {
        worker.send(&message).await.unwrap();
        assert_eq!(coordinator.recv().await.unwrap(), Some(message.clone()));
        coordinator.send(&message).await.unwrap();
        assert_eq!(worker.recv().await.unwrap(), Some(message));
    }
}

async fn a_clean_end_is_told_from_a_death_inside_a_message<S: Stream>(
    clean: (S, S),
    cut: (S, S),
    token: Token,
) {
    let (worker, mut coordinator) = connect_by(clean, token).await;
    let (_reader, mut writer) = worker.split();
    writer.send(&Ping { number: 1 }.into()).await.unwrap();
    writer.close().await.unwrap();
    assert!(matches!(coordinator.recv().await, Ok(Some(Message::Ping(_)))));
    assert!(matches!(coordinator.recv().await, Ok(None)));

    let (mut near, far) = cut;
    let whole = bytes(&hello().into());
    near.write_all(&whole[..whole.len() - 1]).await.unwrap();
    near.shutdown().await.unwrap();
    let broken = accept(far, None, "terrafarm test", LIMIT).await;
    assert!(matches!(broken, Err(HandshakeError::Link(LinkError::Cut))), "{broken:?}");
}

async fn garbage_is_refused_and_closed<S: Stream>((mut near, far): (S, S), token: Token) {
    near.write_all(b"GET / HTTP/1.1\r\nHost: tower\r\n\r\n").await.unwrap();
    near.shutdown().await.unwrap();
    let refused = accept(far, token.as_ref(), "terrafarm test", LIMIT).await;
    let expected = if token.is_some() { Refusal::Token } else { Refusal::Malformed };
    assert!(
        matches!(&refused, Err(HandshakeError::Refused { refusal, .. }) if *refusal == expected),
        "{refused:?}"
    );
    let mut answer = Vec::new();
    near.read_to_end(&mut answer).await.unwrap();
    assert!(answer.starts_with(b"TFRM"));
}

async fn another_version_is_told_which_side_to_upgrade<S: Stream>(
    newer: (S, S),
    older: (S, S),
    token: Token,
) {
    let token = token.as_ref();
    for (pair, versions, advice) in [
        (newer, Versions { oldest: 7, newest: 9 }, "upgrade the coordinator"),
        (older, Versions { oldest: 0, newest: 0 }, "upgrade the worker"),
    ] {
        let (near, far) = pair;
        let (refused, refusal) = tokio::join!(
            greet(near, token, Hello { versions, ..hello() }, LIMIT),
            accept(far, token, "terrafarm test", LIMIT),
        );
        assert!(refusal.is_err());
        match refused {
            Err(HandshakeError::Refused { refusal: Refusal::Version, text }) => {
                assert!(text.ends_with(advice), "{text}");
            }
            other => panic!("{other:?}"),
        }
    }
}

async fn a_long_picture_lets_heartbeats_pass<S: Stream>(pair: (S, S), token: Token) {
    let (worker, coordinator) = connect_by(pair, token).await;
    let (_keep, writer) = worker.split();
    let (mut reader, _keep_too) = coordinator.split();
    let (queue, end) = outbox(4, 4);
    let picture = Blob { hash: BlobHash([1; 32]), bytes: vec![9; 5 * PART_BYTES].into() };
    queue.send(picture.clone()).await.unwrap();
    queue.send(Goodbye { reason: "done".into() }).await.unwrap();
    let writing = tokio::spawn(writer.run(end));
    queue.send(Ping { number: 3 }).await.unwrap();
    drop(queue);
    let mut order = Vec::new();
    while let Some(message) = reader.recv().await.unwrap() {
        order.push(message);
    }
    writing.await.unwrap().unwrap();
    let ping = order.iter().position(|m| *m == Ping { number: 3 }.into()).unwrap();
    assert!(ping <= 1, "the heartbeat came at place {ping}");
    order.remove(ping);
    assert_eq!(order, vec![picture.into(), Goodbye { reason: "done".into() }.into()]);
}

macro_rules! transport_suite {
    ($name:ident, $pair:expr, $token:expr) => {
        mod $name {
            use super::*;

            #[tokio::test]
            async fn every_message_passes_both_ways() {
                super::every_message_passes_both_ways($pair, $token).await;
            }

            #[tokio::test]
            async fn a_clean_end_is_told_from_a_death_inside_a_message() {
                super::a_clean_end_is_told_from_a_death_inside_a_message($pair, $pair, $token)
                    .await;
            }

            #[tokio::test]
            async fn garbage_is_refused_and_closed() {
                super::garbage_is_refused_and_closed($pair, $token).await;
            }

            #[tokio::test]
            async fn another_version_is_told_which_side_to_upgrade() {
                super::another_version_is_told_which_side_to_upgrade($pair, $pair, $token).await;
            }

            #[tokio::test]
            async fn a_long_picture_lets_heartbeats_pass() {
                super::a_long_picture_lets_heartbeats_pass($pair, $token).await;
            }
        }
    };
}

transport_suite!(over_memory, memory(), None);
transport_suite!(over_tcp, tcp().await, None);
transport_suite!(secure_over_memory, memory(), Some(token()));
transport_suite!(secure_over_tcp, tcp().await, Some(token()));

#[tokio::test(start_paused = true)]
async fn a_peer_that_says_nothing_costs_one_time_limit() {
    let (near, far) = memory();
    let late = accept(far, None, "terrafarm test", LIMIT).await;
    assert!(matches!(late, Err(HandshakeError::TimedOut(limit)) if limit == LIMIT));
    drop(near);
    let (near, _far) = memory();
    let late = greet(near, None, hello(), LIMIT).await;
    assert!(matches!(late, Err(HandshakeError::TimedOut(_))));
}

#[tokio::test(start_paused = true)]
async fn silence_is_noticed_and_a_trickle_is_not_silence() {
    let (near, far) = memory();
    let (worker, mut coordinator) = connect((near, far)).await;
    let (mut reader, _writer) = worker.split();
    let silence = Duration::from_secs(3);
    coordinator.send(&Ping { number: 1 }.into()).await.unwrap();
    assert!(reader.recv_within(silence).await.unwrap().is_some());
    assert!(matches!(reader.recv_within(silence).await, Err(LinkError::Silent(_))));

    let (mut near, far) = memory();
    let trickle = tokio::spawn(async move {
        for byte in bytes(&hello().into()) {
            near.write_all(&[byte]).await.unwrap();
            // A slow sender is what is tested; nothing waits for a state here.
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        near
    });
    let greeting = accept(far, None, "terrafarm test", LIMIT).await.unwrap();
    assert_eq!(greeting.hello().name, "pc-1");
    trickle.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn silence_is_noticed_although_the_receive_is_cancelled_all_the_time() {
    let (worker, _coordinator) = connect(memory()).await;
    let (mut reader, _writer) = worker.split();
    let began = tokio::time::Instant::now();
    let silence = Duration::from_secs(3);
    loop {
        tokio::select! {
            biased;
            lost = reader.recv_within(silence) => {
                assert!(matches!(lost, Err(LinkError::Silent(_))));
                break;
            }
            // What cancels is a virtual clock; nothing waits for a state here.
            () = tokio::time::sleep(Duration::from_secs(1)) => {
                assert!(began.elapsed() <= silence, "silent for {:?}", began.elapsed());
            }
        }
    }
}

/// A tile of a megabyte over 10 Mbit/s takes most of a second.
async fn a_long_message_is_heard_of_while_it_comes(token: Token) {
    let (near, far) = memory();
    let pair = (Paced::new(near, Some(1_250_000)), Paced::new(far, None));
    let (worker, coordinator) = connect_by(pair, token).await;
    let (_keep, mut writer) = worker.split();
    let (mut reader, _keep_too) = coordinator.split();
    let tile: Message = Blob { hash: BlobHash([4; 32]), bytes: vec![3; PART_BYTES].into() }.into();
    let sent = tile.clone();
    let began = tokio::time::Instant::now();
    let sending = tokio::spawn(async move {
        writer.send(&sent).await.unwrap();
        // Short ones are heard of when they are there.
        for number in 0..10 {
            writer.send(&Ping { number }.into()).await.unwrap();
        }
        writer.close().await.unwrap();
    });
    let (mut heard_at, mut more) = (began, 0);
    loop {
        let heard = reader.hear(Some(LIMIT)).await.unwrap();
        let silence = heard_at.elapsed();
        assert!(silence <= 2 * WHILE_IT_COMES, "silent for {silence:?} after {more}");
        heard_at = tokio::time::Instant::now();
        match heard {
            Heard::More => more += 1,
            Heard::Claim(_) => {}
            Heard::Message(message) => {
                assert_eq!(message, tile);
                break;
            }
            Heard::End => panic!("ended after {more}"),
        }
    }
    assert!((8..=17).contains(&more), "{more} in {:?}", began.elapsed());
    for number in 0..10 {
        let ping = Heard::Message(Ping { number }.into());
        assert_eq!(reader.hear(None).await.unwrap(), ping);
    }
    assert_eq!(reader.hear(None).await.unwrap(), Heard::End);
    sending.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_long_message_is_heard_of_while_it_comes_over_plain_and_secure_links() {
    for token in [None, Some(token())] {
        a_long_message_is_heard_of_while_it_comes(token).await;
    }
}

#[tokio::test(start_paused = true)]
async fn half_a_message_that_comes_no_further_is_silence() {
    let (near, far) = memory();
    let (mut worker, coordinator) = connect((near, far)).await;
    let (mut reader, _keep) = coordinator.split();
    let long: Message = Blob { hash: BlobHash([4; 32]), bytes: vec![3; 1 << 20].into() }.into();
    let silence = 4 * WHILE_IT_COMES;
    let sending = tokio::spawn(async move {
        // Its writer has room for a part of it only, and is dropped in the middle.
        let _ = tokio::time::timeout(WHILE_IT_COMES, worker.send(&long)).await;
        worker
    });
    let worker = sending.await.unwrap();
    let stopped = reader.hear(Some(silence)).await;
    assert!(matches!(stopped, Err(LinkError::Silent(_))), "{stopped:?}");
    drop(worker);
}

#[tokio::test(start_paused = true)]
async fn a_cancelled_receive_loses_nothing() {
    let (worker, coordinator) = connect(memory()).await;
    let (mut reader, _keep) = worker.split();
    let (_keep_too, mut writer) = coordinator.split();
    let blob: Message =
        Blob { hash: BlobHash([2; 32]), bytes: vec![1; 3 * PART_BYTES].into() }.into();
    let sent = blob.clone();
    let sending = tokio::spawn(async move {
        writer.send(&sent).await.unwrap();
        writer
    });
    let mut cancelled = 0;
    let received = loop {
        tokio::select! {
            biased;
            message = reader.recv() => break message.unwrap().unwrap(),
            () = tokio::task::yield_now() => cancelled += 1,
        }
    };
    assert_eq!(received, blob);
    assert!(cancelled > 3, "cancelled {cancelled} times");
    sending.await.unwrap();
}

#[tokio::test]
async fn a_full_queue_says_so_and_a_closed_one_too() {
    let (queue, end) = outbox(1, 1);
    assert_eq!(queue.try_send(Ping { number: 1 }), Ok(()));
    assert_eq!(queue.try_send(Ping { number: 2 }), Err(Unsent::Full));
    assert!(queue.try_send(Goodbye { reason: String::new() }).is_ok(), "the other lane has room");
    drop(end);
    assert_eq!(queue.try_send(Ping { number: 3 }), Err(Unsent::Closed));
    assert!(matches!(queue.send(Ping { number: 3 }).await, Err(LinkError::Closed)));
}
