//! A farm with a token, and those who try to get in without it or to stop it.

use crate::support::{Dir, Running, World, frame_hashes, run, succeed, terrafarm};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;
use terrafarm_wire::link::{FarmToken, greet};
use terrafarm_wire::message::{Hello, Ping, Role};

const SIZE: [&str; 4] = ["--size", "192x108", "--fps", "4"];
const PATIENCE: Duration = Duration::from_secs(60);

/// A coordinator that made its token, where that is kept, and the line for workers.
struct Guarded {
    _running: Running,
    address: String,
    token_file: PathBuf,
    worker_line: String,
}

fn guarded(dir: &Dir) -> Guarded {
    let token_file = dir.path("farm.token");
    let mut running = Running::start(
        terrafarm()
            .args(["-v", "coordinator", "--listen", "127.0.0.1:0", "--no-http", "--token-file"])
            .arg(&token_file),
    );
    let address = running.expect("coordinator on ").rsplit(' ').next().unwrap().to_owned();
    let line = running.expect("start workers with:");
    let worker_line = line.split_once(':').unwrap().1.trim().to_owned();
    Guarded { _running: running, address, token_file, worker_line }
}

impl Guarded {
    /// A worker by the line that the coordinator printed, and some settings.
    fn worker(&self, name: &str) -> Running {
        let mut words = self.worker_line.split(' ');
        assert_eq!(words.next(), Some("terrafarm"));
        Running::start(terrafarm().arg("-vv").args(words).args([
            "--threads",
            "1",
            "--cache-limit",
            "0",
            "--name",
            name,
        ]))
    }

    fn render(&self, world: &World, output: &Path) -> Command {
        let mut render = world.render();
        render.args(SIZE).args(["--split", "tiles:32", "--coordinator", &self.address]);
        render.arg("--token-file").arg(&self.token_file).arg("-o").arg(output);
        render
    }

    fn token(&self) -> FarmToken {
        std::fs::read_to_string(&self.token_file).unwrap().parse().unwrap()
    }
}

/// Does something again and again, in a thread of its own, until told to stop.
struct Attack {
    stop: Arc<AtomicBool>,
    done: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Attack {
    fn start(mut once: impl FnMut() + Send + 'static) -> Self {
        let (stop, done) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let (stopped, count) = (stop.clone(), done.clone());
        let thread = std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                once();
                count.fetch_add(1, Ordering::Relaxed);
            }
        });
        Attack { stop, done, thread: Some(thread) }
    }

    /// Ends it; says how often it was done.
    fn end(mut self) -> u64 {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
        self.done.load(Ordering::Relaxed)
    }
}

/// All that a coordinator answers to some bytes; empty if it only closes.
fn answer(address: &str, bytes: &[u8]) -> Vec<u8> {
    let mut peer = TcpStream::connect(address).unwrap();
    peer.set_read_timeout(Some(PATIENCE)).unwrap();
    // It may close before everything is written.
    let _ = peer.write_all(bytes);
    let _ = peer.shutdown(std::net::Shutdown::Write);
    let mut answer = Vec::new();
    let _ = peer.read_to_end(&mut answer);
    answer
}

#[test]
fn the_printed_line_starts_a_worker_and_the_picture_is_that_of_a_local_farm() {
    let world = World::new(300);
    let farm = guarded(&world.dir);
    let calm = world.dir.path("calm");
    succeed(world.render().args(SIZE).args(["--workers", "1", "-o"]).arg(&calm));
    let mut worker = farm.worker("good");
    worker.expect("connected");
    let output = world.dir.path("farm");
    succeed(&mut farm.render(&world, &output));
    let hashes = |folder: &Path| frame_hashes(&folder.join("manifest.json"));
    assert_eq!(hashes(&output), hashes(&calm));
}

#[test]
fn who_has_not_the_token_is_told_what_to_do_and_gets_nothing() {
    let world = World::new(40);
    let farm = guarded(&world.dir);
    let worker = |args: &[&str]| {
        let mut command = terrafarm();
        run(command.args(["worker", "--coordinator", &farm.address]).args(args), 2).1
    };
    let said = worker(&[]);
    assert!(said.contains("terrafarm token"), "no token: {said}");
    let said = worker(&["--plain"]);
    assert!(said.contains("terrafarm token"), "plain: {said}");
    let other = world.dir.path("other.token");
    succeed(terrafarm().args(["token", "--token-file"]).arg(&other));
    let said = worker(&["--token-file", other.to_str().unwrap()]);
    assert!(said.contains("does not accept the farm token"), "wrong token: {said}");
    let mut render = world.render();
    render.args(["--coordinator", &farm.address, "--token-file"]).arg(&other);
    let said = run(render.arg("-o").arg(world.dir.path("out")), 2).1;
    assert!(said.contains("does not accept the farm token"), "{said}");
    let own = farm.token().to_text();
    assert!(!said.contains(&own));
}

#[test]
fn a_worker_with_a_token_sends_nothing_to_a_farm_without() {
    let dir = Dir::new();
    let (_coordinator, address) = crate::support::coordinator();
    let file = dir.path("farm.token");
    succeed(terrafarm().args(["token", "--token-file"]).arg(&file));
    let mut worker = terrafarm();
    let said =
        run(worker.args(["worker", "--coordinator", &address, "--token-file"]).arg(&file), 2).1;
    assert!(said.contains("has no farm token") && said.contains("--plain"), "{said}");
}

#[test]
fn a_token_is_entered_on_another_pc_and_a_second_one_does_not_replace_it() {
    let dir = Dir::new();
    let file = dir.path("here.token");
    let text = succeed(terrafarm().args(["token", "--token-file"]).arg(dir.path("there.token")));
    let typed = dir.write("typed", text.to_lowercase().replace('-', " "));
    let enter = |typed: &Path| {
        let mut command = terrafarm();
        command.args(["token", "--enter", "--token-file"]).arg(&file);
        command.stdin(std::fs::File::open(typed).unwrap());
        command
    };
    succeed(&mut enter(&typed));
    succeed(&mut enter(&typed));
    assert_eq!(succeed(terrafarm().args(["token", "--token-file"]).arg(&file)), text);
    let other = succeed(terrafarm().args(["token", "--token-file"]).arg(dir.path("third.token")));
    let said = run(&mut enter(&dir.write("typed", other)), 2).1;
    assert!(said.contains("another farm"), "{said}");
}

#[test]
fn garbage_versions_lies_and_vast_lengths_are_refused_alike() {
    let dir = Dir::new();
    let farm = guarded(&dir);
    let refusal = answer(&farm.address, b"GET / HTTP/1.1\r\nHost: farm\r\n\r\n");
    assert!(refusal.starts_with(b"TFRM"));
    let mut vast = terrafarm_wire::frame::MAGIC.to_vec();
    vast.extend([0xff; 60]);
    let noise: Vec<u8> =
        (0..4096u32).map(|n| (n.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let opening = [b"TFRS\x01\0", &noise[..48]].concat();
    for bytes in [&vast[..], &noise, &opening, &[opening.clone(), noise.clone()].concat()] {
        assert_eq!(answer(&farm.address, bytes), refusal);
    }
    let version = answer(&farm.address, b"TFRS\xff\xff and whatever comes with it");
    assert!(version.starts_with(b"TFRM") && version != refusal);
    assert!(answer(&farm.address, b"TFRS").is_empty(), "one that hangs up is not answered");
}

/// A peer of the farm that says far more than anyone has to, and does not listen.
fn flood_from_inside(address: &str, token: &FarmToken) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let stream = tokio::net::TcpStream::connect(address).await.unwrap();
        let hello = Hello::new("flood", Role::Client);
        let Ok((mut link, _)) = greet(stream, Some(token), hello, PATIENCE).await else { return };
        for number in 0..50_000 {
            if link.send(&Ping { number }.into()).await.is_err() {
                return;
            }
        }
    });
}

#[test]
fn a_good_worker_joins_and_renders_undisturbed_while_others_flood_and_dawdle() {
    let world = World::new(300);
    let calm = world.dir.path("calm");
    succeed(world.render().args(SIZE).args(["--workers", "1", "-o"]).arg(&calm));
    let farm = guarded(&world.dir);
    // More silent peers than there are places for strangers.
    let dawdlers: Vec<_> = (0..300)
        .map(|number| {
            let mut peer = TcpStream::connect(&farm.address).unwrap();
            peer.write_all(&b"TFRS\x01\0and"[..number % 10]).unwrap();
            peer
        })
        .collect();
    let address = farm.address.clone();
    let garbage = Attack::start(move || drop(answer(&address, &[0xa5; 1 << 16])));
    let (address, mut held) = (farm.address.clone(), std::collections::VecDeque::new());
    let silent = Attack::start(move || {
        held.extend(TcpStream::connect(&address));
        if held.len() > 200 {
            held.pop_front();
        }
    });
    let (address, token) = (farm.address.clone(), farm.token());
    let inside = Attack::start(move || flood_from_inside(&address, &token));

    let mut good = farm.worker("good");
    good.expect("connected");
    let output = world.dir.path("farm");
    let render = Running::start(&mut farm.render(&world, &output));
    good.expect("job begins");
    let (code, lines) = render.finish();
    for attack in [garbage, silent, inside] {
        assert!(attack.end() > 0, "it did take place");
    }
    drop(dawdlers);
    assert_eq!(code, Some(0), "{lines:#?}");
    let manifest = output.join("manifest.json");
    assert_eq!(frame_hashes(&manifest), frame_hashes(&calm.join("manifest.json")));
    let manifest: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(manifest).unwrap()).unwrap();
    let workers = manifest["workers"].as_array().unwrap();
    assert_eq!(workers.len(), 1, "the link was never lost: {workers:?}");
}
