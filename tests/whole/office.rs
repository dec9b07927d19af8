//! A coordinator with a queue and a page, and all that asks it: commands, HTTP, streams of
//! events; and a crowd that fills it.

use crate::support::{Dir, PATIENCE, Running, World, succeed, terrafarm};
use glam::DVec3;
use std::io::{BufRead, BufReader, Lines, Read, Write};
use std::net::TcpStream;
use std::process::Command;
use std::time::{Duration, Instant};
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Split;
use terrafarm_common::shading::Shading;
use terrafarm_coordinator::ask::Line;
use terrafarm_coordinator::queue::{ShotPlan, Source};
use terrafarm_terrain::store::StoreReader;
use terrafarm_wire::link::Trust;
use terrafarm_wire::message::Verb;
use terrafarm_worker::sleeper::Sleeper;
use tokio_util::sync::CancellationToken;

/// How large the frames are, and how many a second.
pub const SIZE: [&str; 4] = ["--size", "192x108", "--fps", "4"];

/// A coordinator with a queue and a page.
pub struct Office {
    _running: Running,
    /// Where workers and commands connect.
    pub address: String,
    /// Where HTTP is.
    pub http: String,
}

/// Starts one with its queue in this folder.
pub fn office(dir: &Dir, more: &[&str]) -> Office {
    let mut running = Running::start(
        terrafarm()
            .args(["-v", "coordinator", "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"])
            .arg("--data")
            .arg(dir.path("queue"))
            .args(more),
    );
    let address = running.expect("coordinator on ").rsplit(' ').next().unwrap().to_owned();
    let line = running.expect("look at it:");
    let http = line.split("http://").nth(1).unwrap().split('/').next().unwrap().to_owned();
    Office { _running: running, address, http }
}

impl Office {
    /// A command that asks this coordinator.
    pub fn ask(&self, words: &[&str]) -> Command {
        let mut command = terrafarm();
        command.args(words).args(["--coordinator", &self.address]);
        command
    }

    /// Submits a world's flight; returns the number of the shot.
    pub fn submit(&self, world: &World, more: &[&str]) -> u64 {
        let mut submit = self.ask(&["submit"]);
        submit.arg(&world.scene).arg("--flight").arg(&world.flight).args(SIZE).args(more);
        succeed(&mut submit).trim().parse().unwrap()
    }

    pub fn get(&self, path: &str) -> Reply {
        http(&self.http, "GET", path, &[], b"")
    }

    pub fn json(&self, path: &str) -> serde_json::Value {
        let reply = self.get(path);
        assert_eq!(reply.status, 200, "{path}: {}", reply.text());
        reply.json()
    }

    /// Asks until something holds of an answer: again whenever an event says that something
    /// has changed.
    pub fn wait(
        &self,
        path: &str,
        holds: impl Fn(&serde_json::Value) -> bool,
    ) -> serde_json::Value {
        let deadline = Instant::now() + PATIENCE;
        // Before the first question, so that no change is missed.
        let mut events = Events::open(&self.http, "");
        loop {
            let answer = self.json(path);
            if holds(&answer) {
                return answer;
            }
            assert!(Instant::now() < deadline, "{path} stays {answer}");
            events.read();
        }
    }
}

/// An answer by HTTP.
pub struct Reply {
    pub status: u16,
    pub head: String,
    pub body: Vec<u8>,
}

impl Reply {
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    pub fn json(&self) -> serde_json::Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|_| panic!("no JSON: {}", self.text()))
    }

    pub fn header(&self, name: &str) -> Option<&str> {
        let lines = self.head.lines().filter_map(|line| line.split_once(": "));
        lines.into_iter().find(|(key, _)| key.eq_ignore_ascii_case(name)).map(|(_, value)| value)
    }
}

/// One request over a connection of its own. `more` may replace the `Host`.
pub fn http(address: &str, method: &str, path: &str, more: &[(&str, &str)], body: &[u8]) -> Reply {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut request = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
    if !more.iter().any(|(name, _)| *name == "Host") {
        request += &format!("Host: {address}\r\n");
    }
    for (name, value) in more {
        request += &format!("{name}: {value}\r\n");
    }
    if !body.is_empty() {
        request += &format!("Content-Length: {}\r\n", body.len());
    }
    stream.write_all(format!("{request}\r\n").as_bytes()).unwrap();
    // It may refuse before everything is written.
    let _ = stream.write_all(body);
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n").expect("an answer") + 4;
    let head = String::from_utf8_lossy(&answer[..end]).into_owned();
    let status = head.split(' ').nth(1).and_then(|word| word.parse().ok()).expect("a status");
    let mut body = answer.split_off(end);
    if head.to_lowercase().contains("transfer-encoding: chunked") {
        body = unchunk(&body);
    }
    Reply { status, head, body }
}

fn unchunk(mut bytes: &[u8]) -> Vec<u8> {
    let mut whole = Vec::new();
    while let Some(end) = bytes.windows(2).position(|two| two == b"\r\n") {
        let length =
            usize::from_str_radix(std::str::from_utf8(&bytes[..end]).unwrap(), 16).unwrap();
        if length == 0 {
            break;
        }
        whole.extend_from_slice(&bytes[end + 2..end + 2 + length]);
        bytes = &bytes[end + 2 + length + 2..];
    }
    whole
}

/// A stream of events.
pub struct Events {
    lines: Lines<BufReader<TcpStream>>,
    name: String,
}

impl Events {
    /// Asks for one.
    pub fn open(address: &str, query: &str) -> Self {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        write!(stream, "GET /api/v1/events?{query} HTTP/1.1\r\nHost: {address}\r\n\r\n").unwrap();
        Events { lines: BufReader::new(stream).lines(), name: String::new() }
    }

    /// Waits for the next one: its name and what it says.
    pub fn read(&mut self) -> (String, serde_json::Value) {
        loop {
            let line = self.lines.next().expect("the stream goes on").unwrap();
            assert!(!line.starts_with("HTTP/1.1 5"), "{line}");
            if let Some(text) = line.strip_prefix("event: ") {
                self.name = text.to_owned();
            } else if let Some(text) = line.strip_prefix("data: ") {
                return (self.name.clone(), serde_json::from_str(text).unwrap());
            }
        }
    }
}

/// A stream of events, and what it says first.
pub fn first_events(address: &str, query: &str) -> (Vec<(String, serde_json::Value)>, Events) {
    let mut events = Events::open(address, query);
    ((0..3).map(|_| events.read()).collect(), events)
}

/// Fills an office: so many shots, so many workers that sleep over their first job.
pub async fn crowd(office: &Office, world: &World, shots: u32, workers: u64) -> CancellationToken {
    let first = office.submit(world, &["--name", "first"]);
    let cancel = format!("/api/v1/shots/{first}/cancel");
    assert_eq!(http(&office.http, "POST", &cancel, &[], b"").status, 200);
    let store = StoreReader::open(&world.dir.path("land.terrain")).unwrap();
    let mut line = Line::open(&office.address, &Trust::Loopback).await.unwrap();
    for number in 0..shots {
        let body = serde_json::to_vec(&tiny(&store, number)).unwrap();
        line.ask(Verb::Post, "/api/v1/shots", None, body.into()).await.unwrap();
    }
    let stop = CancellationToken::new();
    for number in 1..=workers {
        let name = format!("sleeper-{number}");
        let job = Duration::from_secs(3600);
        let sleeper = Sleeper::connect(&office.address, &name, number, job).await.unwrap();
        tokio::spawn(sleeper.work(stop.clone()));
    }
    stop
}

/// A shot of one small frame over a store that the coordinator has.
pub fn tiny(store: &StoreReader, number: u32) -> ShotPlan {
    let size = (64, 36);
    let camera = Camera::from_angles(DVec3::new(900.0, 900.0, 2000.0), 0.0, -20.0, 0.0, 60.0, size);
    ShotPlan {
        name: format!("shot number {number}"),
        priority: 0,
        index: store.index_blob().0,
        shading: Shading::default(),
        quality: Quality { method: Method::Auto, samples_per_side: 1, tolerance_px: 1.0 },
        check: Share::NONE,
        size: [size.0, size.1],
        split: Split::Columns,
        fps: 25.0,
        first_frame: 0,
        cameras: vec![camera],
        frames_in_flight: 3,
        film: None,
        source: Source::default(),
    }
}
