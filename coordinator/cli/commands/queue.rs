//! Commands that ask a coordinator's API: what is in its queue, who works, and orders.
//!
//! They come by the link of the farm, with its token; `docs/API.md` has what they ask for.

mod fetch;
mod submit;

pub use fetch::run as fetch;
pub use submit::run as submit;

use super::bench::report::{digits, table};
use super::runtime;
use crate::args::queue as args;
use crate::{Outcome, secret};
use anyhow::{Context, bail};
use bytes::Bytes;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::json;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use terrafarm_coordinator::ask::{Answer, Line, Turn};
use terrafarm_coordinator::view::{ShotView, WorkerView};
use terrafarm_wire::link::Trust;
use terrafarm_wire::message::Verb;

/// Entries of a list that are asked for at once.
const PAGE: usize = 1000;

/// How long a coordinator that is there and has no time is asked again, and one that was
/// there and has gone.
const TURN_LIMIT: Duration = Duration::from_secs(600);

/// A line to a coordinator, and how to open another one.
struct Desk {
    address: String,
    trust: Trust,
    turn: Arc<Turn>,
    line: Line,
}

impl Desk {
    async fn open(office: &args::Office) -> anyhow::Result<Self> {
        let trust = secret::to_connect(&office.security)?;
        let address = office.coordinator.clone();
        let turn = Arc::new(Turn::new(TURN_LIMIT, |why| eprintln!("terrafarm: {why}")));
        let line = Line::open_in_turn(&address, &trust, &turn).await?;
        Ok(Desk { address, trust, turn, line })
    }

    /// One more line to the same coordinator, if it has a place for one now.
    async fn another(&self) -> anyhow::Result<Option<Line>> {
        match Line::open(&self.address, &self.trust).await {
            Err(why) if why.is_full() => Ok(None),
            opened => Ok(Some(opened?)),
        }
    }

    /// Asks for what does no more when it is asked twice.
    async fn ask(&mut self, verb: Verb, path: &str, body: Bytes) -> anyhow::Result<Answer> {
        Ok(self.line.ask_again(verb, path, None, body, &self.turn).await?)
    }

    async fn get<T: DeserializeOwned>(&mut self, path: &str) -> anyhow::Result<T> {
        read(&self.ask(Verb::Get, path, Default::default()).await?)
    }

    /// Gives an order and prints what came of it.
    async fn order(
        &mut self,
        verb: Verb,
        path: &str,
        body: serde_json::Value,
    ) -> anyhow::Result<Outcome> {
        #[derive(Deserialize)]
        struct Done {
            done: String,
        }
        let body = if body.is_null() { Default::default() } else { body.to_string().into() };
        let Done { done } = read(&self.line.ask(verb, path, None, body).await?)?;
        say(&done)
    }

    /// Every entry of a list, page after page.
    async fn list<T: DeserializeOwned>(
        &mut self,
        key: &str,
        state: &str,
    ) -> anyhow::Result<Vec<T>> {
        let mut all = Vec::new();
        loop {
            let path =
                format!("/api/v1/{key}?state={}&offset={}&limit={PAGE}", query(state)?, all.len());
            let mut page: serde_json::Value = self.get(&path).await?;
            let total = page["total"].as_u64().unwrap_or(0) as usize;
            let some: Vec<T> = serde_json::from_value(page[key].take())
                .context("the coordinator's list is odd")?;
            let last = some.len() < PAGE;
            all.extend(some);
            if last || all.len() >= total {
                return Ok(all);
            }
        }
    }

    /// A worker by its number or its name.
    async fn worker(&mut self, called: &str) -> anyhow::Result<WorkerView> {
        let workers: Vec<WorkerView> = self.list("workers", "").await?;
        let number = called.strip_prefix("worker-").unwrap_or(called).parse().ok();
        let fits = |worker: &WorkerView| number == Some(worker.id.0) || worker.name == called;
        let mut found = workers.into_iter().filter(fits);
        match (found.next(), found.next()) {
            (Some(worker), None) => Ok(worker),
            (Some(one), Some(other)) => {
                bail!("{called} is the name of {} and of {}; say a number", one.id, other.id)
            }
            (None, _) => {
                bail!(
                    "no worker is called {called}; \"terrafarm workers\" lists those that are connected"
                )
            }
        }
    }
}

/// What stands in an answer.
fn read<T: DeserializeOwned>(answer: &Answer) -> anyhow::Result<T> {
    serde_json::from_slice(&answer.body)
        .context("the coordinator's answer is not understood; is it of the same version?")
}

/// A list of states as a part of an address: nothing else has a place there.
fn query(text: &str) -> anyhow::Result<&str> {
    if text.chars().all(|symbol| symbol.is_ascii_lowercase() || symbol == ',') {
        return Ok(text);
    }
    bail!("--state {text:?}: write names of states with commas, such as running,paused")
}

fn say(text: &str) -> anyhow::Result<Outcome> {
    print_line!("{text}");
    Ok(Outcome::Done)
}

/// `terrafarm shots`
pub fn shots(args: &args::Shots) -> anyhow::Result<Outcome> {
    runtime()?.block_on(async {
        let mut desk = Desk::open(&args.office).await?;
        let shots: Vec<ShotView> = match args.shot {
            Some(shot) => vec![desk.get(&format!("/api/v1/shots/{shot}")).await?],
            None => desk.list("shots", &args.state).await?,
        };
        if args.json {
            let json =
                if args.shot.is_some() { json!(shots[0]) } else { json!({ "shots": shots }) };
            return say(&serde_json::to_string_pretty(&json).context("cannot print JSON")?);
        }
        if shots.is_empty() {
            return say("no shots");
        }
        let head = ["shot", "state", "priority", "frames", "frames/s", "left", "name"];
        let rows: Vec<_> = shots.iter().map(shot_row).collect();
        say(table(&head, &rows).trim_end())?;
        if args.shot.is_some() {
            let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
            for past in shots.iter().flat_map(|shot| &shot.history) {
                let ago = duration(now.saturating_sub(past.at_s) as f64);
                say(&printable(&format!("{ago} ago: {}", past.what)))?;
            }
        }
        Ok(Outcome::Done)
    })
}

fn shot_row(shot: &ShotView) -> Vec<String> {
    let failed = match shot.frames_failed {
        0 => String::new(),
        failed => format!(", {failed} failed"),
    };
    let note = if shot.note.is_empty() { String::new() } else { format!(" ({})", shot.note) };
    vec![
        shot.id.0.to_string(),
        shot.state.name().to_owned(),
        shot.priority.to_string(),
        format!("{}/{}{failed}", shot.frames_done, shot.frames),
        if shot.state.is_over() { "-".into() } else { digits(shot.frames_per_s) },
        shot.eta_s.map_or_else(|| "-".into(), duration),
        printable(&format!("{}{note}", shot.name)),
    ]
}

/// `terrafarm workers`
pub fn workers(args: &args::Workers) -> anyhow::Result<Outcome> {
    runtime()?.block_on(async {
        let mut desk = Desk::open(&args.office).await?;
        let workers: Vec<WorkerView> = desk.list("workers", &args.state).await?;
        if args.json {
            let json = json!({ "workers": workers });
            return say(&serde_json::to_string_pretty(&json).context("cannot print JSON")?);
        }
        if workers.is_empty() {
            return say("no workers");
        }
        let head = [
            "worker",
            "state",
            "threads",
            "speed",
            "renders",
            "jobs",
            "rendering %",
            "memory MB",
            "disk MB",
            "name",
        ];
        let rows: Vec<_> = workers.iter().map(worker_row).collect();
        say(table(&head, &rows).trim_end())
    })
}

fn worker_row(worker: &WorkerView) -> Vec<String> {
    let state = if worker.distrusted { "distrusted" } else { worker.state.name() };
    let job = worker.job.map(|job| format!("{} frame {}", job.shot, job.frame));
    let blocked: Vec<_> = worker.blocked.iter().map(ToString::to_string).collect();
    let blocked = match blocked.is_empty() {
        true => String::new(),
        false => format!(" (blocked for {})", blocked.join(", ")),
    };
    let damaged = match worker.cache.map_or(0, |cache| cache.damaged) {
        0 => String::new(),
        damaged => format!(" ({damaged} blobs were damaged)"),
    };
    vec![
        worker.id.0.to_string(),
        state.to_owned(),
        match worker.threads_allowed {
            allowed if allowed < worker.threads => format!("{allowed} of {}", worker.threads),
            _ => worker.threads.to_string(),
        },
        digits(worker.speed),
        job.unwrap_or_else(|| "-".into()),
        match worker.jobs_failed {
            0 => worker.jobs_done.to_string(),
            failed => format!("{}, {failed} failed", worker.jobs_done),
        },
        digits(100.0 * worker.rendering),
        worker.cache.map_or_else(|| "-".into(), |cache| megabytes(cache.memory_bytes)),
        worker.cache.map_or_else(|| "-".into(), |cache| megabytes(cache.disk_bytes)),
        printable(&format!("{}{damaged}{blocked}", worker.name)),
    ]
}

fn megabytes(bytes: u64) -> String {
    (bytes as f64 / 1e6).round().to_string()
}

/// A text of a stranger on a terminal: nothing in it moves the cursor or ends the line.
fn printable(text: &str) -> String {
    text.chars().map(|symbol| if symbol.is_control() { '\u{fffd}' } else { symbol }).collect()
}

fn duration(seconds: f64) -> String {
    let s = seconds.round().clamp(0.0, 1e12) as u64;
    match s {
        0..60 => format!("{s} s"),
        60..3600 => format!("{} min {} s", s / 60, s % 60),
        _ => format!("{} h {} min", s / 3600, s % 3600 / 60),
    }
}

/// `terrafarm pause`, `resume`, `cancel`
pub fn one_shot(args: &args::OneShot, order: &str) -> anyhow::Result<Outcome> {
    runtime()?.block_on(async {
        let mut desk = Desk::open(&args.office).await?;
        let path = format!("/api/v1/shots/{}/{order}", args.shot);
        desk.order(Verb::Post, &path, serde_json::Value::Null).await
    })
}

/// `terrafarm priority`
pub fn priority(args: &args::Priority) -> anyhow::Result<Outcome> {
    runtime()?.block_on(async {
        let mut desk = Desk::open(&args.office).await?;
        let path = format!("/api/v1/shots/{}/priority", args.shot);
        desk.order(Verb::Put, &path, json!({"priority": args.priority})).await
    })
}

/// `terrafarm clear`
pub fn clear(args: &args::Clear) -> anyhow::Result<Outcome> {
    runtime()?.block_on(async {
        let mut desk = Desk::open(&args.office).await?;
        let worker = desk.worker(&args.worker).await?;
        let path = match args.shot {
            Some(shot) => format!("/api/v1/shots/{shot}/workers/{}/unblock", worker.id.0),
            None => format!("/api/v1/workers/{}/clear", worker.id.0),
        };
        desk.order(Verb::Post, &path, serde_json::Value::Null).await
    })
}

/// `terrafarm drain`
pub fn drain(args: &args::Drain) -> anyhow::Result<Outcome> {
    runtime()?.block_on(async {
        let mut desk = Desk::open(&args.office).await?;
        let worker = desk.worker(&args.worker).await?;
        let path = format!("/api/v1/workers/{}/drain", worker.id.0);
        desk.order(Verb::Post, &path, serde_json::Value::Null).await
    })
}

/// `terrafarm why`
pub fn why(args: &args::Why) -> anyhow::Result<Outcome> {
    #[derive(Deserialize)]
    struct Why {
        why: String,
    }
    runtime()?.block_on(async {
        let mut desk = Desk::open(&args.office).await?;
        let path = format!("/api/v1/shots/{}/frames/{}/why", args.shot, args.frame);
        let Why { why } = desk.get(&path).await?;
        say(&printable(&format!("frame {}: {why}", args.frame)))
    })
}
