//! `terrafarm bench scale-out`: what more workers bring, and where the time goes.
//!
//! As it is (`real`), worker processes on this PC render a flight: frames a second, speed-up,
//! and an account of the workers' time that adds up to all of it (`account`); with `--link`
//! each of them in a network namespace behind a slow link (`links`). With `--fake`
//! (`fake`), a coordinator in a process of its own serves workers that sleep: jobs a second
//! through real sockets, far beyond what the cores of this PC could render.

mod account;
mod fake;
mod links;
mod process;
mod real;

use crate::{Outcome, args};

/// Measures and prints.
pub fn run(args: &args::bench::BenchScaleOut) -> anyhow::Result<Outcome> {
    if args.fake { fake::run(args) } else { real::run(args) }
}
