//! `terrafarm bench`: what the methods cost, how far they are off, and where they fail.
//!
//! | command | question | module |
//! |---|---|---|
//! | `bench core` | how fast is each method on one core? | `core` |
//! | `bench flight` | how many finished frames a second does this PC make? | `flight` |
//! | `bench speed-accuracy` | what does a smaller error cost? | `speed_accuracy`, `chart` |
//! | `bench terrain-size` | what does a frame cost over ever larger terrain? | `terrain_size` |
//! | `bench scale-out` | what do more workers bring, and where does the time go? | `scale_out` |
//! | `bench stability` | is any method silently wrong where it is known to be hard? | `stability` |
//!
//! Nothing is timed or charted without being checked, and a method that breaks its
//! promise makes the exit code 1. `land` makes and loads the terrain, `kernel` asks the
//! ray caster, `clock` reads the time that this thread had on a core.

mod chart;
mod clock;
mod core;
mod flight;
mod kernel;
mod land;
pub(super) mod report;
mod scale_out;
mod speed_accuracy;
mod stability;
mod terrain_size;

use crate::Outcome;
use crate::args;

/// Carries out a bench.
pub fn run(args: &args::bench::Bench) -> anyhow::Result<Outcome> {
    match args {
        args::bench::Bench::Core(args) => core::run(args),
        args::bench::Bench::Flight(args) => flight::run(args),
        args::bench::Bench::SpeedAccuracy(args) => speed_accuracy::run(args),
        args::bench::Bench::TerrainSize(args) => terrain_size::run(args),
        args::bench::Bench::ScaleOut(args) => scale_out::run(args),
        args::bench::Bench::Stability(args) => stability::run(args),
    }
}
