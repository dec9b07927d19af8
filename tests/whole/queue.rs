//! The queue on disk outlives its coordinator, killed at any moment; workers find the next
//! one by themselves, and nothing finished is rendered again.

use crate::support::{Dir, Running, World, frame_hashes, run, succeed, terrafarm, worker};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::time::SystemTime;

const SIZE: [&str; 4] = ["--size", "192x108", "--fps", "60"];
/// Two seconds of flight, both ends.
const FRAMES: usize = 121;
/// How often frames are recorded before the coordinator is killed: a few each time.
const RECORDS: u32 = 4;

/// A coordinator with a queue, on this address, that says when frames are recorded.
fn coordinator(data: &Path, listen: &str) -> (Running, String) {
    let mut command = terrafarm();
    command.args(["-vv", "coordinator", "--no-http", "--listen", listen, "--data"]).arg(data);
    let mut running = Running::start(&mut command);
    let line = running.expect("coordinator on ");
    let address = line.rsplit(' ').next().unwrap().to_owned();
    (running, address)
}

fn submit(world: &World, address: &str) -> String {
    let mut command = terrafarm();
    command.arg("submit").arg(&world.scene).arg("--flight").arg(&world.flight).args(SIZE);
    succeed(command.args(["--film", "mp4", "--coordinator", address]))
}

fn shot(address: &str, id: u32) -> Option<serde_json::Value> {
    let mut command = terrafarm();
    command.args(["shots", &id.to_string(), "--json", "--coordinator", address]);
    let output = command.output().unwrap();
    let value = output.status.success().then(|| serde_json::from_slice(&output.stdout).unwrap());
    // A list of one, or the one.
    value.map(|value: serde_json::Value| match value {
        serde_json::Value::Array(mut list) => list.remove(0),
        one => one,
    })
}

fn state(shot: &serde_json::Value) -> String {
    shot["state"].as_str().unwrap().to_owned()
}

/// When each picture in a folder was written.
fn pictures(folder: &Path) -> BTreeMap<String, SystemTime> {
    let entries = fs::read_dir(folder).into_iter().flatten().map(Result::unwrap);
    let named = entries.map(|entry| (entry.file_name().into_string().unwrap(), entry));
    let frames = named.filter(|(name, _)| name.starts_with("frame_"));
    frames.map(|(name, entry)| (name, entry.metadata().unwrap().modified().unwrap())).collect()
}

/// Waits until frames have been recorded so often, or so many shots are done.
fn wait_for_frames(running: &mut Running, mut records: u32, mut undone: usize) {
    while records > 0 && undone > 0 {
        match running.expect_one_of(&["frames recorded", "close: done shot="]) {
            line if line.contains("frames recorded") => records -= 1,
            _ => undone -= 1,
        }
    }
}

#[test]
fn a_coordinator_that_is_killed_again_and_again_finishes_what_was_submitted() {
    let world = World::new(300);
    let calm = world.dir.path("calm");
    succeed(world.render().args(SIZE).args(["--workers", "1", "-o"]).arg(&calm));
    let calm = frame_hashes(&calm.join("manifest.json"));
    assert_eq!(calm.len(), FRAMES);

    let data = world.dir.path("data");
    let (mut running, address) = coordinator(&data, "127.0.0.1:0");
    submit(&world, &address);
    submit(&world, &address);
    // The workers are never started again.
    let _workers = [worker(&address, "one"), worker(&address, "two")];
    let folders = [1, 2].map(|id| data.join(format!("shots/{id:06}")));
    let mut kills = 0;
    wait_for_frames(&mut running, RECORDS, 2);
    loop {
        let shown = [1, 2].map(|id| shot(&address, id).unwrap());
        if shown.iter().all(|shot| state(shot) == "done") {
            break;
        }
        let done: u64 = shown.iter().map(|shot| shot["frames_done"].as_u64().unwrap()).sum();
        running.kill();
        kills += 1;
        let files = [0, 1].map(|at| pictures(&folders[at]));
        let there = files.iter().map(BTreeMap::len).sum::<usize>();
        running = coordinator(&data, &address).0;
        let shown = [1, 2].map(|id| shot(&address, id).unwrap());
        let again = shown.iter().map(|shot| shot["frames_done"].as_u64().unwrap());
        assert!(again.sum::<u64>() >= done, "what was shown is lost");
        // Pictures without a record are written over: no more than were on their way.
        let on_their_way = there as u64 - done;
        let undone = shown.iter().filter(|shot| state(shot) != "done").count();
        wait_for_frames(&mut running, RECORDS, undone);
        let written_again = [0, 1].map(|at| {
            let now = pictures(&folders[at]);
            files[at].iter().filter(|(name, when)| now[*name] != **when).count() as u64
        });
        assert!(written_again.iter().sum::<u64>() <= on_their_way, "{written_again:?}");
    }
    assert!(kills >= 3, "killed {kills} times");
    for folder in &folders {
        assert_eq!(frame_hashes(&folder.join("manifest.json")), calm);
        assert!(folder.join("film.mp4").metadata().unwrap().len() > 1000);
    }
}

#[test]
fn a_second_coordinator_with_the_same_folder_is_told_who_has_it() {
    let dir = Dir::new();
    let data = dir.path("data");
    let (_first, _) = coordinator(&data, "127.0.0.1:0");
    let mut second = terrafarm();
    second.args(["coordinator", "--no-http", "--listen", "127.0.0.1:0", "--data"]).arg(&data);
    let (printed, said) = run(&mut second, 2);
    assert!(said.contains("is in use by the coordinator with process"), "{said}");
    assert_eq!(printed, "", "nobody is told of a coordinator that does not serve");
}

#[test]
fn a_coordinator_without_a_folder_says_what_to_do_and_one_with_the_variable_has_one() {
    let world = World::new(64);
    let (_running, address) = crate::support::coordinator();
    let mut command = terrafarm();
    command.arg("submit").arg(&world.scene).arg("--flight").arg(&world.flight).args(SIZE);
    let (_, said) = run(command.args(["--coordinator", &address]), 2);
    assert!(said.contains("start it with --data FOLDER"), "{said}");
    let data = world.dir.path("from-variable");
    let mut command = terrafarm();
    command.args(["coordinator", "--no-http", "--listen", "127.0.0.1:0"]);
    let mut named = Running::start(command.env("TERRAFARM_DATA", &data));
    named.expect("coordinator on ");
    assert!(data.join("queue.redb").is_file());
}

#[test]
fn a_damaged_queue_is_said_to_be_damaged() {
    let dir = Dir::new();
    let data = dir.path("data");
    fs::create_dir_all(&data).unwrap();
    fs::write(data.join("queue.redb"), b"no records at all").unwrap();
    let mut command = terrafarm();
    command.args(["coordinator", "--no-http", "--listen", "127.0.0.1:0", "--data"]).arg(&data);
    let (printed, said) = run(&mut command, 2);
    assert!(said.contains("queue.redb") && said.contains("move the file away"), "{said}");
    assert_eq!(printed, "", "nobody is told of a coordinator that does not serve");
}
