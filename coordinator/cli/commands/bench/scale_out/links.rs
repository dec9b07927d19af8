//! A local network within one PC: a network namespace for each worker, joined by a bridge
//! over links of a given speed. Needs Linux, root, and the programs `ip` and `tc`.
//!
//! Each direction of each link has a token bucket of its own, as a switched network has.
//! What is made is named after this process and taken away with the value; what an earlier
//! run left is taken away at the start.

use anyhow::{Context, bail, ensure};
use std::path::Path;
use std::process::Command;

/// Bytes that may pass at once: what a link of a gigabit carries in a tick of the kernel.
const BURST: &str = "256kb";
/// How long a packet may wait before it is dropped.
const LATENCY: &str = "100ms";
/// Most workers on one bridge.
pub const WORKERS_MAX: u32 = 64;

/// The network.
pub struct Links {
    bridge: String,
    /// One a worker.
    namespaces: Vec<String>,
    /// Third byte of its addresses.
    subnet: u8,
    mbit: u32,
}

/// Bytes that went over all links so far.
#[derive(Debug, Clone, Copy)]
pub struct Carried {
    /// From the workers.
    pub up: u64,
    /// To the workers.
    pub down: u64,
}

impl Links {
    /// So many workers, each behind a link of so many megabits per second each way.
    ///
    /// # Errors
    /// If this is not Linux or not root, or `ip` or `tc` fails: what it said.
    pub fn build(workers: u32, mbit: u32) -> anyhow::Result<Links> {
        ensure!(workers <= WORKERS_MAX, "{workers} links are too many; at most {WORKERS_MAX}");
        sweep();
        let process = std::process::id();
        let subnet = (process % 200) as u8 + 20;
        // Names of links have at most 15 bytes.
        let bridge = format!("tfb{process}");
        let mut links = Links { bridge: bridge.clone(), namespaces: Vec::new(), subnet, mbit };
        run("ip", &format!("link add {bridge} type bridge"))
            .context("--link needs root on Linux, and the programs ip and tc")?;
        run("ip", &format!("addr add {}/24 dev {bridge}", links.hub()))?;
        run("ip", &format!("link set {bridge} up"))?;
        let rate = format!("tbf rate {mbit}mbit burst {BURST} latency {LATENCY}");
        for number in 0..workers {
            let (space, near) = (format!("tf{process}-{number}"), links.near(number));
            run("ip", &format!("netns add {space}"))?;
            links.namespaces.push(space.clone());
            run("ip", &format!("link add {near} type veth peer name eth0 netns {space}"))?;
            run("ip", &format!("link set {near} master {bridge} up"))?;
            let address = format!("10.77.{subnet}.{}", number + 10);
            run("ip", &format!("-n {space} addr add {address}/24 dev eth0"))?;
            run("ip", &format!("-n {space} link set eth0 up"))?;
            run("ip", &format!("-n {space} link set lo up"))?;
            run("tc", &format!("qdisc add dev {near} root {rate}"))?;
            run("tc", &format!("-n {space} qdisc add dev eth0 root {rate}"))?;
        }
        Ok(links)
    }

    /// The address of this PC that workers see.
    pub fn hub(&self) -> String {
        format!("10.77.{}.1", self.subnet)
    }

    /// The namespace of a worker, counted from 0.
    pub fn namespace(&self, worker: u32) -> Option<&str> {
        self.namespaces.get(worker as usize).map(String::as_str)
    }

    /// What all links together carry each way, bytes per second.
    pub fn bytes_per_s(&self, workers: u32) -> f64 {
        f64::from(self.mbit) * 1e6 / 8.0 * f64::from(workers)
    }

    /// Bytes so far, headers of packets included.
    ///
    /// # Errors
    /// If the kernel does not tell.
    pub fn carried(&self) -> anyhow::Result<Carried> {
        let mut sum = Carried { up: 0, down: 0 };
        for number in 0..self.namespaces.len() as u32 {
            let folder = format!("/sys/class/net/{}/statistics", self.near(number));
            let read = |name: &str| -> anyhow::Result<u64> {
                let path = Path::new(&folder).join(name);
                let text = std::fs::read_to_string(&path);
                let text = text.with_context(|| format!("cannot read {}", path.display()))?;
                text.trim().parse().with_context(|| format!("{} is no number", path.display()))
            };
            sum.up += read("rx_bytes")?;
            sum.down += read("tx_bytes")?;
        }
        Ok(sum)
    }

    fn near(&self, number: u32) -> String {
        format!("tf{}v{number}", std::process::id())
    }
}

impl Drop for Links {
    fn drop(&mut self) {
        for space in &self.namespaces {
            // Its link goes with it.
            let _ = run("ip", &format!("netns del {space}"));
        }
        let _ = run("ip", &format!("link del {}", self.bridge));
    }
}

/// Takes away what runs left that were killed.
fn sweep() {
    let is_gone = |process: &str| !Path::new("/proc").join(process).exists();
    for entry in std::fs::read_dir("/run/netns").into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let process = name.strip_prefix("tf").and_then(|rest| rest.split_once('-'));
        if process.is_some_and(|(process, number)| {
            is_number(process) && is_number(number) && is_gone(process)
        }) {
            let _ = run("ip", &format!("netns del {name}"));
        }
    }
    for entry in std::fs::read_dir("/sys/class/net").into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let process = name.strip_prefix("tfb");
        if process.is_some_and(|process| is_number(process) && is_gone(process)) {
            let _ = run("ip", &format!("link del {name}"));
        }
    }
}

fn is_number(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit())
}

/// Runs a program whose arguments have no blanks.
fn run(program: &str, arguments: &str) -> anyhow::Result<()> {
    let output = Command::new(program).args(arguments.split(' ')).output();
    let output = output.with_context(|| format!("cannot run {program}; is it installed?"))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        bail!("{program} {arguments}: {}", said.trim());
    }
    Ok(())
}
