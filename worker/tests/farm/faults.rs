use crate::scene::{Terrain, grant, whole};
use crate::script::{Coordinator, PATIENCE, gated, start, start_with};
use std::time::Duration;
use terrafarm_common::id::LeaseId;
use terrafarm_common::region::Region;
use terrafarm_wire::Message;
use terrafarm_wire::link::accept;
use terrafarm_wire::message::{Blob, Ping, Pong, Refusal, Revoke};
use terrafarm_worker::{Ended, Reconnect, WorkerError};
use tokio::io::AsyncWriteExt;

const SMALL: Region = Region { x: 0, y: 0, width: 32, height: 32 };

fn reason(message: Option<Message>) -> String {
    match message {
        Some(Message::Failed(failed)) => failed.reason,
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_tile_that_nobody_has_fails_the_job_with_the_reason() {
    let mut terrain = Terrain::new();
    let index = terrain.index_hash;
    terrain.blobs.retain(|hash, _| *hash == index);
    let coordinator = Coordinator::new().await;
    let _running = start(coordinator.config(None));
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(grant(1, 1, whole())).await;
    let reason = reason(peer.serve(&terrain).await);
    assert!(reason.ends_with("the client has left"), "{reason}");
}

#[tokio::test]
async fn bytes_that_are_not_what_was_asked_for_are_asked_for_again() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let folder = tempfile::tempdir().unwrap();
    let _running = start(coordinator.config(Some(folder.path())));
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    let job = grant(1, 1, whole());
    peer.send(job).await;
    // Each blob comes torn once.
    let mut torn = std::collections::BTreeSet::new();
    let done = loop {
        match peer.recv().await {
            Some(Message::WantBlobs(want)) => {
                for hash in want.hashes {
                    let mut bytes = terrain.blobs[&hash].clone();
                    let first = torn.insert(hash);
                    assert_eq!(want.elsewhere, first, "the coordinator itself, the second time");
                    if first {
                        let middle = bytes.len() / 2;
                        bytes[middle] ^= 0x10;
                    }
                    peer.send(Blob { hash, bytes: bytes.into() }).await;
                }
            }
            Some(Message::Done(done)) => break done,
            other => panic!("{other:?}"),
        }
    };
    assert!(torn.len() >= 2, "the index and a tile");
    let pixels = done.pixels.unpack(whole().area() as usize * 3).unwrap();
    assert!(pixels == terrain.expected(&job, 1));
}

#[tokio::test]
async fn a_bit_that_flips_in_the_cache_is_found_and_its_tile_fetched_again() {
    let terrain = Terrain::new();
    let folder = tempfile::tempdir().unwrap();
    let coordinator = Coordinator::new().await;
    let job = grant(1, 1, whole());
    for first in [true, false] {
        let running = start(coordinator.config(Some(folder.path())));
        let mut peer = coordinator.welcome().await;
        peer.send(terrain.open(1, 1)).await;
        peer.send(job).await;
        let Some(Message::Done(done)) = peer.serve(&terrain).await else { panic!("no pixels") };
        let pixels = done.pixels.unpack(whole().area() as usize * 3).unwrap();
        assert!(pixels == terrain.expected(&job, 1));
        running.stop.send(()).unwrap();
        assert!(matches!(peer.recv().await, Some(Message::Goodbye(_))));
        running.ended.await.unwrap().unwrap();
        let files: Vec<_> =
            std::fs::read_dir(folder.path()).unwrap().map(|file| file.unwrap().path()).collect();
        assert!(files.len() >= 2 && peer.asked.len() == files.len(), "each one again");
        for file in files.iter().filter(|_| first) {
            let mut bytes = std::fs::read(file).unwrap();
            let middle = bytes.len() / 2;
            bytes[middle] ^= 1;
            std::fs::write(file, bytes).unwrap();
        }
    }
}

#[tokio::test]
async fn bytes_that_are_never_what_was_asked_for_fail_the_job() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let _running = start(coordinator.config(None));
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(grant(1, 1, whole())).await;
    for _ in 0..3 {
        let Some(Message::WantBlobs(want)) = peer.recv().await else { panic!("no question") };
        let hash = want.hashes[0];
        peer.send(Blob { hash, bytes: b"something else"[..].into() }).await;
    }
    let reason = reason(peer.recv().await);
    assert!(reason.ends_with("what came has another hash"), "{reason}");
}

#[tokio::test]
async fn terrain_above_the_memory_limit_fails_the_job_and_says_what_to_do() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let mut config = coordinator.config(None);
    config.memory_limit_bytes = 100_000;
    let _running = start(config);
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(grant(1, 1, whole())).await;
    let reason = reason(peer.serve(&terrain).await);
    assert!(reason.contains("raise it, or cut frames into smaller jobs"), "{reason}");
}

#[tokio::test]
async fn a_panic_fails_the_job_and_not_the_worker() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let (caster, gate) = gated();
    let _running = start_with(coordinator.config(None), caster);
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(terrain.open(2, 2)).await;
    peer.send(grant(1, 2, SMALL)).await;
    let reason = reason(peer.serve(&terrain).await);
    assert_eq!(reason, "the ray caster failed: two samples are too many");
    gate.open(1);
    peer.send(grant(2, 1, SMALL)).await;
    assert!(matches!(peer.serve(&terrain).await, Some(Message::Done(_))));
}

#[tokio::test]
async fn nothing_is_sent_under_a_revoked_lease() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let (caster, mut gate) = gated();
    let _running = start_with(coordinator.config(None), caster);
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(grant(1, 1, whole())).await;
    let hash = terrain.index_hash;
    assert!(matches!(peer.recv().await, Some(Message::WantBlobs(_))));
    peer.send(Blob { hash, bytes: terrain.blobs[&hash].clone().into() }).await;
    gate.has_begun().await;
    peer.send(Revoke { lease: LeaseId(1) }).await;
    peer.send(Ping { number: 1 }).await;
    assert!(matches!(peer.recv().await, Some(Message::Pong(_))), "the revocation is read");
    peer.send(grant(2, 1, SMALL)).await;
    // Two pieces were begun, one a thread; the other four never are. One more is the
    // second job's.
    gate.open(3);
    let Some(Message::Done(done)) = peer.serve(&terrain).await else { panic!("no pixels") };
    assert_eq!(done.lease, LeaseId(2));
}

#[tokio::test]
async fn a_silent_coordinator_is_lost_and_the_worker_comes_back() {
    let coordinator = Coordinator::new().await;
    let running = start(coordinator.config(None));
    let _silent = coordinator.welcome_with(Duration::from_millis(30)).await;
    let mut peer = coordinator.welcome().await;
    peer.send(Ping { number: 1 }).await;
    assert_eq!(peer.recv().await, Some(Pong { number: 1 }.into()));
    running.stop.send(()).unwrap();
    assert!(matches!(peer.recv().await, Some(Message::Goodbye(_))));
    assert_eq!(running.ended.await.unwrap().unwrap(), Ended::Stopped);
}

#[tokio::test]
async fn garbage_and_sudden_ends_are_survived_and_terrain_is_kept() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let _running = start(coordinator.config(None));
    // One that answers the greeting with something else altogether.
    let (mut stream, _) = coordinator.listener.accept().await.unwrap();
    stream.write_all(&[0xA5; 4096]).await.unwrap();
    drop(stream);
    // One that dies while a job waits for its tiles.
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(grant(1, 1, whole())).await;
    let hash = terrain.index_hash;
    assert!(matches!(peer.recv().await, Some(Message::WantBlobs(_))));
    peer.send(Blob { hash, bytes: terrain.blobs[&hash].clone().into() }).await;
    assert!(matches!(peer.recv().await, Some(Message::WantBlobs(_))), "now for tiles");
    drop(peer);
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(grant(9, 1, whole())).await;
    let Some(Message::Done(done)) = peer.serve(&terrain).await else { panic!("no pixels") };
    assert_eq!(done.lease, LeaseId(9));
    assert!(!peer.asked.contains(&hash), "the index is still there");
}

#[tokio::test]
async fn a_refusal_for_good_ends_the_worker_and_a_temporary_one_does_not() {
    let coordinator = Coordinator::new().await;
    let running = start(coordinator.config(None));
    for refusal in [Refusal::Full, Refusal::Version] {
        let (stream, _) = coordinator.listener.accept().await.unwrap();
        let greeting = accept(stream, None, "terrafarm test", PATIENCE).await.unwrap();
        greeting.refuse(refusal, "upgrade the worker").await;
    }
    let error = running.ended.await.unwrap().unwrap_err();
    assert!(matches!(&error, WorkerError::Refused { .. }), "{error}");
    assert!(error.to_string().ends_with("upgrade the worker"), "{error}");
}

#[tokio::test]
async fn nobody_there_is_an_error_that_says_where_and_what_to_check() {
    let coordinator = Coordinator::new().await;
    let mut config = coordinator.config(None);
    config.reconnect = Reconnect::NEVER;
    let address = coordinator.listener.local_addr().unwrap();
    drop(coordinator);
    let error = start(config).ended.await.unwrap().unwrap_err().to_string();
    assert!(error.starts_with(&format!("cannot reach coordinator {address}: ")), "{error}");
    assert!(error.ends_with("and the port open?"), "{error}");
}
