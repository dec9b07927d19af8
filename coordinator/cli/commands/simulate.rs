//! `terrafarm simulate`: the real scheduler on a virtual clock.

use crate::{Outcome, args};
use anyhow::{Context, bail};
use terrafarm_sched::sim::{self, Faults, SimConfig};

/// Faults happen in the first so many virtual seconds.
const FAULTS_WITHIN_S: f64 = 60.0;

/// Simulates one shot and prints how well the farm was used.
pub fn run(args: &args::Simulate) -> anyhow::Result<Outcome> {
    let mut config = SimConfig::for_workers(args.workers, args.seed);
    if let Some(frames) = args.frames {
        config.frames = frames;
    }
    if args.faults {
        config.faults = Faults::random(args.seed, FAULTS_WITHIN_S, true);
    }
    let report = sim::simulate(&config);
    if let Some(path) = &args.json {
        let text =
            serde_json::to_string_pretty(&report).context("cannot write the report as JSON")?;
        std::fs::write(path, text + "\n")
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    println!(
        "{} workers, {} frames, seed {}: {:.1} virtual seconds, efficiency {:.1} %",
        report.workers,
        report.frames,
        report.seed,
        report.makespan_s,
        report.efficiency * 100.0
    );
    let time = report.time;
    println!(
        "time of the workers: {:.1} % useful, {:.1} % redone, {:.1} % waiting; {} leases, {} failed frames",
        time.useful * 100.0,
        time.redone * 100.0,
        time.waiting * 100.0,
        report.jobs,
        report.failed_frames
    );
    if let Some(violation) = &report.first_violation {
        bail!("the scheduler broke a promise: {violation}; please report it with the seed");
    }
    println!(
        "every frame complete once, no pixel lost or doubled, no lease held twice unless on purpose"
    );
    Ok(Outcome::Done)
}
