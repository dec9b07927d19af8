//! The two sides of a farm, and the secret that they share, as typed.

use super::{COORDINATOR, queue};
use clap::Args as ClapArgs;
use std::net::SocketAddr;
use std::path::PathBuf;
use terrafarm_common::accuracy::Share;
use terrafarm_worker::office::hours::Hours;

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
