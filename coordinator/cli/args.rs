//! The command line as typed.

pub mod queue;

use crate::input::{parse_method, parse_tolerance};
use clap::{Args as ClapArgs, Parser, Subcommand, ValueEnum};
use std::net::SocketAddr;
use std::path::PathBuf;
use terrafarm_common::accuracy::Share;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Split;
use terrafarm_worker::office::hours::Hours;

/// Where a coordinator listens, and is looked for, unless something else is said.
pub const COORDINATOR: &str = "127.0.0.1:7070";

/// Flies a camera over real terrain, rendered by every PC in the office.
#[derive(Debug, Parser)]
#[command(name = "terrafarm", version, max_term_width = 100)]
pub struct Args {
    /// Say more on stderr; twice for everything
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
    /// What to do
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Make procedural terrain, fly over it with two local workers, leave a video
    Demo(Demo),
    /// Make, inspect and sample terrain stores
    #[command(subcommand)]
    Terrain(Terrain),
    /// Print a scene file with every key, its range and its default
    Scene,
    /// Render a flight over a scene to a video or to pictures
    Render(Render),
    /// Serve a farm: workers and renders connect here
    Coordinator(Coordinator),
    /// Render for a coordinator until told to stop
    Worker(Worker),
    /// Leave a shot in a coordinator's queue: it is rendered when you have gone
    Submit(Box<queue::Submit>),
    /// List the shots of a farm, or one of them
    Shots(queue::Shots),
    /// List the workers of a farm
    Workers(queue::Workers),
    /// Let a shot wait; jobs that run are stopped
    Pause(queue::OneShot),
    /// Let a shot go on
    Resume(queue::OneShot),
    /// Give a shot up
    Cancel(queue::OneShot),
    /// Change how urgent a shot is
    Priority(queue::Priority),
    /// Let a worker try again what it was blocked for
    Clear(queue::Clear),
    /// Let a worker finish what it renders, and leave
    Drain(queue::Drain),
    /// Say why a frame is not done
    Why(queue::Why),
    /// Bring the frames or the film of a shot here, checked
    Fetch(queue::Fetch),
    /// Print the farm token of this PC, made if there is none; or enter that of a farm
    Token(Token),
    /// Say how far two pictures, or two folders of numbered pictures, are apart
    Compare(Compare),
    /// Run the real scheduler on a virtual clock, with workers that fail
    Simulate(Simulate),
    /// Measure speed, accuracy and stability of the methods; exit code 1 if one is wrong
    #[command(subcommand)]
    Bench(Bench),
}

/// `terrafarm demo`
#[derive(Debug, ClapArgs)]
pub struct Demo {
    /// Folder for everything the demo makes
    #[arg(short, long, default_value = "out/demo")]
    pub output: PathBuf,
    /// Local worker processes
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub workers: u32,
    /// Seed of the terrain
    #[arg(long)]
    pub seed: Option<u64>,
    /// How rays find the ground and what that may cost
    #[command(flatten)]
    pub casting: Casting,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// What `render` and `demo` have in common.
#[derive(Debug, Clone, Copy, ClapArgs)]
pub struct Casting {
    /// How rays find the ground: auto, exact, lod, column, frustum, voxel or reference
    /// [default: the scene's, else auto]
    #[arg(long, value_parser = parse_method, value_name = "NAME")]
    pub method: Option<Method>,
    /// How far a method may displace what is seen, pixels, 0.01 to 64 [default: the
    /// scene's, else 0.5]
    #[arg(long, value_parser = parse_tolerance, value_name = "PX", allow_negative_numbers = true)]
    pub tolerance: Option<f64>,
    /// Measure a random share of the pixels against exact, such as 1%: error in pixels,
    /// per frame in the manifest
    #[arg(long, value_name = "PERCENT", default_value = "0", allow_negative_numbers = true)]
    pub check: Share,
}

/// `terrafarm terrain ...`
#[derive(Debug, Subcommand)]
pub enum Terrain {
    /// Turn elevation files, photos and finer insets into one NAME.terrain
    Import(Box<Import>),
    /// Say what a store contains
    Info {
        /// The store
        store: PathBuf,
        /// Print as JSON
        #[arg(long)]
        json: bool,
    },
    /// Print the height at points: CSV in (`lon,lat` or `x,y`), CSV out with `height_m`
    Sample {
        /// The store
        store: PathBuf,
        /// CSV file of points with a header line; `-` for standard input
        #[arg(long)]
        points: PathBuf,
    },
    /// Make procedural terrain of any size and seed
    Synth(Synth),
    /// Write a hillshade of a store as a grey PNG, to look at it
    Hillshade {
        /// The store
        store: PathBuf,
        /// The PNG to write
        #[arg(short, long)]
        output: PathBuf,
        /// Direction of the light, degrees clockwise from grid north
        #[arg(long, default_value_t = 315.0)]
        azimuth: f64,
        /// Height of the light above the horizon, degrees
        #[arg(long, default_value_t = 45.0)]
        altitude: f64,
    },
}

/// `terrafarm terrain import`
#[derive(Debug, ClapArgs)]
pub struct Import {
    /// Elevation files: GeoTIFF, .hgt, .hgt.zip, ESRI ASCII grid, USGS .dem, PNG
    #[arg(required = true)]
    pub elevation: Vec<PathBuf>,
    /// The store to write
    #[arg(short, long)]
    pub output: PathBuf,
    /// Aerial photo: GeoTIFF, or JPEG or PNG with a world file (may be given again)
    #[arg(long = "photo", value_name = "FILE")]
    pub photos: Vec<PathBuf>,
    /// Finer elevation for a part of the ground (may be given again)
    #[arg(long = "inset", value_name = "FILE")]
    pub insets: Vec<PathBuf>,
    /// Metric reference system of the store, such as EPSG:32612 [default: the inputs'
    /// own if metric, else the UTM zone of their centre]
    #[arg(long)]
    pub crs: Option<String>,
    /// Reference system of files that do not say theirs
    #[arg(long)]
    pub source_crs: Option<String>,
    /// Distance between posts, metres [default: that of the finest input, or a little
    /// less where it has to be resampled]
    #[arg(long, value_name = "METRES")]
    pub spacing: Option<f64>,
    /// Fill voids up to this many posts wide from their rim
    #[arg(long, value_name = "POSTS")]
    pub fill_voids: Option<u32>,
    /// How heights are packed into RGB of a PNG
    #[arg(long, value_enum, default_value_t = PngEncoding::Auto)]
    pub png_encoding: PngEncoding,
    /// Web Mercator tile that a PNG without a world file covers, as Z/X/Y
    #[arg(long, value_name = "Z/X/Y")]
    pub tile: Option<String>,
    /// Unit of heights where the file does not say, or says it wrong
    #[arg(long, value_enum)]
    pub height_unit: Option<HeightUnit>,
    /// Colour of a photo that means "no photo here", such as ffffff
    #[arg(long, value_name = "RRGGBB")]
    pub collar: Option<String>,
    /// Replace an existing store
    #[arg(long)]
    pub force: bool,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// How heights are packed into the colours of a PNG.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PngEncoding {
    /// Find out, or ask if it is not certain
    Auto,
    /// Mapbox: -10000 + 0.1 (65536 R + 256 G + B)
    TerrainRgb,
    /// Terrarium: 256 R + G + B / 256 - 32768
    Terrarium,
    /// R low byte, G high byte, B sign
    SrtmRgba,
    /// 16-bit grey, metres
    Grey16,
}

/// Unit of heights in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum HeightUnit {
    /// Metres
    Metres,
    /// International feet, 0.3048 m
    Feet,
    /// US survey feet, 1200/3937 m
    UsFeet,
}

/// `terrafarm terrain synth`
#[derive(Debug, ClapArgs)]
pub struct Synth {
    /// The store to write
    #[arg(short, long)]
    pub output: PathBuf,
    /// Posts along a side
    #[arg(long, default_value_t = 2049)]
    pub size: u32,
    /// Distance between posts, metres
    #[arg(long, default_value_t = 15.0)]
    pub spacing: f64,
    /// Same seed, same terrain
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Photo pixels per post along a side
    #[arg(long, default_value_t = 1)]
    pub photo_scale: u32,
    /// Replace an existing store
    #[arg(long)]
    pub force: bool,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// How links to other PCs are secured.
#[derive(Debug, Clone, ClapArgs)]
pub struct Security {
    /// File with the farm token [default: the variable TERRAFARM_TOKEN, else the file of
    /// "terrafarm token"]
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Links that are neither encrypted nor authenticated, on a network you trust
    #[arg(long, conflicts_with = "token_file")]
    pub plain: bool,
}

/// `terrafarm token`
#[derive(Debug, ClapArgs)]
pub struct Token {
    /// File with the farm token [default: one in the user's configuration folder]
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Take the token from a line of standard input and keep it here
    #[arg(long)]
    pub enter: bool,
    /// Print the key of the page and the API by HTTP, which is derived from the token
    #[arg(long, conflicts_with = "enter")]
    pub web: bool,
}

/// `terrafarm render`
#[derive(Debug, ClapArgs)]
pub struct Render {
    /// Scene file (TOML), or a .terrain store to render with the default light
    pub scene: PathBuf,
    /// Flight: CSV keyframes
    #[arg(long)]
    pub flight: PathBuf,
    /// Where the pictures go: a folder or NAME-%05d.png for PNG, NAME.y4m, NAME.mp4
    #[arg(short, long)]
    pub output: PathBuf,
    /// Size of the picture [default: the scene's, else 1280x720]
    #[arg(long, value_parser = parse_size, value_name = "WxH")]
    pub size: Option<(u32, u32)>,
    /// Frames per second of flight [default: the scene's, else 30]
    #[arg(long)]
    pub fps: Option<f64>,
    /// Render these frames only, such as 0..24 (the end is not included)
    #[arg(long, value_parser = parse_range, value_name = "FIRST..END")]
    pub frames: Option<(u32, u32)>,
    /// How rays find the ground and what that may cost
    #[command(flatten)]
    pub casting: Casting,
    /// Samples along each side of a pixel: 2 means 4 a pixel
    #[arg(long)]
    pub samples: Option<u32>,
    /// Shape of the jobs: columns, tiles, or tiles:SIDE
    #[arg(long, value_parser = parse_split, default_value = "columns")]
    pub split: Split,
    /// Farm to render on [default: that of TERRAFARM_COORDINATOR, unless --workers or
    /// --threads is given; else local workers]
    #[arg(long, value_name = "HOST:PORT")]
    pub coordinator: Option<String>,
    /// How the link to the farm is secured
    #[command(flatten)]
    pub security: Security,
    /// Local worker processes, when there is no farm [default: one a core, at most 8]
    #[arg(long, conflicts_with = "coordinator", value_parser = clap::value_parser!(u32).range(1..=64))]
    pub workers: Option<u32>,
    /// Threads of each local worker [default: the cores shared out]
    #[arg(long, conflicts_with = "coordinator", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Frames that may be under way at once [default: 3]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub frames_in_flight: Option<u32>,
    /// Shots of a higher priority get every worker they can use; equals take turns
    #[arg(long, default_value_t = 0, allow_negative_numbers = true)]
    pub priority: i32,
    /// Who encodes MP4
    #[arg(long, value_enum, default_value_t = Encoder::Builtin)]
    pub encoder: Encoder,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// Who encodes video.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Encoder {
    /// The encoder that is part of this program
    Builtin,
    /// The ffmpeg on PATH
    Ffmpeg,
}

/// `terrafarm coordinator`
#[derive(Debug, ClapArgs)]
pub struct Coordinator {
    /// Address to listen on
    #[arg(long, default_value = COORDINATOR)]
    pub listen: SocketAddr,
    /// Do not let workers on the local network find this coordinator (multicast DNS)
    #[arg(long)]
    pub no_announce: bool,
    /// How links are secured
    #[command(flatten)]
    pub security: Security,
    /// Memory for terrain tiles on their way to workers, MiB
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u64).range(16..=1_048_576))]
    pub blob_memory: u64,
    /// Terrain that may wait for links to workers, MiB, before workers are sent to each other
    /// for it
    #[arg(long, value_name = "MIB", default_value_t = 8, value_parser = clap::value_parser!(u64).range(0..=1_048_576))]
    pub share_above: u64,
    /// Folder for a queue of shots that outlives whoever submits them, and the coordinator
    #[arg(long, value_name = "FOLDER", env = "TERRAFARM_DATA")]
    pub data: Option<PathBuf>,
    /// File for a record of all that the scheduler is told, 1 GiB at most, to be played again
    /// with "terrafarm simulate --replay"; if there is such a file, a number is added
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// The page and the API by HTTP
    #[command(flatten)]
    pub web: queue::Web,
    /// Render this share of the jobs a second time, by another worker, and compare: one that
    /// differs from two others gets no more jobs and is reported. Costs as much of the farm
    #[arg(long, value_name = "PERCENT", default_value = "0")]
    pub audit: Share,
}

/// `terrafarm worker`
#[derive(Debug, ClapArgs)]
pub struct Worker {
    /// The coordinator to work for [default: the one on this PC, else the one that answers
    /// on this network]
    #[arg(long, value_name = "HOST:PORT", env = "TERRAFARM_COORDINATOR")]
    pub coordinator: Option<String>,
    /// How the link is secured
    #[command(flatten)]
    pub security: Security,
    /// Name shown to people [default: this PC's name]
    #[arg(long)]
    pub name: Option<String>,
    /// Threads to render with [default: all cores]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Folder for terrain tiles [default: the user's cache folder]
    #[arg(long)]
    pub cache_dir: Option<PathBuf>,
    /// Size limit of that folder, MiB; 0 keeps nothing on disk
    #[arg(long, default_value_t = 4096, value_parser = clap::value_parser!(u64).range(0..=1_048_576))]
    pub cache_limit: u64,
    /// Memory for decoded tiles, MiB
    #[arg(long, default_value_t = 1024, value_parser = clap::value_parser!(u64).range(64..=1_048_576))]
    pub memory_limit: u64,
    /// Port at which other workers are given tiles of the cache, wherever the coordinator is;
    /// 0 takes a free one [default: a free one, if the coordinator is on another PC]
    #[arg(long, value_name = "PORT", conflicts_with = "no_share")]
    pub share_port: Option<u16>,
    /// Give no tiles to other workers
    #[arg(long)]
    pub no_share: bool,
    /// When to work, by this PC's clock: days, times or both, such as
    /// "mon-fri 18:00-08:00, sat, sun" [default: always]
    #[arg(long, value_name = "HOURS", env = "TERRAFARM_HOURS")]
    pub hours: Option<Hours>,
    /// Make room: one thread while the PC's user is there, none on cores that other
    /// programs use
    #[arg(long)]
    pub polite: bool,
    /// Most to send and most to receive, megabits per second each [default: no limit]
    #[arg(long, value_name = "MBIT", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub bandwidth: Option<u64>,
    /// End when the coordinator goes away instead of waiting for it
    #[arg(long)]
    pub once: bool,
}

/// `terrafarm compare`
#[derive(Debug, ClapArgs)]
pub struct Compare {
    /// A PNG picture, or a folder of numbered ones, or the manifest in it
    pub one: PathBuf,
    /// What to compare it with, of the same kind and size
    pub other: PathBuf,
    /// Write the differences, amplified, as a PNG; of a sequence, those of the worst pair
    #[arg(long, value_name = "FILE")]
    pub difference: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
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

/// `terrafarm bench ...`
#[derive(Debug, Subcommand)]
pub enum Bench {
    /// Speed of the methods on one core, every answer checked
    Core(BenchCore),
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

pub(crate) fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let side = |part: &str| part.parse::<u32>().ok().filter(|n| (1..=16_384).contains(n));
    text.split_once('x')
        .and_then(|(width, height)| Some((side(width)?, side(height)?)))
        .ok_or_else(|| "write WIDTHxHEIGHT in pixels, such as 1280x720, each 1 to 16384".into())
}

pub(crate) fn parse_range(text: &str) -> Result<(u32, u32), String> {
    text.split_once("..")
        .and_then(|(first, end)| Some((first.parse().ok()?, end.parse().ok()?)))
        .filter(|(first, end)| first < end)
        .ok_or_else(|| "write FIRST..END with FIRST below END, such as 0..24".into())
}

pub(crate) fn parse_split(text: &str) -> Result<Split, String> {
    match text.split_once(':') {
        None if text == "columns" => Ok(Split::Columns),
        None if text == "tiles" => Ok(Split::Tiles(128)),
        Some(("tiles", side)) => match side.parse::<u32>() {
            Ok(side) if (8..=4096).contains(&side) => Ok(Split::Tiles(side)),
            _ => Err("a tile has 8 to 4096 pixels a side, such as tiles:128".into()),
        },
        _ => Err("choose columns, tiles or tiles:SIDE".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_definition_holds_together() {
        Args::command().debug_assert();
    }

    #[test]
    fn sizes_ranges_and_splits_are_read() {
        assert_eq!(parse_size("1280x720"), Ok((1280, 720)));
        assert!(parse_size("0x720").is_err());
        assert!(parse_size("1e9x2").is_err());
        assert_eq!(parse_range("3..9"), Ok((3, 9)));
        assert!(parse_range("9..3").is_err());
        assert_eq!(parse_split("tiles:64"), Ok(Split::Tiles(64)));
        assert!(parse_split("tiles:0").is_err());
        assert!(parse_split("rows").is_err());
    }
}
