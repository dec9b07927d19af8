//! The coordinator's own limit: jobs a second with workers that sleep.
//!
//! `terrafarm coordinator` runs as a process of its own, as users start it; this process
//! is the client and all workers, each with a connection of its own over loopback. Jobs are
//! tiles of 8 x 8 pixels, so that bytes are not the limit. Time counts from the submission
//! to the last frame, as the coordinator says it; every pixel of every frame is checked.

use super::super::report::{digits, quantile, save, table};
use super::process;
use crate::commands::bench::land::Land;
use crate::commands::runtime;
use crate::{Outcome, args, files};
use anyhow::{Context, bail, ensure};
use glam::DVec3;
use serde::Serialize;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::FrameIndex;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Split;
use terrafarm_common::shading::Shading;
use terrafarm_coordinator::client::{self, Coordinator, Submission, Update};
use terrafarm_terrain::store::StoreReader;
use terrafarm_wire::message::ShotDone;
use terrafarm_worker::sleeper::{GREY, Sleeper, Slept};
use tokio::io::{AsyncBufReadExt, BufReader, Lines};
use tokio::process::{Child, ChildStdout, Command};
use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

/// Numbers of workers unless the user says others.
const WORKERS: [u32; 4] = [1, 10, 100, 1000];
/// Side of a job, pixels.
const TILE_PX: u32 = 8;
/// Most jobs along the sides of a frame: together as many as a frame may have.
const ACROSS: u32 = 128;
/// Frames that may be under way at once: enough jobs for the most workers and their queues.
const FRAMES_IN_FLIGHT: u32 = 6;
/// Jobs of the short form.
const SHORT_JOBS: u64 = 2_000;
/// Greetings at once: fewer than strangers that the system lets wait in line.
const GREETINGS: usize = 64;
/// How long the coordinator may take to start.
const START_LIMIT: Duration = Duration::from_secs(20);
/// Files open beside the connections.
const OTHER_FILES: u64 = 64;

/// What is written as JSON. Keys are promises.
#[derive(Debug, Serialize)]
struct Report {
    program: String,
    /// Threads that this PC runs at once.
    cores: usize,
    /// How long a worker sleeps for a job, milliseconds.
    job_ms: u64,
    /// Pixels of a job, bytes.
    bytes_per_job: u64,
    runs: Vec<Run>,
}

/// One number of workers.
#[derive(Debug, Serialize)]
struct Run {
    workers: u32,
    /// Jobs whose pixels were used ...
    jobs: u64,
    /// ... and those that were granted once more.
    jobs_repeated: u64,
    seconds: f64,
    jobs_per_s: f64,
    /// CPU time of the coordinator over wall time: 1 is one core. Absent where the system
    /// does not tell.
    coordinator_cores: Option<f64>,
    /// CPU time of the coordinator for a job, microseconds.
    coordinator_us_per_job: Option<f64>,
    /// CPU time of this process, which is the workers and the client.
    workers_cores: Option<f64>,
    /// From a result to the beginning of the worker's next job, milliseconds: 0 where one
    /// was in its queue.
    wait_ms_p50: f64,
    wait_ms_p99: f64,
    /// Share of the jobs that were in the worker's queue when the one before was done.
    queued: f64,
    /// Share of the time from a worker's first job to its last result with a job in hand.
    busy: f64,
}

/// Measures and prints.
pub fn run(args: &args::bench::BenchScaleOut) -> anyhow::Result<Outcome> {
    let counts = if args.workers.is_empty() { WORKERS.to_vec() } else { args.workers.clone() };
    let jobs = if args.short { args.jobs.min(SHORT_JOBS) } else { args.jobs };
    let most = u64::from(counts.iter().copied().max().unwrap_or(1));
    if let Some(files) = files::raise_open_files()
        && files < most + OTHER_FILES
    {
        bail!(
            "{most} connections need {} open files and the system allows {files}; raise its \
             limit (ulimit -Hn, LimitNOFILE=), or use fewer --workers",
            most + OTHER_FILES
        );
    }
    // Nobody looks at it: a submission has to name some terrain.
    let land = Land::noise(65)?;
    let store = Arc::new(land.store);
    let mut report = Report {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        cores: std::thread::available_parallelism().map_or(1, |cores| cores.get()),
        job_ms: args.job_ms,
        bytes_per_job: u64::from(TILE_PX * TILE_PX * 3),
        runs: Vec::new(),
    };
    let runtime = runtime()?;
    for workers in counts {
        let job = Duration::from_millis(args.job_ms);
        let run = runtime.block_on(measure(workers, job, jobs, store.clone()))?;
        eprintln!("terrafarm: {workers} workers: {} jobs/s", digits(run.jobs_per_s));
        report.runs.push(run);
        save(args.json.as_deref(), &report)?;
    }
    print!("{}", text(&report));
    Ok(Outcome::Done)
}

async fn measure(
    workers: u32,
    job: Duration,
    jobs: u64,
    store: Arc<StoreReader>,
) -> anyhow::Result<Run> {
    let Started { child: mut coordinator, address, says: _says } = start_coordinator().await?;
    let id = coordinator.id().context("the coordinator has ended")?;
    let fleet = connect(&address, workers, job).await?;
    let stop = CancellationToken::new();
    let mut sleeping = JoinSet::new();
    for sleeper in fleet {
        sleeping.spawn(sleeper.work(stop.clone()));
    }
    let cpu = || (process::cpu_s_of(id), process::own_cpu_s());
    let before = cpu();
    let done = submit(&address, submission(jobs, store)).await?;
    let after = cpu();
    stop.cancel();
    let mut slept = Vec::new();
    while let Some(ended) = sleeping.join_next().await {
        slept.push(ended.context("a sleeping worker failed")?.context("a worker was cut off")?);
    }
    let _ = coordinator.kill().await;
    ensure!(done.frames_failed == 0, "{} frames failed", done.frames_failed);
    let spent = |before: Option<f64>, after: Option<f64>| Some(after? - before?);
    Ok(Run::new(workers, &done, slept, spent(before.0, after.0), spent(before.1, after.1)))
}

impl Run {
    fn new(
        workers: u32,
        done: &ShotDone,
        slept: Vec<Slept>,
        coordinator_cpu_s: Option<f64>,
        own_cpu_s: Option<f64>,
    ) -> Self {
        let seconds = (done.elapsed_us as f64 * 1e-6).max(1e-6);
        let total =
            |of: fn(&Slept) -> Duration| slept.iter().map(|one| of(one).as_secs_f64()).sum::<f64>();
        let busy = total(|one| one.busy) / total(|one| one.span).max(1e-9);
        let mut waits_ms: Vec<f64> =
            slept.iter().flat_map(|one| &one.waits).map(|wait| wait.as_secs_f64() * 1e3).collect();
        let queued = waits_ms.iter().filter(|&&wait| wait == 0.0).count();
        Run {
            workers,
            jobs: done.jobs,
            jobs_repeated: done.jobs_repeated,
            seconds,
            jobs_per_s: done.jobs as f64 / seconds,
            coordinator_cores: coordinator_cpu_s.map(|cpu_s| cpu_s / seconds),
            coordinator_us_per_job: coordinator_cpu_s
                .map(|cpu_s| 1e6 * cpu_s / done.jobs.max(1) as f64),
            workers_cores: own_cpu_s.map(|cpu_s| cpu_s / seconds),
            queued: queued as f64 / waits_ms.len().max(1) as f64,
            wait_ms_p50: quantile(&mut waits_ms, 0.5),
            wait_ms_p99: quantile(&mut waits_ms, 0.99),
            busy,
        }
    }
}

/// A coordinator in a process of its own. It ends with this process.
struct Started {
    child: Child,
    address: String,
    /// What it prints; it would end if nobody listened.
    says: Lines<BufReader<ChildStdout>>,
}

async fn start_coordinator() -> anyhow::Result<Started> {
    let program = std::env::current_exe().context("cannot find this program's own file")?;
    let mut child = Command::new(&program)
        .args(["coordinator", "--listen", "127.0.0.1:0", "--no-http"])
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .kill_on_drop(true)
        .spawn()
        .with_context(|| format!("cannot start a coordinator from {}", program.display()))?;
    let says = child.stdout.take().context("the coordinator has no output")?;
    let mut says = BufReader::new(says).lines();
    let first = tokio::time::timeout(START_LIMIT, says.next_line())
        .await
        .context("the coordinator does not start")??;
    let address = first.as_deref().and_then(|line| line.strip_prefix("coordinator on "));
    let address = address.context("the coordinator does not say its address")?.to_owned();
    Ok(Started { child, address, says })
}

/// Greeted workers, as many at a time as the system lets wait.
async fn connect(address: &str, workers: u32, job: Duration) -> anyhow::Result<Vec<Sleeper>> {
    let gate = Arc::new(Semaphore::new(GREETINGS));
    let mut greeting = JoinSet::new();
    for number in 1..=u64::from(workers) {
        let (address, gate) = (address.to_owned(), gate.clone());
        greeting.spawn(async move {
            let _seat = gate.acquire().await;
            Sleeper::connect(&address, &format!("sleeper-{number}"), number, job).await
        });
    }
    let mut fleet = Vec::new();
    while let Some(greeted) = greeting.join_next().await {
        fleet.push(greeted.context("a greeting failed")?.context("a worker was not let in")?);
    }
    Ok(fleet)
}

/// At least so many jobs, in frames as alike as can be.
fn submission(jobs: u64, store: Arc<StoreReader>) -> Submission {
    let down = u64::from(ACROSS).min(jobs.div_ceil(u64::from(ACROSS)));
    let frames = jobs.div_ceil(u64::from(ACROSS) * down);
    let size = (ACROSS * TILE_PX, down as u32 * TILE_PX);
    let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, size);
    Submission {
        name: "scale-out".into(),
        store,
        shading: Shading::default(),
        quality: Quality { method: Method::Auto, samples_per_side: 1, tolerance_px: 1.0 },
        check: Share::NONE,
        split: Split::Tiles(TILE_PX),
        cameras: vec![camera; frames as usize],
        frames_in_flight: FRAMES_IN_FLIGHT,
        priority: 0,
        live: false,
    }
}

/// Renders a shot of grey frames and checks them.
async fn submit(address: &str, submission: Submission) -> anyhow::Result<ShotDone> {
    let (updates, mut inbox) = mpsc::channel(64);
    let (taken, taken_out) = mpsc::channel::<FrameIndex>(64);
    let checking = tokio::spawn(async move {
        let mut wrong = 0u64;
        while let Some(update) = inbox.recv().await {
            let index = match update {
                Update::Frame(index, picture, _) => {
                    wrong += u64::from(picture.pixels().iter().any(|&byte| byte != GREY));
                    index
                }
                Update::FrameFailed(index, _) => index,
                Update::Progress(_) | Update::Lost(_) => continue,
            };
            let _ = taken.send(index).await;
        }
        wrong
    });
    let stop = CancellationToken::new();
    let coordinator = Coordinator::local(address);
    let done = client::render(&coordinator, submission, updates, taken_out, stop).await?;
    let wrong = checking.await.context("the frames were not checked")?;
    ensure!(wrong == 0, "{wrong} frames are not what the workers sent");
    Ok(done)
}

fn text(report: &Report) -> String {
    let head = [
        "workers",
        "jobs/s",
        "coordinator cores",
        "us/job",
        "workers' cores",
        "wait ms p50",
        "p99",
        "queued %",
        "busy %",
        "repeated",
    ];
    let told = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), digits);
    let row = |run: &Run| {
        vec![
            run.workers.to_string(),
            digits(run.jobs_per_s),
            told(run.coordinator_cores),
            told(run.coordinator_us_per_job),
            told(run.workers_cores),
            digits(run.wait_ms_p50),
            digits(run.wait_ms_p99),
            digits(100.0 * run.queued),
            digits(100.0 * run.busy),
            run.jobs_repeated.to_string(),
        ]
    };
    let rows: Vec<_> = report.runs.iter().map(row).collect();
    let Report { cores, job_ms, bytes_per_job, .. } = report;
    table(&head, &rows)
        + &format!(
            "sleeping workers, {job_ms} ms and {bytes_per_job} bytes of pixels a job, over \
             loopback; {cores} cores, shared by coordinator and workers\nwait: from a result to \
             the worker's next job; queued: it was there already; busy: time with a job in hand\n"
        )
}
