//! Terrain on a farm of real processes: workers that give it to each other spare the
//! coordinator's link, a cold cache that was damaged is mended, and no pixel changes.

use crate::support::{Running, World, frame_hashes, succeed, terrafarm};
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

const SIZE: [&str; 4] = ["--size", "192x108", "--fps", "4"];
const WORKERS: usize = 4;

/// Passes bytes between a worker and the coordinator and counts those that come to the
/// worker.
struct Cable {
    address: String,
    received: Arc<AtomicU64>,
}

impl Cable {
    fn to(coordinator: &str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let (target, received) = (coordinator.to_owned(), Arc::<AtomicU64>::default());
        let count = received.clone();
        std::thread::spawn(move || {
            let Ok((near, _)) = listener.accept() else { return };
            let far = TcpStream::connect(target).unwrap();
            let up = (near.try_clone().unwrap(), far.try_clone().unwrap(), Arc::default());
            for (mut from, mut to, count) in [up, (far, near, count)] {
                std::thread::spawn(move || {
                    let mut buffer = [0; 65536];
                    while let Ok(length @ 1..) = from.read(&mut buffer) {
                        count.fetch_add(length as u64, Ordering::Relaxed);
                        if to.write_all(&buffer[..length]).is_err() {
                            break;
                        }
                    }
                });
            }
        });
        Cable { address, received }
    }

    fn received(&self) -> u64 {
        self.received.load(Ordering::Relaxed)
    }
}

fn worker(address: &str, name: &str, cache: &Path, more: &[&str]) -> Running {
    Running::start(
        terrafarm()
            .args(["-vv", "worker", "--threads", "1", "--coordinator", address, "--name", name])
            .arg("--cache-dir")
            .arg(cache)
            .args(more),
    )
}

fn coordinator() -> (Running, String) {
    let mut running = Running::start(terrafarm().args([
        "-v",
        "coordinator",
        "--listen",
        "127.0.0.1:0",
        "--share-above",
        "0",
    ]));
    let line = running.expect("coordinator on ");
    let address = line.rsplit(' ').next().unwrap().to_owned();
    (running, address)
}

/// Renders the world on a farm of which every worker takes part, and says how many bytes
/// each was sent by the coordinator.
fn render(world: &World, name: &str, share: &[&str]) -> (Vec<String>, Vec<u64>) {
    let (_coordinator, address) = coordinator();
    let mut workers = Vec::new();
    for number in 0..WORKERS {
        let cable = Cable::to(&address);
        let cache = world.dir.path(&format!("{name}-cache-{number}"));
        let running = worker(&cable.address, &format!("{name}-{number}"), &cache, share);
        workers.push((running, cable));
    }
    for (running, _) in &mut workers {
        running.expect("connected");
    }
    let output = world.dir.path(name);
    let mut command = world.render();
    command.args(SIZE).args(["--split", "tiles:24", "--coordinator", &address, "-o"]).arg(&output);
    succeed(&mut command);
    let received = workers.iter().map(|(_, cable)| cable.received()).collect();
    (frame_hashes(&output.join("manifest.json")), received)
}

#[test]
fn workers_that_give_terrain_to_each_other_spare_the_coordinators_link() {
    let world = World::new(1500);
    let calm = world.dir.path("calm");
    succeed(world.render().args(SIZE).args(["--workers", "1", "-o"]).arg(&calm));
    let calm = frame_hashes(&calm.join("manifest.json"));
    let (alone, sent_alone) = render(&world, "alone", &["--no-share"]);
    let (shared, sent_shared) = render(&world, "shared", &["--share-port", "0"]);
    assert_eq!((&alone, &shared), (&calm, &calm));
    let [sum_alone, sum_shared] = [&sent_alone, &sent_shared].map(|sent| sent.iter().sum::<u64>());
    println!("sent by the coordinator: {sent_alone:?} alone, {sent_shared:?} shared");
    assert!(sum_shared * 3 < sum_alone * 2, "{sum_shared} of {sum_alone} bytes");
}

#[test]
fn tiles_that_were_damaged_on_disk_are_fetched_again() {
    let world = World::new(1500);
    let (_coordinator, address) = coordinator();
    let cache = world.dir.path("cache");
    let mut results = Vec::new();
    for run in ["first", "second"] {
        let mut running = worker(&address, run, &cache, &[]);
        running.expect("connected");
        let output = world.dir.path(run);
        let mut command = world.render();
        command.args(SIZE).args(["--coordinator", &address, "-o"]).arg(&output);
        succeed(&mut command);
        results.push(frame_hashes(&output.join("manifest.json")));
        drop(running);
        let files: Vec<_> =
            std::fs::read_dir(&cache).unwrap().map(|file| file.unwrap().path()).collect();
        assert!(files.len() > 2, "the cache is used");
        for file in files {
            let mut bytes = std::fs::read(&file).unwrap();
            let middle = bytes.len() / 2;
            bytes[middle] ^= 1;
            std::fs::write(&file, bytes).unwrap();
        }
    }
    assert_eq!(results[0], results[1]);
}

/// Renders with one worker whose cache stops taking anything once it is connected; every line
/// that the worker said.
fn render_without_disk(
    world: &World,
    name: &str,
    cache: &Path,
    break_disk: impl Fn(),
) -> Vec<String> {
    let (mut coordinator, address) = coordinator();
    let mut worker = worker(&address, "pc-1", cache, &["--once"]);
    worker.expect("connected");
    break_disk();
    let output = world.dir.path(name);
    succeed(world.render().args(SIZE).args(["--coordinator", &address, "-o"]).arg(&output));
    let calm = world.dir.path("calm");
    if !calm.exists() {
        succeed(world.render().args(SIZE).args(["--workers", "1", "-o"]).arg(&calm));
    }
    let hashes = [&output, &calm].map(|folder| frame_hashes(&folder.join("manifest.json")));
    assert_eq!(hashes[0], hashes[1]);
    coordinator.kill();
    worker.finish().1
}

#[test]
fn a_disk_that_takes_nothing_costs_one_warning_and_no_frame() {
    let world = World::new(1500);
    let warnings =
        |lines: &[String]| lines.iter().filter(|l| l.contains("terrain is not kept")).count();
    let cache = world.dir.path("cache");
    let lines = render_without_disk(&world, "gone", &cache, || {
        std::fs::remove_dir_all(&cache).unwrap();
        std::fs::write(&cache, "no folder").unwrap();
    });
    assert_eq!(warnings(&lines), 1, "{lines:#?}");
    let unkept = lines.iter().filter(|line| line.contains("a terrain blob was not kept"));
    assert!(unkept.count() > 3, "there was more than one blob");
}

/// A file system that goes away with the test.
#[cfg(target_os = "linux")]
struct Mounted(std::path::PathBuf);

#[cfg(target_os = "linux")]
impl Mounted {
    /// One in memory, of so many bytes; `None` where this user may make none.
    fn new(folder: &Path, options: &str) -> Option<Self> {
        std::fs::create_dir(folder).unwrap();
        let mut mount = std::process::Command::new("mount");
        let done = mount.args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(folder).output();
        done.is_ok_and(|done| done.status.success()).then(|| Mounted(folder.to_owned()))
    }

    fn is_read_only_from_now_on(&self) {
        let mut mount = std::process::Command::new("mount");
        succeed(mount.args(["-o", "remount,ro"]).arg(&self.0));
    }
}

#[cfg(target_os = "linux")]
impl Drop for Mounted {
    fn drop(&mut self) {
        let _ = std::process::Command::new("umount").arg("--lazy").arg(&self.0).output();
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_and_one_that_may_not_be_written_cost_one_warning_and_no_frame() {
    let world = World::new(1500);
    for (name, options) in [("full", "size=64k"), ("read-only", "size=64m")] {
        let cache = world.dir.path(&format!("{name}-cache"));
        let Some(disk) = Mounted::new(&cache, options) else {
            println!("skipped: only root mounts disks");
            return;
        };
        let lines = render_without_disk(&world, name, &cache, || {
            if name == "read-only" {
                disk.is_read_only_from_now_on();
            }
        });
        let said = lines.iter().filter(|line| line.contains("terrain is not kept"));
        let said: Vec<_> = said.collect();
        assert!(
            matches!(said[..], [line] if line.contains("is there space")),
            "{name}: {lines:#?}"
        );
        let left = std::fs::read_dir(&cache).unwrap().count();
        println!("{name}: {left} files are there");
    }
}
