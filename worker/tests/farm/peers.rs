use crate::scene::{Terrain, grant, whole};
use crate::script::{Coordinator, PATIENCE, Peer, start};
use std::collections::BTreeSet;
use std::net::SocketAddr;
use terrafarm_common::id::{BlobHash, LeaseId};
use terrafarm_wire::Message;
use terrafarm_wire::link::{FarmToken, HandshakeError, Trust, accept, greet};
use terrafarm_wire::message::{
    Ahead, Blob, Done, Elsewhere, Grant, Hello, NoBlob, Role, Sharing, WantBlobs,
};
use terrafarm_worker::ShareTiles;
use tokio::net::{TcpListener, TcpStream};

/// The port of a worker that has just said that it shares.
async fn shared(peer: &mut Peer) -> SocketAddr {
    match peer.recv().await {
        Some(Message::Sharing(Sharing { port })) => ([127, 0, 0, 1], port).into(),
        other => panic!("{other:?}"),
    }
}

/// Serves a worker until its pixels come: it is sent to these addresses for every blob that
/// it takes from others. Returns what it asked the coordinator itself for.
async fn serve(
    peer: &mut Peer,
    terrain: &Terrain,
    elsewhere: &[SocketAddr],
) -> (Done, BTreeSet<BlobHash>) {
    let mut given = BTreeSet::new();
    loop {
        match peer.recv().await {
            Some(Message::WantBlobs(want)) => {
                for hash in want.hashes {
                    if want.elsewhere {
                        peer.send(Elsewhere { hash, workers: elsewhere.to_vec() }).await;
                    } else {
                        assert!(given.insert(hash), "asked twice");
                        let bytes = terrain.blobs[&hash].clone().into();
                        peer.send(Blob { hash, bytes }).await;
                    }
                }
            }
            Some(Message::Done(done)) => return (done, given),
            other => panic!("{other:?}"),
        }
    }
}

fn check(done: Done, terrain: &Terrain, job: &Grant) {
    let pixels = done.pixels.unpack(whole().area() as usize * 3).unwrap();
    assert!(pixels == terrain.expected(job, 1));
}

#[tokio::test]
async fn a_worker_gets_all_of_its_terrain_from_another_one() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let token = FarmToken::from_bytes([7; 32]);
    let configs = folders.each_ref().map(|folder| {
        let mut config = coordinator.config(Some(folder.path()));
        config.share = ShareTiles::At(0);
        config.trust = Trust::Token(token.clone());
        config
    });
    let [first, second] = configs;
    let job = grant(1, 1, whole());
    let _first = start(first);
    let mut peer = coordinator.welcome_by(Some(&token)).await;
    let address = shared(&mut peer).await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(job).await;
    assert!(matches!(peer.serve(&terrain).await, Some(Message::Done(_))));
    let asked = peer.asked.len();

    let _second = start(second);
    let mut other = coordinator.welcome_by(Some(&token)).await;
    shared(&mut other).await;
    other.send(terrain.open(1, 1)).await;
    other.send(job).await;
    let (done, given) = serve(&mut other, &terrain, &[address]).await;
    check(done, &terrain, &job);
    assert!(asked >= 2 && given.is_empty(), "{} of {asked} by the coordinator", given.len());

    // Strangers, and those who are no peers, get nothing.
    let hello = |role| Hello::new("guest", role);
    let wrong = FarmToken::from_bytes([8; 32]);
    for token in [Some(&wrong), None] {
        let stream = TcpStream::connect(address).await.unwrap();
        let refused = greet(stream, token, hello(Role::Peer), PATIENCE).await;
        assert!(refused.is_err(), "{token:?}");
    }
    let stream = TcpStream::connect(address).await.unwrap();
    let refused = greet(stream, Some(&token), hello(Role::Client), PATIENCE).await;
    assert!(matches!(refused, Err(HandshakeError::Refused { .. })));
    // A peer gets what is there, and a clear answer for what is not.
    let stream = TcpStream::connect(address).await.unwrap();
    let greeted = greet(stream, Some(&token), hello(Role::Peer), PATIENCE).await;
    let (mut guest, _) = greeted.unwrap();
    let hashes = vec![BlobHash([9; 32]), terrain.index_hash];
    guest.send(&WantBlobs { hashes, elsewhere: false }.into()).await.unwrap();
    let answer = guest.recv().await.unwrap();
    assert!(matches!(answer, Some(Message::NoBlob(NoBlob { hash: BlobHash([9, ..]), .. }))));
    let answer = guest.recv().await.unwrap();
    assert!(matches!(answer, Some(Message::Blob(blob)) if blob.hash == terrain.index_hash));
}

/// What another worker may do wrong.
#[derive(Clone, Copy, PartialEq)]
enum Fault {
    Hangs,
    DiesAfterTheQuestion,
    SendsOtherBytes,
    SendsOtherBlobs,
    HasNothing,
    SpeaksNonsense,
}

async fn bad_worker(fault: Fault) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    tokio::spawn(async move {
        while let Ok((stream, _)) = listener.accept().await {
            tokio::spawn(async move {
                let greeting = accept(stream, None, "bad", PATIENCE).await.unwrap();
                let (mut link, _) =
                    greeting.welcome(0, "bad", PATIENCE / 2, PATIENCE).await.unwrap();
                while let Ok(Some(Message::WantBlobs(want))) = link.recv().await {
                    let hash = want.hashes[0];
                    let bytes = b"something else"[..].into();
                    let answer: Message = match fault {
                        Fault::Hangs => std::future::pending().await,
                        Fault::DiesAfterTheQuestion => return,
                        Fault::SendsOtherBytes => Blob { hash, bytes }.into(),
                        Fault::SendsOtherBlobs => Blob { hash: BlobHash([1; 32]), bytes }.into(),
                        Fault::HasNothing => NoBlob { hash, why: "no".into() }.into(),
                        Fault::SpeaksNonsense => want.into(),
                    };
                    if link.send(&answer).await.is_err() {
                        return;
                    }
                }
            });
        }
    });
    address
}

#[tokio::test]
async fn workers_that_die_lie_or_stall_do_no_harm() {
    let terrain = Terrain::new();
    let job = grant(1, 1, whole());
    let nobody = {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        listener.local_addr().unwrap()
    };
    let mut bad = vec![nobody];
    for fault in [
        Fault::Hangs,
        Fault::DiesAfterTheQuestion,
        Fault::SendsOtherBytes,
        Fault::SendsOtherBlobs,
        Fault::HasNothing,
        Fault::SpeaksNonsense,
    ] {
        bad.push(bad_worker(fault).await);
    }
    for addresses in bad.chunks(2) {
        let folder = tempfile::tempdir().unwrap();
        let coordinator = Coordinator::new().await;
        let _running = start(coordinator.config(Some(folder.path())));
        let mut peer = coordinator.welcome().await;
        peer.send(terrain.open(1, 1)).await;
        peer.send(job).await;
        let (done, given) = serve(&mut peer, &terrain, addresses).await;
        check(done, &terrain, &job);
        assert!(given.len() >= 2, "all of it from the coordinator in the end");
    }
}

#[tokio::test]
async fn the_tiles_of_the_way_ahead_are_there_before_a_job_asks() {
    let terrain = Terrain::new();
    let job = grant(2, 1, whole());
    // What the job asks for if nothing was fetched before.
    let mut needed: BTreeSet<_> = {
        let coordinator = Coordinator::new().await;
        let _running = start(coordinator.config(None));
        let mut peer = coordinator.welcome().await;
        peer.send(terrain.open(1, 1)).await;
        peer.send(job).await;
        assert!(matches!(peer.serve(&terrain).await, Some(Message::Done(_))));
        peer.asked.into_iter().collect()
    };
    for on_disk in [true, false] {
        let folder = tempfile::tempdir().unwrap();
        let coordinator = Coordinator::new().await;
        let _running = start(coordinator.config(on_disk.then(|| folder.path())));
        let mut peer = coordinator.welcome().await;
        peer.send(terrain.open(1, 1)).await;
        // The first job looks at the sky, the way ahead lies on the ground.
        let mut sky = Grant { lease: LeaseId(1), ..job };
        (sky.camera.forward, sky.camera.up) = (job.camera.up, -job.camera.forward);
        peer.send(sky).await;
        assert!(matches!(peer.serve(&terrain).await, Some(Message::Done(_))));
        needed.retain(|hash| !peer.asked.contains(hash));
        assert!(!needed.is_empty());
        let ahead = Ahead { shot: job.shot, first: 8, stride: 8, cameras: vec![job.camera] };
        peer.send(ahead).await;
        let mut fetched = BTreeSet::new();
        while !needed.is_subset(&fetched) {
            let Some(Message::WantBlobs(want)) = peer.recv().await else { panic!("no question") };
            for hash in want.hashes {
                assert!(fetched.insert(hash), "asked twice");
                let bytes = terrain.blobs[&hash].clone().into();
                peer.send(Blob { hash, bytes }).await;
            }
        }
        peer.asked.clear();
        peer.send(job).await;
        let Some(Message::Done(done)) = peer.serve(&terrain).await else { panic!("no pixels") };
        check(done, &terrain, &job);
        assert!(peer.asked.iter().all(|hash| !needed.contains(hash)), "all of it was there");
    }
}
