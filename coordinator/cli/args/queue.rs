//! Commands about a coordinator's queue and workers, as typed.

use super::serve::Security;
use super::shot::Shot;
use clap::{Args as ClapArgs, ValueEnum};
use std::net::SocketAddr;
use std::path::PathBuf;

/// The page and the API of `terrafarm coordinator`.
#[derive(Debug, ClapArgs)]
pub struct Web {
    /// Address of the page, the API and the metrics by HTTP [default: 127.0.0.1:7071];
    /// where other PCs can reach it, a key is needed
    #[arg(long, value_name = "ADDRESS", conflicts_with = "no_http")]
    pub http: Option<SocketAddr>,
    /// No page, no API by HTTP
    #[arg(long)]
    pub no_http: bool,
    /// Ask for the key on this PC, too: behind a proxy, everyone comes from here
    #[arg(long, conflicts_with = "no_http")]
    pub http_key: bool,
    /// Another name by which browsers reach the page (may be given again)
    #[arg(long = "http-name", value_name = "NAME", conflicts_with = "no_http")]
    pub http_names: Vec<String>,
}

/// The coordinator that is asked.
#[derive(Debug, ClapArgs)]
pub struct Office {
    /// The coordinator to ask
    #[arg(long, value_name = "HOST:PORT", env = "TERRAFARM_COORDINATOR",
        default_value = super::COORDINATOR)]
    pub coordinator: String,
    /// How the link is secured
    #[command(flatten)]
    pub security: Security,
}

/// `terrafarm submit`
#[derive(Debug, ClapArgs)]
pub struct Submit {
    /// What is rendered
    #[command(flatten)]
    pub shot: Shot,
    /// What to call the shot [default: the scene and the flight]
    #[arg(long)]
    pub name: Option<String>,
    /// Make a film of the frames when they are all there
    #[arg(long, value_enum)]
    pub film: Option<Film>,
    /// Wait until the shot is over
    #[arg(long)]
    pub wait: bool,
    /// The coordinator to ask
    #[command(flatten)]
    pub office: Office,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// A film that a coordinator makes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Film {
    /// H.264 in MP4
    Mp4,
}

/// `terrafarm shots`
#[derive(Debug, ClapArgs)]
pub struct Shots {
    /// Number of one shot
    pub shot: Option<u64>,
    /// States, with commas: waiting, running, paused, stalled, finishing, done, failed,
    /// canceled, active (none of the last three), over (one of them)
    #[arg(long, default_value = "", value_name = "STATES", conflicts_with = "shot")]
    pub state: String,
    /// The coordinator to ask
    #[command(flatten)]
    pub office: Office,
    /// Print as JSON
    #[arg(long)]
    pub json: bool,
}

/// `terrafarm workers`
#[derive(Debug, ClapArgs)]
pub struct Workers {
    /// States, with commas: idle, busy, draining
    #[arg(long, default_value = "", value_name = "STATES")]
    pub state: String,
    /// The coordinator to ask
    #[command(flatten)]
    pub office: Office,
    /// Print as JSON
    #[arg(long)]
    pub json: bool,
}

/// `terrafarm pause`, `resume`, `cancel`
#[derive(Debug, ClapArgs)]
pub struct OneShot {
    /// Number of the shot
    pub shot: u64,
    /// The coordinator to ask
    #[command(flatten)]
    pub office: Office,
}

/// `terrafarm priority`
#[derive(Debug, ClapArgs)]
pub struct Priority {
    /// Number of the shot
    pub shot: u64,
    /// Shots of a higher priority get every worker they can use
    #[arg(allow_negative_numbers = true)]
    pub priority: i32,
    /// The coordinator to ask
    #[command(flatten)]
    pub office: Office,
}

/// `terrafarm clear`
#[derive(Debug, ClapArgs)]
pub struct Clear {
    /// Name or number of the worker
    pub worker: String,
    /// Number of the shot [default: every one, and whether it is trusted at all]
    #[arg(long)]
    pub shot: Option<u64>,
    /// The coordinator to ask
    #[command(flatten)]
    pub office: Office,
}

/// `terrafarm drain`
#[derive(Debug, ClapArgs)]
pub struct Drain {
    /// Name or number of the worker
    pub worker: String,
    /// The coordinator to ask
    #[command(flatten)]
    pub office: Office,
}

/// `terrafarm why`
#[derive(Debug, ClapArgs)]
pub struct Why {
    /// Number of the shot
    pub shot: u64,
    /// Number of the frame
    pub frame: u32,
    /// The coordinator to ask
    #[command(flatten)]
    pub office: Office,
}

/// `terrafarm fetch`
#[derive(Debug, ClapArgs)]
pub struct Fetch {
    /// Number of the shot
    pub shot: u64,
    /// Where to: a folder for the frames and the manifest, or NAME.mp4 for the film
    #[arg(short, long)]
    pub output: PathBuf,
    /// The coordinator to ask
    #[command(flatten)]
    pub office: Office,
}
