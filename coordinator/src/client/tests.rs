//! Against a coordinator that asks for terrain and then takes nothing of it.
#![allow(clippy::unwrap_used)]

use super::*;
use crate::queue::ShotPlan;
use crate::queue::tests::house::{Land, plan};
use std::path::Path;
use terrafarm_common::shading::Earth;
use terrafarm_wire::link::{accept, handshake::program};
use terrafarm_wire::message::Accepted;
use tokio::net::TcpListener;

/// How long a test waits for what should come.
const PATIENCE: Duration = Duration::from_secs(60);
/// More questions than a client of this memory would keep apart from the socket, and more
/// bytes than sockets hold.
const QUESTIONS: usize = 2000;

fn submission(plan: ShotPlan, folder: &Path) -> Submission {
    let store = StoreReader::open(&folder.join("land.terrain")).unwrap();
    Submission {
        name: plan.name,
        store: Arc::new(store),
        shading: plan.shading,
        quality: plan.quality,
        check: plan.check,
        split: plan.split,
        cameras: plan.cameras,
        frames_in_flight: 1,
        priority: 0,
        live: false,
    }
}

/// A shot is submitted, and the link gets stuck; what comes of it when `stop` is cancelled.
async fn stuck(silence: Duration, stop: impl FnOnce(CancellationToken)) -> ClientError {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let submission = submission(plan(&land, 1), folder.path());
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let coordinator = Coordinator::local(listener.local_addr().unwrap());
    let (updates, _inbox) = mpsc::channel(8);
    let (_taken, taken) = mpsc::channel(8);
    let token = CancellationToken::new();
    let rendering = tokio::spawn({
        let token = token.clone();
        async move { render(&coordinator, submission, updates, taken, token).await }
    });
    let (stream, _) = listener.accept().await.unwrap();
    let greeting = accept(stream, None, &program(), PATIENCE).await.unwrap();
    let welcome = greeting.welcome(1, "test", Duration::from_millis(10), silence);
    let (mut connection, _) = welcome.await.unwrap();
    connection.send(&Accepted { number: NUMBER, shot: ShotId(1) }.into()).await.unwrap();
    let (hash, _) = land.blobs.iter().max_by_key(|(_, bytes)| bytes.len()).unwrap();
    let want = Message::from(WantBlobs { hashes: vec![*hash; 1024], elsewhere: false });
    for _ in 0..QUESTIONS {
        // A client that reads no more is one that is stuck already.
        let sent = tokio::time::timeout(Duration::from_secs(1), connection.send(&want)).await;
        if sent.is_err() {
            break;
        }
    }
    stop(token);
    let ended = tokio::time::timeout(PATIENCE, rendering).await;
    ended.expect("the client hangs").unwrap().unwrap_err()
}

#[tokio::test]
async fn a_client_whose_terrain_nobody_takes_can_be_stopped() {
    let ended = stuck(2 * PATIENCE, |stop| stop.cancel()).await;
    assert!(matches!(ended, ClientError::Stopped), "{ended}");
}

#[tokio::test]
async fn a_client_whose_terrain_nobody_takes_notices_a_coordinator_that_is_gone() {
    let ended = stuck(Duration::from_secs(3), drop).await;
    assert!(matches!(ended, ClientError::Link(_)), "{ended}");
}

#[tokio::test]
async fn a_shot_that_no_farm_takes_is_refused_before_one_is_called() {
    let folder = tempfile::tempdir().unwrap();
    let land = Land::new(folder.path());
    let mut plan = plan(&land, 1);
    plan.shading.earth = Some(Earth { radius_m: 6.37e6, refraction: 0.95 });
    let submission = submission(plan, folder.path());
    // Port 0 is nobody's: calling it would be another error.
    let coordinator = Coordinator::local("127.0.0.1:0");
    let (updates, _inbox) = mpsc::channel(8);
    let (_taken, taken) = mpsc::channel(8);
    let ended = render(&coordinator, submission, updates, taken, CancellationToken::new()).await;
    let Err(ClientError::Unfit(why)) = ended else { panic!("{:?}", ended.map(|_| ())) };
    assert!(why.contains("refraction"), "{why}");
}
