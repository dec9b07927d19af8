//! The command line as typed.

pub mod bench;
pub mod queue;
pub mod serve;
pub mod shot;
pub mod terrain;

use bench::{Bench, Simulate};
use clap::{Args as ClapArgs, Parser, Subcommand, ValueEnum};
use serve::{Coordinator, Security, Token, Worker};
use shot::{Casting, Shot};
use std::path::PathBuf;
use terrain::Terrain;

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

/// `terrafarm render`
#[derive(Debug, ClapArgs)]
pub struct Render {
    /// What is rendered
    #[command(flatten)]
    pub shot: Shot,
    /// Where the pictures go: a folder or NAME-%05d.png for PNG, NAME.y4m, NAME.mp4
    #[arg(short, long)]
    pub output: PathBuf,
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
    /// Somebody waits for each frame: a worker that died or froze is noticed within half a
    /// second instead of five, and its jobs go to others; one that only stutters is dropped
    /// and comes back
    #[arg(long)]
    pub live: bool,
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

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_definition_holds_together() {
        Args::command().debug_assert();
    }
}
