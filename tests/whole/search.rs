//! Workers that were told nothing but the token find their coordinator by multicast DNS, on
//! a network of namespaces: quickly, the right one, and again after it has moved.

use crate::namespaces::{Office, address, available};
use crate::support::{Dir, PATIENCE, Running, World, succeed, terrafarm};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// How often it is measured how long a worker takes to its first job.
const RUNS: usize = 10;

/// A coordinator on a PC, by the name that it is announced as.
fn coordinator(office: &Office, pc: usize, name: &str, token: &Path) -> Running {
    let mut command = terrafarm();
    command.args(["-v", "coordinator", "--no-http", "--listen", "0.0.0.0:7070", "--token-file"]);
    let mut running = Running::start(&mut office.on(pc, command.arg(token).env("HOSTNAME", name)));
    running.expect("coordinator on ");
    running
}

/// A worker on a PC; without an address it searches.
fn worker(office: &Office, pc: usize, token: &Path, settings: &[&str]) -> Running {
    let mut command = terrafarm();
    command.args(["-vv", "worker", "--threads", "1", "--cache-limit", "0", "--token-file"]);
    Running::start(&mut office.on(pc, command.arg(token).args(settings)))
}

/// A render that outlasts every test.
fn render(office: &Office, world: &World, token: &Path) -> Running {
    let mut command: Command = world.render();
    command.args(["--size", "1280x720", "--fps", "500", "--samples", "4", "--token-file"]);
    command.arg(token).args(["--coordinator", &format!("{}:7070", address(0)), "-o"]);
    Running::start(&mut office.on(0, command.arg(world.dir.path("frames"))))
}

fn tokens<const N: usize>(dir: &Dir) -> [PathBuf; N] {
    std::array::from_fn(|n| {
        let path = dir.path(&format!("{n}.token"));
        let mut made = terrafarm();
        succeed(made.args(["token", "--token-file"]).arg(&path));
        path
    })
}

/// Times from the start of a worker to its first job, shortest first.
fn first_jobs(start: impl Fn() -> Running) -> Vec<Duration> {
    let run = |_| {
        let since = Instant::now();
        let mut worker = start();
        worker.expect("job begins");
        since.elapsed()
    };
    let mut times: Vec<_> = (0..RUNS).map(run).collect();
    times.sort();
    times
}

#[test]
fn a_worker_has_its_first_job_in_a_second_and_finds_its_coordinator_by_itself() {
    if !available() {
        return;
    }
    let world = World::new(300);
    let office = Office::new(3);
    let [token] = tokens(&world.dir);
    let mut farm = coordinator(&office, 0, "tower", &token);
    let _render = render(&office, &world, &token);
    farm.expect("shot submitted");
    let there = format!("{}:7070", address(0));
    let told = first_jobs(|| worker(&office, 1, &token, &["--coordinator", &there]));
    // One after the other: what is multicast comes once a second at most, and for one of them.
    let searched = first_jobs(|| worker(&office, 2, &token, &[]));
    for (how, times) in [("told where", &told), ("by multicast", &searched)] {
        println!("first job, {how}: median {:?}, longest {:?}", times[RUNS / 2], times[RUNS - 1]);
        assert!(times[RUNS / 2] <= Duration::from_secs(1), "{how}: {times:?}");
    }
}

#[test]
fn the_farm_of_ones_own_token_is_found_beside_others_and_of_two_the_lower_name() {
    if !available() {
        return;
    }
    let dir = Dir::new();
    let office = Office::new(4);
    let [ours, theirs] = tokens(&dir);
    let _strangers = coordinator(&office, 0, "aaa", &theirs);
    let mut early = worker(&office, 3, &ours, &["--name", "early"]);
    early.expect("does not accept the farm token");
    let mut second = coordinator(&office, 1, "zebra", &ours);
    let found = early.expect("found a coordinator");
    assert!(found.contains(&address(1)) && found.contains("(zebra-7070)"), "{found}");
    second.expect("name=early");
    let mut first = coordinator(&office, 2, "mole", &ours);
    // It asks whether its name is free before it answers to it.
    let deadline = Instant::now() + PATIENCE;
    let found = loop {
        let found = worker(&office, 3, &ours, &["--name", "late"]).expect("found a coordinator");
        if found.contains("mole") || Instant::now() > deadline {
            break found;
        }
    };
    let of_first = format!("found a coordinator at {}:7070 (mole-7070)", address(2));
    assert!(found.contains(&of_first), "{found}");
    let of_second = format!("{}:7070 (zebra-7070)", address(1));
    assert!(found.contains(&of_second) && found.contains("--coordinator HOST:PORT"), "{found}");
    assert!(!found.contains("aaa"), "{found}");
    first.expect("name=late");
}

#[test]
fn a_coordinator_that_moves_to_another_pc_is_found_there() {
    if !available() {
        return;
    }
    let dir = Dir::new();
    let office = Office::new(3);
    let [token] = tokens(&dir);
    let mut before = coordinator(&office, 0, "tower", &token);
    let mut worker = worker(&office, 2, &token, &[]);
    let found = worker.expect("found a coordinator");
    assert!(found.contains(&address(0)), "{found}");
    before.expect("worker joined");
    before.kill();
    worker.expect("no connection to the coordinator");
    let mut after = coordinator(&office, 1, "attic", &token);
    let since = Instant::now();
    after.expect("worker joined");
    println!("joined {:?} after the coordinator was up at its new place", since.elapsed());
    let found = worker.expect("found a coordinator");
    assert!(found.contains(&address(1)) && found.contains("(attic-7070)"), "{found}");
}
