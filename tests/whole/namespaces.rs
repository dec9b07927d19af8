//! A farm of several PCs within one: network namespaces joined by a bridge, a link for each.
//! Links go down and come up, and workers give terrain to each other; how they find their
//! coordinator is in `search`. Needs Linux, root, and the programs `ip` and `tc`; says so and skips
//! without them, unless `TERRAFARM_REQUIRE_ORACLES` is set.
//!
//! With `TERRAFARM_LONG` set, the long cut lasts 30 s instead of 8 s.

use crate::support::{Dir, PATIENCE, Running, World, frame_hashes, run, succeed, terrafarm};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// The namespace of the coordinator; workers have those from 1.
const COORDINATOR: usize = 0;
const PORT: u16 = 7070;
/// After this long without a byte either side takes the other for lost.
const SILENCE: Duration = Duration::from_secs(5);

/// Whether networks can be made here; says so if not.
pub fn available() -> bool {
    let user = Command::new("id").arg("-u").output().unwrap();
    if user.stdout != b"0\n" {
        println!("skipped: network namespaces need root");
        return false;
    }
    if !has_capabilities() {
        println!(
            "skipped: this root may not make networks, as in a container without CAP_NET_ADMIN"
        );
        return false;
    }
    let probe = format!("{}probe", next_name());
    let try_out = || -> Result<(), String> {
        ip(&format!("netns add {probe}"))?;
        ip(&format!("netns del {probe}"))?;
        Command::new("tc").arg("-V").output().map(drop).map_err(|why| format!("tc: {why}"))
    };
    match try_out() {
        Ok(()) => true,
        Err(why) => {
            let required = std::env::var_os("TERRAFARM_REQUIRE_ORACLES").is_some();
            assert!(!required, "{why}");
            println!("skipped: {why}");
            false
        }
    }
}

/// Whether this process may make networks, and mount what names them.
fn has_capabilities() -> bool {
    const NET_ADMIN: u64 = 1 << 12;
    const SYS_ADMIN: u64 = 1 << 21;
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let held = status.lines().find_map(|line| line.strip_prefix("CapEff:")).unwrap();
    let held = u64::from_str_radix(held.trim(), 16).unwrap();
    held & (NET_ADMIN | SYS_ADMIN) == NET_ADMIN | SYS_ADMIN
}

/// What names of namespaces and links begin with, another for every test: tests run at once.
fn next_name() -> String {
    static NAMES: AtomicU32 = AtomicU32::new(0);
    format!("tw{}-{}", std::process::id(), NAMES.fetch_add(1, Ordering::Relaxed))
}

/// Runs `ip` with arguments that have no blanks.
fn ip(arguments: &str) -> Result<(), String> {
    let output = Command::new("ip").args(arguments.split(' ')).output();
    let output = output.map_err(|why| format!("ip: {why}"))?;
    let said = String::from_utf8_lossy(&output.stderr);
    output.status.success().then_some(()).ok_or(format!("ip {arguments}: {}", said.trim()))
}

/// PCs on a switch. Goes away with the test, after those that run there, and also where it
/// fails; what a killed run left is taken away by the next.
pub struct Office {
    /// See [`next_name`]; at most 12 bytes, since names of links have at most 15.
    name: String,
    pcs: usize,
}

impl Office {
    pub fn new(pcs: usize) -> Self {
        sweep();
        let mut office = Office { name: next_name(), pcs: 0 };
        // The switch has no address: nothing else on this PC is part of the network.
        ip(&format!("link add {} type bridge", office.switch())).unwrap();
        ip(&format!("link set {} up", office.switch())).unwrap();
        for pc in 0..pcs {
            let (space, port) = (office.space(pc), office.port(pc));
            office.pcs += 1;
            ip(&format!("netns add {space}")).unwrap();
            ip(&format!("link add {port} type veth peer name eth0 netns {space}")).unwrap();
            ip(&format!("link set {port} master {} up", office.switch())).unwrap();
            ip(&format!("-n {space} addr add {}/24 dev eth0", address(pc))).unwrap();
            ip(&format!("-n {space} link set eth0 up")).unwrap();
            ip(&format!("-n {space} link set lo up")).unwrap();
        }
        office
    }

    fn switch(&self) -> String {
        format!("{}s", self.name)
    }

    fn space(&self, pc: usize) -> String {
        format!("{}n{pc}", self.name)
    }

    fn port(&self, pc: usize) -> String {
        format!("{}p{pc}", self.name)
    }

    /// Pulls the plug of a PC, or puts it in again.
    fn plug(&self, pc: usize, state: &str) {
        ip(&format!("link set {} {state}", self.port(pc))).unwrap();
    }

    /// Bytes that a PC has sent and received, headers of packets included.
    fn sent_and_received(&self, pc: usize) -> [u64; 2] {
        // What the switch receives, the PC sent.
        ["rx_bytes", "tx_bytes"].map(|counter| {
            let port = self.port(pc);
            let text =
                std::fs::read_to_string(format!("/sys/class/net/{port}/statistics/{counter}"));
            text.unwrap().trim().parse().unwrap()
        })
    }

    /// A command as it runs on a PC: in its place, with what it was given.
    pub fn on(&self, pc: usize, command: &Command) -> Command {
        let mut there = Command::new("ip");
        there.args(["netns", "exec", &self.space(pc)]).arg(command.get_program());
        there.args(command.get_args()).stdin(std::process::Stdio::null());
        for (name, value) in command.get_envs() {
            match value {
                Some(value) => there.env(name, value),
                None => there.env_remove(name),
            };
        }
        there
    }
}

impl Drop for Office {
    fn drop(&mut self) {
        for pc in 0..self.pcs {
            // Its link goes with it.
            let _ = ip(&format!("netns del {}", self.space(pc)));
        }
        let _ = ip(&format!("link del {}", self.switch()));
    }
}

/// The address of a PC.
pub fn address(pc: usize) -> String {
    format!("10.78.0.{}", pc + 1)
}

/// Takes away what tests left that were killed.
fn sweep() {
    let is_left = |name: &str| {
        let process = name.strip_prefix("tw").and_then(|rest| rest.split_once('-'));
        process.is_some_and(|(process, _)| {
            process.parse::<u32>().is_ok() && !Path::new("/proc").join(process).exists()
        })
    };
    for (folder, kind) in [("/run/netns", "netns"), ("/sys/class/net", "link")] {
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let name = entry.file_name().into_string().unwrap_or_default();
            if is_left(&name) {
                let _ = ip(&format!("{kind} del {name}"));
            }
        }
    }
}

/// An office with a coordinator on its first PC and a token that all PCs have.
struct Farm {
    // Goes before the office does.
    coordinator: Running,
    token: PathBuf,
    office: Office,
}

impl Farm {
    fn new(dir: &Dir, name: &str, workers: usize, settings: &[&str]) -> Self {
        let office = Office::new(workers + 1);
        let token = dir.path(&format!("{name}.token"));
        let mut command = terrafarm();
        let listen = format!("0.0.0.0:{PORT}");
        command.args(["-v", "coordinator", "--no-http", "--listen", &listen]).args(settings);
        command.arg("--token-file").arg(&token);
        let mut coordinator = Running::start(&mut office.on(COORDINATOR, &command));
        coordinator.expect("coordinator on ");
        Farm { coordinator, token, office }
    }

    fn address(&self) -> String {
        format!("{}:{PORT}", address(COORDINATOR))
    }

    /// A worker on a PC that is told where the coordinator is.
    fn worker(&self, pc: usize, settings: &[&str]) -> Running {
        self.worker_that_searches(pc, &[&["--coordinator", &self.address()], settings].concat())
    }

    /// A worker on a PC that is told nothing but the token.
    fn worker_that_searches(&self, pc: usize, settings: &[&str]) -> Running {
        let mut command = terrafarm();
        command.args(["-vv", "worker", "--threads", "1", "--name", &format!("pc-{pc}")]);
        command.arg("--token-file").arg(&self.token).args(settings);
        Running::start(&mut self.office.on(pc, &command))
    }

    /// A render that is asked for on the coordinator's PC.
    fn render(&self, world: &World, settings: &[&str], output: &Path) -> Command {
        let mut command = world.render();
        command.args(settings).args(["--coordinator", &self.address(), "--token-file"]);
        self.office.on(COORDINATOR, command.arg(&self.token).arg("-o").arg(output))
    }
}

/// The frames of a render that nothing disturbs.
fn calm(world: &World, settings: &[&str]) -> Vec<String> {
    let output = world.dir.path("calm");
    succeed(world.render().args(settings).args(["--workers", "2", "-o"]).arg(&output));
    frame_hashes(&output.join("manifest.json"))
}

/// Both ends take the other for lost before a link comes back that was gone for so long: the
/// worker throws away what it had in hand, and nothing late arrives.
#[test]
fn a_worker_whose_link_is_cut_is_missed_in_6_seconds_and_comes_back_by_itself() {
    if !available() {
        return;
    }
    let long = std::env::var_os("TERRAFARM_LONG").is_some();
    let (cut, fps) =
        if long { (Duration::from_secs(30), "24") } else { (Duration::from_secs(8), "8") };
    let world = World::new(300);
    let settings = ["--size", "640x360", "--split", "tiles:64", "--fps", fps];
    let calm = calm(&world, &settings);
    let mut farm = Farm::new(&world.dir, "farm", 2, &["--no-announce"]);
    // Links so slow that the shot outlasts the cut however fast this PC is.
    let slow = ["--cache-limit", "0", "--bandwidth", "2"];
    let mut one = farm.worker(1, &slow);
    let mut two = farm.worker(2, &slow);
    one.expect("connected");
    two.expect("connected");
    let output = world.dir.path("farm");
    let render = Running::start(&mut farm.render(&world, &settings, &output));
    for _ in 0..5 {
        one.expect("job begins");
    }
    farm.office.plug(1, "down");
    let since = Instant::now();
    let lost = farm.coordinator.expect("worker dropped");
    let noticed = since.elapsed();
    assert!(lost.contains("silent") && lost.contains("pc-1"), "{lost}");
    one.expect("no connection to the coordinator");
    let noticed_there = since.elapsed();
    // The length of the cut is what is tested; nothing waits for a state here.
    std::thread::sleep(cut.saturating_sub(since.elapsed()));
    farm.office.plug(1, "up");
    let since = Instant::now();
    let joined = farm.coordinator.expect("worker joined");
    let back = since.elapsed();
    assert!(joined.contains("pc-1"), "{joined}");
    assert!(!output.join("manifest.json").exists(), "all of it happened in mid-shot");
    one.expect("job begins");
    let working = since.elapsed();
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(frame_hashes(&output.join("manifest.json")), calm);
    println!(
        "cut for {cut:?}: missed after {noticed:?}, the worker knew after {noticed_there:?}, \
         back {back:?} after the link, with its first job after {working:?}"
    );
    let limit = SILENCE + Duration::from_secs(1);
    assert!(noticed >= SILENCE - Duration::from_secs(1) && noticed <= limit, "{noticed:?}");
    // Two seconds to its next attempt, two for one that began too early, and what a busy PC takes.
    assert!(working <= Duration::from_secs(5), "{working:?}");
}

/// The connection outlives the cut, and so does what was sent into it.
#[test]
fn what_a_short_cut_held_up_is_done_by_others_and_refused_when_it_comes() {
    if !available() {
        return;
    }
    let world = World::new(300);
    let settings =
        ["--size", "640x360", "--split", "tiles:64", "--fps", "4", "--frames-in-flight", "1"];
    let calm = calm(&world, &settings);
    let mut farm = Farm::new(&world.dir, "farm", 2, &["--no-announce"]);
    let slow = ["--cache-limit", "0", "--bandwidth", "3"];
    let mut one = farm.worker(1, &slow);
    let mut two = farm.worker(2, &slow);
    one.expect("connected");
    two.expect("connected");
    let output = world.dir.path("farm");
    let render = Running::start(&mut farm.render(&world, &settings, &output));
    for _ in 0..5 {
        one.expect("job begins");
    }
    farm.office.plug(1, "down");
    // The length of the cut is what is tested; nothing waits for a state here.
    std::thread::sleep(SILENCE / 2);
    farm.office.plug(1, "up");
    let since = Instant::now();
    let refused = farm.coordinator.expect("late result refused");
    println!("refused {:?} after the link: {refused}", since.elapsed());
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(frame_hashes(&output.join("manifest.json")), calm);
}

/// A render by workers on four PCs: its frames, bytes that the coordinator's PC sent, and
/// bytes that the PC of each worker received.
fn by_four(world: &World, name: &str, share: &[&str]) -> (Vec<String>, u64, Vec<u64>) {
    const SETTINGS: [&str; 6] = ["--size", "192x108", "--fps", "4", "--split", "tiles:24"];
    let farm = Farm::new(&world.dir, name, 4, &["--no-announce", "--share-above", "0"]);
    let mut workers = Vec::new();
    for pc in 1..=4 {
        let cache = world.dir.path(&format!("{name}-cache-{pc}"));
        let settings = [&["--cache-dir", cache.to_str().unwrap()], share].concat();
        workers.push(farm.worker(pc, &settings));
    }
    for worker in &mut workers {
        worker.expect("connected");
    }
    let output = world.dir.path(name);
    succeed(&mut farm.render(world, &SETTINGS, &output));
    let [sent, _] = farm.office.sent_and_received(COORDINATOR);
    let received = (1..=4).map(|pc| farm.office.sent_and_received(pc)[1]).collect();
    (frame_hashes(&output.join("manifest.json")), sent, received)
}

#[test]
fn workers_on_other_pcs_give_terrain_to_each_other_with_the_token() {
    if !available() {
        return;
    }
    let world = World::new(1500);
    let calm = calm(&world, &["--size", "192x108", "--fps", "4"]);
    let (alone, sent_alone, received_alone) = by_four(&world, "alone", &["--no-share"]);
    let (shared, sent_shared, received_shared) = by_four(&world, "shared", &[]);
    println!("sent by the coordinator's PC: {sent_alone} alone, {sent_shared} shared");
    println!("received by each: {received_alone:?} alone, {received_shared:?} shared");
    assert_eq!((&alone, &shared), (&calm, &calm));
    assert!(sent_shared * 3 < sent_alone * 2, "{sent_shared} of {sent_alone} bytes");
}

/// Namespaces and links of a bench, by the number of its process.
fn left_by_bench(process: u32) -> Vec<String> {
    let entries = ["/run/netns", "/sys/class/net"].into_iter().flat_map(std::fs::read_dir);
    let names =
        entries.flatten().flatten().filter_map(|entry| entry.file_name().into_string().ok());
    let number = process.to_string();
    let is_its = |name: &String| {
        let rest = name.strip_prefix("tfb").or_else(|| name.strip_prefix("tf"));
        let rest = rest.and_then(|rest| rest.strip_prefix(&number));
        rest.is_some_and(|rest| !rest.starts_with(|c: char| c.is_ascii_digit()))
    };
    names.filter(is_its).collect()
}

#[test]
fn the_bench_with_links_reports_them_and_leaves_no_network_even_after_kill_9() {
    if !available() {
        return;
    }
    let dir = Dir::new();
    let report = dir.path("links.json");
    let bench = || {
        let mut command = terrafarm();
        command.args(["bench", "scale-out", "--link", "100", "--workers", "2", "--short"]);
        command.arg("--json").arg(&report);
        command
    };
    let mut killed = Running::start(&mut bench());
    let process = killed.id();
    let deadline = Instant::now() + PATIENCE;
    // Two namespaces, two links, a bridge: its network is whole.
    while left_by_bench(process).len() < 5 {
        assert!(Instant::now() < deadline, "no network: {:?}", left_by_bench(process));
        std::thread::sleep(Duration::from_millis(20));
    }
    killed.kill();
    assert_eq!(left_by_bench(process).len(), 5, "nobody has taken it away");

    let second = Running::start(&mut bench());
    let next = second.id();
    let (code, lines) = second.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(left_by_bench(process), [""; 0]);
    assert_eq!(left_by_bench(next), [""; 0]);
    let report: serde_json::Value =
        serde_json::from_slice(&std::fs::read(&report).unwrap()).unwrap();
    for run in report["runs"].as_array().unwrap() {
        let links = &run["links"];
        println!("{} workers, {} threads: {links}", run["workers"], run["threads"]);
        for way in ["up", "down"] {
            let share = links[way].as_f64().unwrap();
            assert!(share > 0.0, "{run}");
        }
        assert_eq!(links["mbit_per_s"], 100);
    }
    // A link that cannot be is refused, and nothing was made for it.
    run(bench().args(["--link", "0"]), 2);
}
