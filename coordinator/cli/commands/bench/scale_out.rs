//! `terrafarm bench scale-out`: what more workers bring, and where the time goes.
//!
//! With `--fake` (`fake`), a coordinator in a process of its own serves workers that sleep:
//! jobs a second through real sockets, far beyond what the cores of this PC could render.

mod fake;
mod process;

use crate::{Outcome, args};

/// Measures and prints.
pub fn run(args: &args::BenchScaleOut) -> anyhow::Result<Outcome> {
    fake::run(args)
}
