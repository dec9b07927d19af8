//! Frames a second of 1, 2, 4, 8 ... worker processes, and where their time went.
//!
//! The farm is that of `terrafarm render` on one PC: a coordinator within this process and
//! workers as child processes of one thread each. One process of two threads is measured
//! beside them. All crews take turns, so that whatever else the PC does meets all of them;
//! of each, the run in the middle counts. A run begins when every worker has done a job of
//! a tiny shot over other terrain; its own is fetched anew. Frames stay in memory, and their SHA-256, taken
//! when the clock has stopped, must be the same for all crews.

use super::super::chart::{self, stack};
use super::super::report::{digits, save, table};
use super::account::Account;
use super::links::{Carried, Links};
use super::process;
use crate::commands::bench::land::{Land, Load};
use crate::commands::runtime;
use crate::farm::{Crew, LocalFarm, Recruit};
use crate::{Outcome, args};
use anyhow::{Context, bail, ensure};
use glam::DVec3;
use serde::Serialize;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};
use terrafarm_common::accuracy::Share;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::FrameIndex;
use terrafarm_common::image::Rgb8;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Split;
use terrafarm_common::shading::{Haze, Shading, Sky, Sun};
use terrafarm_coordinator::client::{self, Coordinator, Submission, Update};
use terrafarm_coordinator::sink;
use terrafarm_synth::SynthSpec;
use terrafarm_terrain::store::{StoreReader, hash_of};
use terrafarm_wire::link::{FarmToken, Trust};
use terrafarm_wire::message::ShotDone;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

/// Numbers of workers unless the user says others.
const WORKERS: [u32; 4] = [1, 2, 4, 8];
/// Most worker processes on one PC.
const WORKERS_MAX: u32 = 64;
/// Frames that may be under way at once.
const FRAMES_IN_FLIGHT: u32 = 3;
/// Most bytes of the frames that are kept until the clock has stopped.
const KEPT_BYTES_MAX: u64 = 2 << 30;
/// How long workers may take to join.
const JOIN_LIMIT: Duration = Duration::from_secs(60);
/// What is rendered: ground, and share of its side where the flight begins and ends.
const LAND: SynthSpec = SynthSpec { posts: 1025, spacing_m: 20.0, seed: 3, photo_scale: 2 };
const SHORT_LAND: SynthSpec = SynthSpec { posts: 257, spacing_m: 40.0, seed: 3, photo_scale: 1 };
const WAY: [f64; 2] = [0.15, 0.55];
const ABOVE_M: f64 = 400.0;
const CLEARED_M: f64 = 200.0;
const TOLERANCE_PX: f64 = 0.5;
/// Height of the camera over the yard, metres: above its noise.
const YARD_HEIGHT_M: f64 = 5_000.0;
/// The short form: long enough that a wait of a few milliseconds for a core is little of it.
const SHORT_SIZE: (u32, u32) = (160, 90);
const SHORT_FRAMES: u32 = 96;

/// What is written as JSON. Keys are promises.
#[derive(Debug, Serialize)]
pub struct Report {
    program: String,
    /// Threads that this PC runs at once.
    cores: usize,
    size: [u32; 2],
    frames: u32,
    method: &'static str,
    tolerance_px: f64,
    repeats: u32,
    /// SHA-256 of those of all frames; the same for all crews, or there is no report.
    sha256: String,
    /// Crews of one thread a worker, and one process of two threads.
    pub runs: Vec<Run>,
    /// Frames a second of two processes over those of two threads of one.
    two_processes_over_two_threads: Option<f64>,
}

/// One crew: the run in the middle of its repeats.
#[derive(Debug, Serialize)]
pub struct Run {
    /// Worker processes.
    pub workers: u32,
    /// Threads of each.
    pub threads: u32,
    seconds: f64,
    pub frames_per_s: f64,
    /// Frames a second over those of one worker of one thread.
    pub speed_up: f64,
    /// Speed-up over threads.
    pub efficiency: f64,
    /// Speed-up over threads, or over cores if there are fewer.
    pub core_efficiency: f64,
    jobs: u64,
    jobs_repeated: u64,
    /// CPU time of coordinator and client over wall time.
    coordinator_cores: Option<f64>,
    /// Shares of the workers' time.
    pub account: Account,
    /// How much of the links was used, if they have a limit.
    pub links: Option<LinkUse>,
    /// CPU time of all over what the cores of this PC have: 1 when they are the limit.
    cores_used: Option<f64>,
}

/// How much of the links between workers and coordinator was used.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct LinkUse {
    mbit_per_s: u32,
    /// Share of what all links together carry from the workers.
    pub up: f64,
    /// Share of what they carry to the workers.
    pub down: f64,
}

/// What a crew did once.
struct Pass {
    done: ShotDone,
    seconds: f64,
    cpu_s: Option<f64>,
    /// CPU time of everything on this PC.
    all_cpu_s: Option<f64>,
    links: Option<LinkUse>,
    sha256: String,
}

/// Measures and prints.
pub fn run(args: &args::bench::BenchScaleOut) -> anyhow::Result<Outcome> {
    let crews = crews(args)?;
    let (size, frames) = match args.short {
        true => (SHORT_SIZE, SHORT_FRAMES),
        false => (args.size, args.frames),
    };
    let kept = u64::from(size.0) * u64::from(size.1) * 3 * u64::from(frames);
    if kept > KEPT_BYTES_MAX {
        bail!(
            "{frames} frames take {} MiB of memory, and {} MiB is the most; fewer --frames will do",
            kept >> 20,
            KEPT_BYTES_MAX >> 20
        );
    }
    let land = land(args)?;
    let yard = Land::noise(65)?;
    let cameras = flight(&land, size, frames)?;
    let (store, yard) = (Arc::new(land.store), Arc::new(yard.store));
    let repeats = if args.short { 1 } else { args.repeats };
    let runtime = runtime()?;
    let mut passes: Vec<Vec<Pass>> = crews.iter().map(|_| Vec::new()).collect();
    for _ in 0..repeats {
        for (crew, passes) in crews.iter().zip(&mut passes) {
            let pass = runtime.block_on(fly(*crew, args.link, &yard, &store, &cameras))?;
            eprintln!(
                "terrafarm: {} x {} threads: {} frames/s",
                crew.workers,
                crew.threads,
                digits(f64::from(frames) / pass.seconds)
            );
            passes.push(pass);
        }
    }
    let report = judge(&crews, passes, size, frames, repeats)?;
    save(args.json.as_deref(), &report)?;
    print!("{}", text(&report));
    chart::save(&drawing(&report), args.svg.as_deref(), args.png.as_deref())?;
    Ok(Outcome::Done)
}

fn crews(args: &args::bench::BenchScaleOut) -> anyhow::Result<Vec<Crew>> {
    let counts = match (args.workers.is_empty(), args.short) {
        (true, true) => WORKERS[..2].to_vec(),
        (true, false) => WORKERS.to_vec(),
        (false, _) => args.workers.clone(),
    };
    if let Some(&many) = counts.iter().find(|&&count| count > WORKERS_MAX) {
        bail!("{many} worker processes are too many for one PC; at most {WORKERS_MAX}, or --fake");
    }
    let mut crews: Vec<Crew> =
        counts.into_iter().map(|workers| Crew { workers, threads: 1 }).collect();
    crews.push(Crew { workers: 1, threads: 2 });
    Ok(crews)
}

/// Eroded mountains with a photo, kept in a folder if one is named.
fn land(args: &args::bench::BenchScaleOut) -> anyhow::Result<Land> {
    let spec = if args.short { SHORT_LAND } else { LAND };
    let Some(folder) = &args.stores else { return Land::synth(spec) };
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let path = folder.join(format!("scale-out-{}.terrain", spec.posts));
    if StoreReader::open(&path).is_err() {
        write(&path, spec)?;
    }
    Land::open(&path, Load::Heights)
}

fn write(path: &Path, spec: SynthSpec) -> anyhow::Result<()> {
    terrafarm_synth::write_store(spec, path, &|_| (), &AtomicBool::new(false))?;
    Ok(())
}

/// Cameras along the diagonal of the land.
fn flight(land: &Land, size: (u32, u32), frames: u32) -> anyhow::Result<Vec<Camera>> {
    let at = |frame: u32| {
        let share = f64::from(frame) / f64::from(frames.max(2) - 1);
        land.at(WAY[0] + (WAY[1] - WAY[0]) * share)
    };
    let mut highest_m = f64::NEG_INFINITY;
    for frame in 0..frames {
        highest_m = highest_m.max(land.highest_around(at(frame), CLEARED_M)?);
    }
    let camera = |frame: u32| {
        let [x, y] = at(frame);
        let eye = DVec3::new(x, y, highest_m + ABOVE_M);
        Camera::from_angles(eye, 45.0, -14.0, 0.0, 60.0, size)
    };
    Ok((0..frames).map(camera).collect())
}

fn submission(store: &Arc<StoreReader>, cameras: Vec<Camera>, split: Split) -> Submission {
    Submission {
        name: "scale-out".into(),
        store: store.clone(),
        shading: Shading {
            sun: Some(Sun::at(315.0, 35.0, 0.35, 0.65)),
            haze: Some(Haze { visibility_m: 4e4, scale_height_m: 0.0, color: [0.72, 0.78, 0.86] }),
            sky: Sky::default(),
            earth: None,
            below_ground: [0.0; 3],
            bare_ground: None,
        },
        quality: Quality { method: Method::Auto, samples_per_side: 1, tolerance_px: TOLERANCE_PX },
        check: Share::NONE,
        split,
        cameras,
        frames_in_flight: FRAMES_IN_FLIGHT,
        priority: 0,
        live: false,
    }
}

/// One crew, from its start over the yard, where it gathers, to its end; the flight alone is
/// timed.
async fn fly(
    crew: Crew,
    link_mbit: Option<u32>,
    yard: &Arc<StoreReader>,
    store: &Arc<StoreReader>,
    cameras: &[Camera],
) -> anyhow::Result<Pass> {
    let links = link_mbit.map(|mbit| Links::build(crew.workers, mbit)).transpose()?;
    let farm = match &links {
        Some(links) => behind(links, crew).await?,
        None => LocalFarm::start(crew).await?,
    };
    let began = Instant::now();
    loop {
        let eye = DVec3::new(0.0, 0.0, YARD_HEIGHT_M);
        let tiny = Camera::from_angles(eye, 45.0, -30.0, 0.0, 60.0, (64, 64));
        let shot = submission(yard, vec![tiny; 2], Split::Tiles(8));
        let (done, _) = render(&farm.coordinator, shot).await?;
        if done.workers.len() as u32 >= crew.workers {
            break;
        }
        ensure!(began.elapsed() < JOIN_LIMIT, "not every worker joins; is this PC very busy?");
    }
    let before = links.as_ref().map(Links::carried).transpose()?;
    let (cpu, all_cpu) = (process::own_cpu_s(), process::all_cpu_s());
    let shot = submission(store, cameras.to_vec(), Split::Columns);
    let (done, frames) = render(&farm.coordinator, shot).await?;
    let cpu_s = cpu.zip(process::own_cpu_s()).map(|(before, after)| after - before);
    let all_cpu_s = all_cpu.zip(process::all_cpu_s()).map(|(before, after)| after - before);
    let after = links.as_ref().map(Links::carried).transpose()?;
    farm.stop().await;
    ensure!(frames.len() == cameras.len(), "{} frames failed", cameras.len() - frames.len());
    let hashes: Vec<u8> = frames.values().flat_map(|frame| sink::pixels_sha256(frame).0).collect();
    let seconds = (done.elapsed_us as f64 * 1e-6).max(1e-6);
    let links = links.zip(before.zip(after)).zip(link_mbit).map(
        |((links, (before, after)), mbit_per_s)| {
            let whole = links.bytes_per_s(crew.workers) * seconds;
            let share = |of: fn(Carried) -> u64| (of(after) - of(before)) as f64 / whole;
            LinkUse { mbit_per_s, up: share(|sum| sum.up), down: share(|sum| sum.down) }
        },
    );
    Ok(Pass { done, seconds, cpu_s, all_cpu_s, links, sha256: hash_of(&hashes).to_hex() })
}

/// A farm whose workers are each behind a link. They speak as in an office: encrypted, with
/// packed pixels. The client stays on this PC.
async fn behind(links: &Links, crew: Crew) -> anyhow::Result<LocalFarm> {
    let program = std::env::current_exe().context("cannot find this program's own file")?;
    let token = FarmToken::generate()?;
    let recruit = |number: u32, address: SocketAddr| {
        let space = links.namespace(number - 1).unwrap_or_default();
        let before = ["ip", "netns", "exec", space].map(OsString::from);
        let command = before.into_iter().chain([program.clone().into_os_string()]).collect();
        Recruit {
            command,
            coordinator: format!("{}:{}", links.hub(), address.port()),
            token: Some(token.clone()),
            name: format!("linked-{number}"),
            threads: crew.threads,
        }
    };
    LocalFarm::with(crew.workers, "0.0.0.0:0", Trust::Token(token.clone()), recruit).await
}

/// Renders a shot into memory.
async fn render(
    coordinator: &Coordinator,
    shot: Submission,
) -> anyhow::Result<(ShotDone, BTreeMap<FrameIndex, Rgb8>)> {
    let (updates, mut inbox) = mpsc::channel(16);
    let (taken, taken_out) = mpsc::channel(16);
    let keeping = tokio::spawn(async move {
        let mut frames = BTreeMap::new();
        while let Some(update) = inbox.recv().await {
            let index = match update {
                Update::Frame(index, picture, _) => {
                    frames.insert(index, picture);
                    index
                }
                Update::FrameFailed(index, why) => {
                    eprintln!("terrafarm: frame {index} failed: {why}");
                    index
                }
                Update::Progress(_) | Update::Lost(_) => continue,
            };
            let _ = taken.send(index).await;
        }
        frames
    });
    let stop = CancellationToken::new();
    let done = client::render(coordinator, shot, updates, taken_out, stop).await?;
    Ok((done, keeping.await.context("the frames were not kept")?))
}

/// Compares the crews; refuses if their frames differ or an account does not add up.
fn judge(
    crews: &[Crew],
    passes: Vec<Vec<Pass>>,
    size: (u32, u32),
    frames: u32,
    repeats: u32,
) -> anyhow::Result<Report> {
    let first = passes.iter().flatten().next().context("no crew was measured")?;
    let sha256 = first.sha256.clone();
    let same = passes.iter().flatten().all(|pass| pass.sha256 == sha256);
    ensure!(same, "crews of different size rendered different frames");
    let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
    let mut runs = Vec::new();
    for (crew, mut passes) in crews.iter().zip(passes) {
        passes.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
        let pass = passes.swap_remove(passes.len() / 2);
        let account = Account::of(&pass.done, crew.workers);
        ensure!(account.adds_up(), "the account does not add up: {account:?}");
        runs.push(Run {
            workers: crew.workers,
            threads: crew.threads,
            seconds: pass.seconds,
            frames_per_s: f64::from(frames) / pass.seconds,
            speed_up: 0.0,
            efficiency: 0.0,
            core_efficiency: 0.0,
            jobs: pass.done.jobs,
            jobs_repeated: pass.done.jobs_repeated,
            coordinator_cores: pass.cpu_s.map(|cpu_s| cpu_s / pass.seconds),
            account,
            links: pass.links,
            cores_used: pass.all_cpu_s.map(|cpu_s| cpu_s / pass.seconds / cores as f64),
        });
    }
    let of = |runs: &[Run], workers, threads| {
        let this = |run: &&Run| (run.workers, run.threads) == (workers, threads);
        runs.iter().find(this).map(|run| run.frames_per_s)
    };
    // Without a crew of one, the smallest stands for it, taken as perfect.
    let base = runs.iter().filter(|run| run.threads == 1).min_by_key(|run| run.workers);
    let one = base.map_or(1.0, |run| run.frames_per_s / f64::from(run.workers));
    for run in &mut runs {
        let threads = f64::from(run.workers * run.threads);
        run.speed_up = run.frames_per_s / one;
        run.efficiency = run.speed_up / threads;
        run.core_efficiency = run.speed_up / threads.min(cores as f64);
    }
    let two = of(&runs, 2, 1).zip(of(&runs, 1, 2)).map(|(two, threads)| two / threads);
    Ok(Report {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        cores,
        size: [size.0, size.1],
        frames,
        method: Method::Auto.name(),
        tolerance_px: TOLERANCE_PX,
        repeats,
        sha256,
        runs,
        two_processes_over_two_threads: two,
    })
}

fn drawing(report: &Report) -> chart::Drawing {
    let Report { size: [width, height], frames, cores, .. } = report;
    let title = chart::Title {
        main: "terrafarm: more workers, and where their time goes".into(),
        sub: format!("{frames} frames of {width} x {height}; workers of one thread; {cores} cores"),
    };
    let crew = |run: &Run| stack::Crew {
        label: run.name(),
        speed_up: run.speed_up,
        perfect: f64::from(run.workers * run.threads).min(*cores as f64),
        parts: run.account.parts().to_vec(),
    };
    let crews: Vec<_> = report.runs.iter().map(crew).collect();
    stack::draw(&title, &Account::NAMES, &crews)
}

impl Run {
    fn name(&self) -> String {
        match self.threads {
            1 => self.workers.to_string(),
            threads => format!("{} x {threads} threads", self.workers),
        }
    }
}

fn text(report: &Report) -> String {
    let mut head = vec!["workers", "frames/s", "speed-up", "efficiency %", "of cores %"];
    head.extend(Account::NAMES);
    let row = |run: &Run| {
        let mut cells = vec![
            run.name(),
            digits(run.frames_per_s),
            digits(run.speed_up),
            digits(100.0 * run.efficiency),
            digits(100.0 * run.core_efficiency),
        ];
        cells.extend(run.account.parts().map(|share| format!("{:.1}", 100.0 * share)));
        cells
    };
    let rows: Vec<_> = report.runs.iter().map(row).collect();
    let Report { cores, size: [width, height], frames, repeats, method, .. } = report;
    let mut text = table(&head, &rows)
        + &format!(
            "{frames} frames of {width} x {height} by {method}; workers of one thread unless said; \
             {cores} cores; the run in the middle of {repeats}\nfrom render on: percent of the \
             workers' time from the submission to the last frame; the same bytes from all\n"
        );
    for run in &report.runs {
        let Some(links) = run.links else { continue };
        text += &format!(
            "{} behind links of {} Mbit/s: {:.1} % of them used up to the coordinator, {:.1} % down; {} % \
             of the cores\n",
            run.name(),
            links.mbit_per_s,
            100.0 * links.up,
            100.0 * links.down,
            run.cores_used.map_or("?".into(), |used| digits(100.0 * used)),
        );
    }
    if let Some(two) = report.two_processes_over_two_threads {
        text += &format!("2 workers over 1 worker of 2 threads: {:.1} %\n", 100.0 * two);
    }
    text
}
