//! `terrafarm simulate`: the real scheduler on a virtual clock.

use crate::{Outcome, args};
use anyhow::Context;

/// Simulates one shot and prints how well the farm was used.
pub fn run(args: &args::Simulate) -> anyhow::Result<Outcome> {
    let config = terrafarm_sched::sim::SimConfig::new(args.workers, args.frames, args.seed, args.faults);
    let report = terrafarm_sched::sim::simulate(&config);
    if let Some(path) = &args.json {
        let text = serde_json::to_string_pretty(&report).context("cannot write the report as JSON")?;
        std::fs::write(path, text + "\n").with_context(|| format!("cannot write {}", path.display()))?;
    }
    println!("{report}");
    Ok(if report.invariants.all_hold() { Outcome::Done } else { Outcome::FailedFrames })
}
