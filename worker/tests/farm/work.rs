use crate::scene::{SIZE, Terrain, grant, whole};
use crate::script::{Coordinator, PATIENCE, gated, start, start_with};
use terrafarm_common::accuracy::{Share, Summary};
use terrafarm_common::id::{BlobHash, LeaseId};
use terrafarm_common::region::{Region, columns};
use terrafarm_wire::Message;
use terrafarm_wire::link::{Paced, accept};
use terrafarm_wire::message::{Blob, Drain, OpenShot, Ping, Pong, Role};
use terrafarm_worker::Ended;

#[tokio::test]
async fn the_pixels_are_those_of_the_ray_caster_however_the_frame_is_cut() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let running = start(coordinator.config(None));
    let mut peer = coordinator.welcome().await;
    assert_eq!(peer.hello.name, "pc-1");
    assert_eq!(peer.hello.role, Role::Worker { threads: 2, incarnation: 5, identity: 7 });
    peer.send(terrain.open(1, 1)).await;
    let mut regions = columns(SIZE.0, SIZE.1, &[1, 40, 41, 90]);
    regions.push(whole());
    regions.push(Region { x: 33, y: 17, width: 40, height: 5 });
    for (number, region) in regions.iter().enumerate() {
        peer.send(grant(number as u64, 1, *region)).await;
    }
    for (number, region) in regions.iter().enumerate() {
        let Some(Message::Done(done)) = peer.serve(&terrain).await else { panic!("no pixels") };
        assert_eq!(done.lease, LeaseId(number as u64));
        assert!(done.report.rays >= region.area());
        let pixels = done.pixels.unpack(region.area() as usize * 3).unwrap();
        assert!(pixels == terrain.expected(&grant(0, 1, *region), 1), "{region:?}");
    }
    let asked = peer.asked.len();
    peer.asked.sort_unstable();
    peer.asked.dedup();
    assert!(asked >= 2 && peer.asked.len() == asked, "index and tiles, each once");
    running.stop.send(()).unwrap();
    assert!(matches!(peer.recv().await, Some(Message::Goodbye(_))));
    assert!(peer.recv().await.is_none(), "a clean end");
    assert_eq!(running.ended.await.unwrap().unwrap(), Ended::Stopped);
}

#[tokio::test]
async fn the_errors_of_parts_are_those_of_the_whole_and_exact_has_none() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let running = start(coordinator.config(None));
    let mut peer = coordinator.welcome().await;
    let check = Share::from_millionths(300_000).unwrap();
    peer.send(OpenShot { check, ..terrain.open(1, 1) }).await;
    // The parts first: they wait for the tiles.
    let mut regions = columns(SIZE.0, SIZE.1, &[7, 40, 41]);
    let mut parts = Summary::default();
    regions.push(whole());
    for (number, region) in regions.iter().enumerate() {
        peer.send(grant(number as u64, 1, *region)).await;
    }
    for region in &regions {
        let Some(Message::Done(done)) = peer.serve(&terrain).await else { panic!("no pixels") };
        let errors = done.check.expect("a check was asked for");
        if *region != whole() {
            parts.merge(&errors);
            continue;
        }
        assert_eq!(parts, errors);
        assert!((1650..2050).contains(&errors.samples()), "{} of 6144", errors.samples());
        assert_eq!((errors.error_max_px(), errors.mismatches()), (0.0, 0));
        assert!(errors.depth_max_m().is_some_and(|depth| depth < 1e-3));
    }
    drop(running.stop);
}

#[tokio::test]
async fn a_live_job_shows_coarser_ground_at_once_and_a_later_one_what_has_come_since() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let _running = start(coordinator.config(None));
    let mut peer = coordinator.welcome().await;
    peer.send(OpenShot { live: true, ..terrain.open(1, 1) }).await;
    peer.send(grant(1, 1, whole())).await;
    let roots = terrain.index.roots().into_iter();
    let mut given: Vec<_> = roots.map(|root| terrain.index.entry(root).unwrap().hash).collect();
    given.push(terrain.index_hash);
    let mut held_back = Vec::new();
    let done = loop {
        match peer.recv().await {
            Some(Message::WantBlobs(want)) => {
                for hash in want.hashes {
                    match given.contains(&hash) {
                        true => {
                            let bytes = terrain.blobs[&hash].clone().into();
                            peer.send(Blob { hash, bytes }).await;
                        }
                        false => held_back.push(hash),
                    }
                }
            }
            Some(Message::Done(done)) => break done,
            other => panic!("{other:?}"),
        }
    };
    let area = whole().area();
    assert!(done.report.coarser > 0 && done.report.coarser <= area, "{:?}", done.report);
    let expected = terrain.expected(&grant(0, 1, whole()), 1);
    let coarse = done.pixels.unpack(area as usize * 3).unwrap();
    assert!(coarse != expected, "the tiles are needed");
    assert!(!held_back.is_empty());
    for hash in held_back {
        peer.send(Blob { hash, bytes: terrain.blobs[&hash].clone().into() }).await;
    }
    // What lay hidden behind coarser ground may lack a tile in its turn.
    for lease in 2..10 {
        peer.send(grant(lease, 1, whole())).await;
        let Some(Message::Done(done)) = peer.serve(&terrain).await else { panic!("no pixels") };
        if done.report.coarser == 0 {
            let pixels = done.pixels.unpack(area as usize * 3).unwrap();
            assert!(pixels == expected, "the picture that waits for all");
            return;
        }
    }
    panic!("still coarser");
}

#[tokio::test]
async fn a_second_start_finds_its_terrain_on_disk() {
    let terrain = Terrain::new();
    let folder = tempfile::tempdir().unwrap();
    let coordinator = Coordinator::new().await;
    for first in [true, false] {
        let running = start(coordinator.config(Some(folder.path())));
        let mut peer = coordinator.welcome().await;
        peer.send(terrain.open(1, 1)).await;
        peer.send(grant(1, 1, whole())).await;
        let Some(Message::Done(done)) = peer.serve(&terrain).await else { panic!("no pixels") };
        let pixels = done.pixels.unpack(whole().area() as usize * 3).unwrap();
        assert!(pixels == terrain.expected(&grant(1, 1, whole()), 1));
        assert_eq!(peer.asked.is_empty(), !first);
        peer.send(Drain {}).await;
        assert!(matches!(peer.recv().await, Some(Message::Goodbye(_))));
        assert_eq!(running.ended.await.unwrap().unwrap(), Ended::Drained);
    }
}

#[tokio::test]
async fn a_heartbeat_is_answered_while_a_job_renders() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let (caster, mut gate) = gated();
    let running = start_with(coordinator.config(None), caster);
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(grant(1, 1, Region { width: 32, height: 32, ..whole() })).await;
    // The blobs it asks for must be served meanwhile.
    peer.send(Ping { number: 1 }).await;
    let mut pongs = 0;
    while peer.asked.is_empty() || pongs == 0 {
        tokio::select! {
            message = peer.recv() => match message {
                Some(Message::WantBlobs(want)) => {
                    let hash = want.hashes[0];
                    peer.asked.push(hash);
                    let bytes = terrain.blobs[&hash].clone().into();
                    peer.send(terrafarm_wire::message::Blob { hash, bytes }).await;
                }
                Some(Message::Pong(Pong { number: 1 })) => pongs += 1,
                other => panic!("{other:?}"),
            }
        }
    }
    gate.has_begun().await;
    peer.send(Ping { number: 2 }).await;
    assert_eq!(peer.recv().await, Some(Pong { number: 2 }.into()), "the job still renders");
    gate.open(1);
    assert!(matches!(peer.recv().await, Some(Message::Done(_))));
    drop(running.stop);
    running.ended.abort();
}

#[tokio::test]
async fn a_worker_says_that_it_lives_while_a_long_message_comes_and_is_not_asked() {
    let coordinator = Coordinator::new().await;
    let running = start(coordinator.config(None));
    let (stream, _) = coordinator.listener.accept().await.unwrap();
    // 4 MB a second: it takes a quarter of a second.
    let slow = Paced::new(stream, Some(4_000_000));
    let greeting = accept(slow, None, "terrafarm test", PATIENCE).await.unwrap();
    let (connection, _) = greeting.welcome(1, "tower", PATIENCE / 3, PATIENCE).await.unwrap();
    let (mut reader, mut writer) = connection.split();
    let bytes = vec![1; 1 << 20].into();
    writer.send(&Blob { hash: BlobHash([1; 32]), bytes }.into()).await.unwrap();
    let unasked = loop {
        match reader.recv().await.unwrap() {
            Some(Message::Speed(_) | Message::Status(_)) => {}
            other => break other,
        }
    };
    assert_eq!(unasked, Some(Pong { number: 0 }.into()));
    drop(running.stop);
    running.ended.abort();
}

#[tokio::test]
async fn on_shutdown_the_job_that_runs_is_finished_and_the_others_handed_back() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let (caster, mut gate) = gated();
    let running = start_with(coordinator.config(None), caster);
    let mut peer = coordinator.welcome().await;
    let small = Region { width: 32, height: 32, ..whole() };
    peer.send(terrain.open(1, 1)).await;
    peer.send(grant(1, 1, small)).await;
    peer.send(grant(2, 1, small)).await;
    peer.send(grant(3, 1, small)).await;
    peer.send(Ping { number: 7 }).await;
    assert_eq!(peer.serve(&terrain).await, Some(Pong { number: 7 }.into()));
    let begun = gate.has_begun();
    let serving = peer.serve(&terrain);
    // Serves the index; says nothing more until the worker is told to stop.
    let handed_back = {
        tokio::pin!(begun, serving);
        tokio::select! {
            () = &mut begun => {}
            early = &mut serving => panic!("{early:?}"),
        }
        running.stop.send(()).unwrap();
        serving.await
    };
    let Some(Message::HandBack(back)) = handed_back else { panic!("{handed_back:?}") };
    assert_eq!(back.leases, [LeaseId(2), LeaseId(3)]);
    gate.open(1);
    let Some(Message::Done(done)) = peer.recv().await else { panic!("the first is finished") };
    assert_eq!(done.lease, LeaseId(1));
    assert!(matches!(peer.recv().await, Some(Message::Goodbye(_))));
    assert!(peer.recv().await.is_none());
    assert_eq!(running.ended.await.unwrap().unwrap(), Ended::Stopped);
}

#[tokio::test]
async fn a_worker_comes_only_within_its_hours_and_can_be_stopped_outside() {
    let coordinator = Coordinator::new().await;
    let now = jiff::Zoned::now();
    let around = |from: i64, to: i64| {
        let at = |hours: i64| {
            (&now + jiff::SignedDuration::from_hours(hours)).strftime("%H:%M").to_string()
        };
        Some(format!("{}-{}", at(from), at(to)).parse().unwrap())
    };
    let mut config = coordinator.config(None);
    config.rules.hours = around(2, 3);
    let mut outside = start(config);
    assert!(coordinator.nobody_came(), "it is outside its hours");
    outside.stop.send(()).unwrap();
    assert_eq!((&mut outside.ended).await.unwrap().unwrap(), Ended::Stopped);
    assert!(coordinator.nobody_came());

    let mut config = coordinator.config(None);
    config.rules.hours = around(-1, 1);
    let inside = start(config);
    let mut peer = coordinator.welcome().await;
    peer.send(Ping { number: 1 }).await;
    assert_eq!(peer.recv().await, Some(Pong { number: 1 }.into()));
    inside.stop.send(()).unwrap();
    assert!(matches!(peer.recv().await, Some(Message::Goodbye(_))));
    assert_eq!(inside.ended.await.unwrap().unwrap(), Ended::Stopped);
}

#[tokio::test]
async fn a_polite_worker_on_a_slow_line_gives_the_same_pixels() {
    let terrain = Terrain::new();
    let coordinator = Coordinator::new().await;
    let mut config = coordinator.config(None);
    config.rules.polite = true;
    config.bandwidth_bytes_per_s = Some(2_000_000);
    let running = start(config);
    let mut peer = coordinator.welcome().await;
    peer.send(terrain.open(1, 1)).await;
    peer.send(grant(1, 1, whole())).await;
    let Some(Message::Done(done)) = peer.serve(&terrain).await else { panic!("no pixels") };
    let pixels = done.pixels.unpack(whole().area() as usize * 3).unwrap();
    assert!(pixels == terrain.expected(&grant(0, 1, whole()), 1));
    running.stop.send(()).unwrap();
}
