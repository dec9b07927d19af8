//! The same picture for any number of workers and any split; workers that die, fall
//! silent, are cut off or come late.

use crate::support::{Running, World, coordinator, frame_hashes, succeed, worker};
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};

const SIZE: [&str; 4] = ["--size", "192x108", "--fps", "4"];

#[test]
fn frames_are_the_same_for_any_number_of_workers_and_any_split() {
    let world = World::new(300);
    let mut results = Vec::new();
    for (workers, split) in
        [("1", "columns"), ("2", "columns"), ("3", "tiles:64"), ("7", "columns"), ("2", "tiles:24")]
    {
        let output = world.dir.path(&format!("{workers}-{}", split.replace(':', "-")));
        succeed(
            world
                .render()
                .args(SIZE)
                .args(["--workers", workers, "--threads", "1", "--split", split, "-o"])
                .arg(&output),
        );
        results.push(frame_hashes(&output.join("manifest.json")));
    }
    assert_eq!(results[0].len(), 9, "two seconds at 4 frames/s, both ends");
    assert!(results[0].windows(2).any(|pair| pair[0] != pair[1]), "the camera moves");
    for other in &results[1..] {
        assert_eq!(other, &results[0]);
    }
}

/// Hashes of an undisturbed render of this world, and a render of the same on a farm.
fn undisturbed_and_on_farm(world: &World, address: &str) -> (Vec<String>, Running) {
    let calm = world.dir.path("calm");
    succeed(world.render().args(SIZE).args(["--workers", "1", "-o"]).arg(&calm));
    let output = world.dir.path("farm");
    let render = Running::start(
        world
            .render()
            .args(SIZE)
            .args(["--split", "tiles:32", "--coordinator", address, "-o"])
            .arg(&output),
    );
    (frame_hashes(&calm.join("manifest.json")), render)
}

#[test]
fn frames_survive_kill_9_of_a_worker_and_of_its_replacement() {
    let world = World::new(300);
    let (_coordinator, address) = coordinator();
    let (calm, render) = undisturbed_and_on_farm(&world, &address);
    for name in ["first", "replacement"] {
        let mut victim = worker(&address, name);
        // In the middle of a frame: some of its jobs are done, the next one has begun.
        for _ in 0..5 {
            victim.expect("job begins");
        }
        victim.kill();
    }
    let _last = worker(&address, "last");
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(frame_hashes(&world.dir.path("farm").join("manifest.json")), calm);
}

#[cfg(unix)]
#[test]
fn a_silent_worker_is_noticed_within_5_seconds_and_its_late_result_does_no_harm() {
    let world = World::new(300);
    let (mut coordinator, address) = coordinator();
    let (calm, render) = undisturbed_and_on_farm(&world, &address);
    let mut silent = worker(&address, "silent");
    silent.expect("job begins");
    silent.signal("STOP");
    let since = Instant::now();
    coordinator.expect("silent");
    let noticed = since.elapsed();
    assert!(noticed <= Duration::from_millis(6000), "noticed after {noticed:?}");
    let _other = worker(&address, "other");
    coordinator.expect("other");
    silent.signal("CONT");
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(frame_hashes(&world.dir.path("farm").join("manifest.json")), calm);
}

/// Passes bytes between a worker and the coordinator until it is dropped, which cuts
/// both links.
struct Cable {
    address: String,
    links: std::sync::Arc<std::sync::Mutex<Vec<TcpStream>>>,
}

impl Cable {
    fn to(coordinator: &str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let target = coordinator.to_owned();
        let links: std::sync::Arc<std::sync::Mutex<Vec<TcpStream>>> = Default::default();
        let kept = links.clone();
        std::thread::spawn(move || {
            let Ok((near, _)) = listener.accept() else { return };
            let far = TcpStream::connect(target).unwrap();
            for (mut from, mut to) in [
                (near.try_clone().unwrap(), far.try_clone().unwrap()),
                (far.try_clone().unwrap(), near.try_clone().unwrap()),
            ] {
                std::thread::spawn(move || {
                    let mut buffer = [0; 65536];
                    while let Ok(length @ 1..) = from.read(&mut buffer) {
                        if to.write_all(&buffer[..length]).is_err() {
                            break;
                        }
                    }
                });
            }
            kept.lock().unwrap().extend([near, far]);
        });
        Cable { address, links }
    }

    fn cut(&self) {
        for link in self.links.lock().unwrap().drain(..) {
            let _ = link.shutdown(std::net::Shutdown::Both);
        }
    }
}

#[test]
fn a_cut_connection_is_noticed_at_once() {
    let world = World::new(300);
    let (mut coordinator, address) = coordinator();
    let (calm, render) = undisturbed_and_on_farm(&world, &address);
    let cable = Cable::to(&address);
    let mut far = worker(&cable.address, "far");
    far.expect("job begins");
    cable.cut();
    let since = Instant::now();
    coordinator.expect("worker lost");
    assert!(since.elapsed() < Duration::from_millis(1000), "noticed after {:?}", since.elapsed());
    let _near = worker(&address, "near");
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(frame_hashes(&world.dir.path("farm").join("manifest.json")), calm);
}

#[test]
fn a_worker_that_comes_in_mid_shot_is_used() {
    let world = World::new(300);
    let (_coordinator, address) = coordinator();
    // Several seconds of work for one worker: time enough for a second to start.
    let output = world.dir.path("farm");
    let render = Running::start(
        world
            .render()
            .args(["--size", "640x360", "--fps", "4", "--samples", "3", "--split", "tiles:64"])
            .args(["--coordinator", &address, "-o"])
            .arg(&output),
    );
    let mut first = worker(&address, "first");
    first.expect("job begins");
    let mut second = worker(&address, "second");
    second.expect("job begins");
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    let manifest = std::fs::read_to_string(world.dir.path("farm").join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    let workers = manifest["workers"].as_array().unwrap();
    for name in ["first", "second"] {
        let one = workers
            .iter()
            .find(|w| w["name"] == name)
            .unwrap_or_else(|| panic!("{name} is missing"));
        assert!(one["jobs"].as_u64().unwrap() > 0, "{one}");
    }
}

#[test]
fn a_worker_that_is_told_to_stop_hands_its_jobs_back() {
    let world = World::new(300);
    let (mut coordinator, address) = coordinator();
    let (calm, render) = undisturbed_and_on_farm(&world, &address);
    let mut leaving = worker(&address, "leaving");
    leaving.expect("job begins");
    #[cfg(unix)]
    leaving.signal("TERM");
    #[cfg(not(unix))]
    leaving.kill();
    coordinator.expect("worker left");
    let _staying = worker(&address, "staying");
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(frame_hashes(&world.dir.path("farm").join("manifest.json")), calm);
}
