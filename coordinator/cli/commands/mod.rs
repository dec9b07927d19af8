//! One module a command.

mod bench;
mod compare;
mod demo;
mod queue;
mod render;
mod serve;
mod simulate;
mod terrain;
mod token;

use serve::runtime;
pub use serve::stop_signal;

use crate::Outcome;
use crate::args::Command;
use crate::input::scene::Scene;

/// Carries out a command.
pub fn run(command: Command) -> anyhow::Result<Outcome> {
    match command {
        Command::Demo(args) => demo::run(&args),
        Command::Terrain(args) => terrain::run(args),
        Command::Scene => {
            print!("{}", Scene::example());
            Ok(Outcome::Done)
        }
        Command::Render(args) => render::run(&args),
        Command::Coordinator(args) => serve::coordinator(&args),
        Command::Worker(args) => serve::worker(args),
        Command::Token(args) => token::run(&args),
        Command::Submit(args) => queue::submit(&args),
        Command::Shots(args) => queue::shots(&args),
        Command::Workers(args) => queue::workers(&args),
        Command::Pause(args) => queue::one_shot(&args, "pause"),
        Command::Resume(args) => queue::one_shot(&args, "resume"),
        Command::Cancel(args) => queue::one_shot(&args, "cancel"),
        Command::Priority(args) => queue::priority(&args),
        Command::Clear(args) => queue::clear(&args),
        Command::Drain(args) => queue::drain(&args),
        Command::Why(args) => queue::why(&args),
        Command::Fetch(args) => queue::fetch(&args),
        Command::Compare(args) => compare::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::Bench(args) => bench::run(&args),
    }
}
