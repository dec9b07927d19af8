//! Measurements, as typed: `terrafarm bench ...` and `terrafarm simulate`.

use crate::input::scene::parse_size;
use crate::input::{parse_method, parse_tolerance};
use clap::{Args as ClapArgs, Subcommand};
use std::path::PathBuf;
use terrafarm_common::quality::{Method, Quality};

/// `terrafarm bench ...`
#[derive(Debug, Subcommand)]
pub enum Bench {
    /// Speed of the methods on one core, every answer checked
    Core(BenchCore),
    /// Finished frames a second of this process alone, over a flight
    Flight(BenchFlight),
    /// Time against error: all methods and settings over procedural and real terrain
    SpeedAccuracy(BenchSpeedAccuracy),
    /// Cost of a frame, and of its terrain in memory, over ever larger terrain on disk
    TerrainSize(BenchTerrainSize),
    /// What more worker processes bring on this PC, and where their time goes
    ScaleOut(BenchScaleOut),
    /// Situations in which methods are known to fail, by every method that may be asked
    Stability(BenchStability),
}

/// `terrafarm bench core`
#[derive(Debug, ClapArgs)]
pub struct BenchCore {
    /// Store to look at [default: noise of 2 km relief, made for the bench]
    #[arg(long, value_name = "STORE")]
    pub terrain: Option<PathBuf>,
    /// Flight whose keyframes are the cameras, CSV [default: horizon, down30, down80, rolled45]
    #[arg(long, value_name = "CSV")]
    pub flight: Option<PathBuf>,
    /// Size of the picture
    #[arg(long, value_parser = parse_size, value_name = "WxH", default_value = "1920x1080")]
    pub size: (u32, u32),
    /// Posts along a side of the terrain that is made; several with commas
    #[arg(long, value_delimiter = ',', default_value = "4097", conflicts_with = "terrain",
        value_parser = clap::value_parser!(u32).range(65..=32_769))]
    pub posts: Vec<u32>,
    /// Methods, with commas
    #[arg(long, value_delimiter = ',', default_value = "exact,lod,column,frustum,voxel",
        value_parser = parse_method)]
    pub methods: Vec<Method>,
    /// Tolerance of the methods that have one, pixels
    #[arg(long, value_name = "PX", value_parser = parse_tolerance,
        default_value_t = Quality::DEFAULT_TOLERANCE_PX)]
    pub tolerance: f64,
    /// Timed runs of each case, of which the median counts
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub repeats: u32,
    /// Take the Earth as flat, whatever the store says
    #[arg(long)]
    pub flat: bool,
    /// Write the report to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// `terrafarm bench flight`
#[derive(Debug, ClapArgs)]
pub struct BenchFlight {
    /// Scene file [default: the demo's, over terrain of its own]
    #[arg(requires = "flight")]
    pub scene: Option<PathBuf>,
    /// Flight file, CSV [default: the demo's]
    #[arg(long, value_name = "CSV", requires = "scene")]
    pub flight: Option<PathBuf>,
    /// Size of the picture
    #[arg(long, value_parser = parse_size, value_name = "WxH", default_value = "1920x1080")]
    pub size: (u32, u32),
    /// Frames, spread over the flight [default: 24 a second of it]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub frames: Option<u32>,
    /// Threads [default: one a core]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// How rays find the ground [default: the scene's, else auto]
    #[arg(long, value_parser = parse_method, value_name = "NAME")]
    pub method: Option<Method>,
    /// Tolerance of the method, pixels [default: the scene's, else 0.5]
    #[arg(long, value_parser = parse_tolerance, value_name = "PX", allow_negative_numbers = true)]
    pub tolerance: Option<f64>,
    /// Runs, of which the one in the middle counts
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub repeats: u32,
    /// Small terrain and pictures, for a quick look
    #[arg(long, conflicts_with_all = ["scene", "size", "frames", "repeats"])]
    pub short: bool,
    /// Write the report to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// `terrafarm bench speed-accuracy`
#[derive(Debug, ClapArgs)]
pub struct BenchSpeedAccuracy {
    /// Small pictures of small terrain, for a quick look
    #[arg(long)]
    pub short: bool,
    /// Store to look at as well (may be given again)
    #[arg(long = "terrain", value_name = "STORE")]
    pub terrains: Vec<PathBuf>,
    /// Write the points to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write the chart as SVG
    #[arg(long, value_name = "FILE")]
    pub svg: Option<PathBuf>,
    /// Write the chart as PNG
    #[arg(long, value_name = "FILE")]
    pub png: Option<PathBuf>,
}

/// `terrafarm bench terrain-size`
#[derive(Debug, ClapArgs)]
pub struct BenchTerrainSize {
    /// Small terrains and pictures, for a quick look
    #[arg(long, conflicts_with_all = ["posts", "size"])]
    pub short: bool,
    /// Posts along a side of the terrains, with commas
    #[arg(long, value_delimiter = ',', default_value = "1025,2049,4097,8193,16385,32769",
        value_parser = clap::value_parser!(u32).range(65..=65_537))]
    pub posts: Vec<u32>,
    /// Size of the picture
    #[arg(long, value_parser = parse_size, value_name = "WxH", default_value = "1280x720")]
    pub size: (u32, u32),
    /// Memory for decoded terrain, MiB
    #[arg(long, value_name = "MIB", default_value_t = 1024,
        value_parser = clap::value_parser!(u64).range(1..=1 << 20))]
    pub cache: u64,
    /// Folder that keeps the terrains, and where they are looked for [default: a temporary one]
    #[arg(long, value_name = "FOLDER")]
    pub stores: Option<PathBuf>,
    /// Timed runs of each frame, of which the median counts
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub repeats: u32,
    /// Write the report to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// `terrafarm bench scale-out`
#[derive(Debug, ClapArgs)]
pub struct BenchScaleOut {
    /// Numbers of workers, with commas [default: 1,2,4,8; with --fake 1,10,100,1000]
    #[arg(long, value_delimiter = ',', value_name = "N",
        value_parser = clap::value_parser!(u32).range(1..=16_384))]
    pub workers: Vec<u32>,
    /// Workers that sleep instead of rendering: how much the coordinator can do
    #[arg(long)]
    pub fake: bool,
    /// How long a sleeping worker takes for a job, milliseconds
    #[arg(long, value_name = "MS", default_value_t = 0, requires = "fake",
        value_parser = clap::value_parser!(u64).range(0..=60_000))]
    pub job_ms: u64,
    /// Jobs for the sleeping workers, each of 8 x 8 pixels
    #[arg(long, default_value_t = 200_000, requires = "fake",
        value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    pub jobs: u64,
    /// Size of the picture
    #[arg(long, value_parser = parse_size, value_name = "WxH", default_value = "1280x720",
        conflicts_with = "fake")]
    pub size: (u32, u32),
    /// Frames of the flight
    #[arg(long, default_value_t = 120, conflicts_with = "fake",
        value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub frames: u32,
    /// Runs of each number of workers, of which the one in the middle counts
    #[arg(long, default_value_t = 3, conflicts_with = "fake",
        value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub repeats: u32,
    /// Put every worker behind a link of so many megabits per second each way: Linux, as root
    #[arg(long, value_name = "MBIT", conflicts_with = "fake",
        value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub link: Option<u32>,
    /// Folder that keeps the terrain, and where it is looked for [default: a temporary one]
    #[arg(long, value_name = "FOLDER", conflicts_with = "fake")]
    pub stores: Option<PathBuf>,
    /// Few frames or jobs, for a quick look
    #[arg(long)]
    pub short: bool,
    /// Write the chart as SVG
    #[arg(long, value_name = "FILE", conflicts_with = "fake")]
    pub svg: Option<PathBuf>,
    /// Write the chart as PNG
    #[arg(long, value_name = "FILE", conflicts_with = "fake")]
    pub png: Option<PathBuf>,
    /// Write the report to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// `terrafarm bench stability`
#[derive(Debug, ClapArgs)]
pub struct BenchStability {
    /// Small pictures and few rays, for every change
    #[arg(long)]
    pub short: bool,
    /// Write the report to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// `terrafarm simulate`
#[derive(Debug, ClapArgs)]
pub struct Simulate {
    /// Workers
    #[arg(long, default_value_t = 31, value_parser = parse_simulated_workers)]
    pub workers: u32,
    /// Frames of all shots together [default: about a minute of work]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub frames: Option<u32>,
    /// Shots that share the frames, of three priorities; all but the first arrive within the
    /// first half minute
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=256))]
    pub shots: u32,
    /// Same seed, same run
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Everything below goes wrong, and workers hang, get stuck, fail at jobs and hand them
    /// back
    #[arg(long)]
    pub faults: bool,
    /// Workers leave, crash or lose power, and come back, all the time
    #[arg(long)]
    pub churn: bool,
    /// Links and whole switches carry nothing for a while; what workers render meanwhile
    /// comes too late
    #[arg(long)]
    pub partitions: bool,
    /// A third of the links are wireless, or come from homes
    #[arg(long)]
    pub slow_links: bool,
    /// Messages are lost, or come twice
    #[arg(long)]
    pub lost_messages: bool,
    /// Some columns cost sixteen times as much as others, and some frames ten times
    #[arg(long)]
    pub skew: bool,
    /// Write the report to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Keep a journal of all that the scheduler is told, to be replayed
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// Instead of making a night up, play a journal again; exit code 1 if the scheduler does
    /// not ask for the same
    #[arg(long, value_name = "FILE", conflicts_with_all = [
        "workers", "frames", "shots", "seed", "faults", "churn", "partitions", "slow_links",
        "lost_messages", "skew", "journal",
    ])]
    pub replay: Option<PathBuf>,
}

fn parse_simulated_workers(text: &str) -> Result<u32, String> {
    let most = terrafarm_sched::MAX_WORKERS as u32;
    let workers = text.parse().ok().filter(|workers| (1..=most).contains(workers));
    workers.ok_or_else(|| format!("choose 1 to {most}: a farm has no room for more"))
}
