//! `terrafarm simulate`: the real scheduler on a virtual clock, in a made-up night or in one
//! that is on record.

use crate::{Outcome, args};
use anyhow::{Context, bail};
use serde::Serialize;
use std::fs::File;
use std::path::Path;
use terrafarm_sched::Account;
use terrafarm_sched::journal::{self, JOURNAL_BYTES, ReplayReport};
use terrafarm_sched::sim::{self, Faults, SimConfig, SimReport, Violations};

/// Faults happen, and shots arrive, in the first so many virtual seconds.
const FAULTS_WITHIN_S: f64 = 60.0;
const SHOTS_WITHIN_S: f64 = 30.0;
/// What `--skew` does to columns and to frames.
const SKEWS: (f64, f64) = (15.0, 9.0);

/// Simulates one night, or replays one, and prints how well the farm was used.
pub fn run(args: &args::bench::Simulate) -> anyhow::Result<Outcome> {
    match &args.replay {
        Some(path) => replay(path, args.json.as_deref()),
        None => simulate(args),
    }
}

fn simulate(args: &args::bench::Simulate) -> anyhow::Result<Outcome> {
    let config = config(args);
    let report = match &args.journal {
        Some(path) => {
            let writing = || format!("cannot write {}", path.display());
            let mut file = File::create(path).with_context(writing)?;
            sim::record(&config, &mut file, JOURNAL_BYTES).with_context(writing)?
        }
        None => sim::simulate(&config),
    };
    write_json(args.json.as_deref(), &report)?;
    print(&report);
    if let Some(violation) = &report.first_violation {
        bail!("the scheduler broke a promise: {violation}; please report it with the seed");
    }
    Ok(Outcome::Done)
}

fn config(args: &args::bench::Simulate) -> SimConfig {
    let every = Faults::every(FAULTS_WITHIN_S);
    let mut faults = Faults { within_s: FAULTS_WITHIN_S, ..Faults::default() };
    if args.churn {
        (faults.stay_s, faults.come_back) = (every.stay_s, true);
    }
    if args.partitions {
        (faults.partitions, faults.switch_cuts) = (every.partitions, every.switch_cuts);
    }
    if args.slow_links {
        faults.slow_links = every.slow_links;
    }
    if args.lost_messages {
        (faults.loss, faults.duplicates) = (every.loss, every.duplicates);
    }
    let base = SimConfig::for_workers(args.workers, args.seed);
    let is_skewed = args.skew || args.faults;
    let (skew, frame_skew) = if is_skewed { SKEWS } else { (base.skew, base.frame_skew) };
    SimConfig {
        frames: args.frames.unwrap_or(base.frames).div_ceil(args.shots),
        shots: args.shots,
        arrive_within_s: SHOTS_WITHIN_S,
        skew,
        frame_skew,
        faults: if args.faults { every } else { faults },
        ..base
    }
}

fn print(report: &SimReport) {
    print_line!(
        "{} workers, {} frames, seed {}: {:.1} virtual seconds, efficiency {:.1} %",
        report.workers,
        report.frames,
        report.seed,
        report.makespan_s,
        report.efficiency * 100.0
    );
    let time = report.time;
    print_line!(
        "time of the workers: {:.1} % useful, {:.1} % redone, {:.1} % waiting; {} failed frames",
        time.useful * 100.0,
        time.redone * 100.0,
        time.waiting * 100.0,
        report.failed_frames
    );
    let latency = report.frame_latency_s;
    print_line!(
        "a frame takes {:.2} s from its first job to its last pixel, p99 {:.2} s, at most {:.2} s",
        latency.p50,
        latency.p99,
        latency.max
    );
    let notice = report.notice_s;
    if notice.count > 0 {
        print_line!(
            "{} machines without power noticed after {:.2} s, p99 {:.2} s, at most {:.2} s",
            notice.count,
            notice.p50,
            notice.p99,
            notice.max
        );
    }
    print_leases(&report.account);
    print_line!("{} results of zombies, all refused", report.zombies);
    print_invariants(&report.invariants);
}

fn print_leases(account: &Account) {
    print_line!(
        "{} leases: {} accepted, {} failed, {} expired, {} handed back, {} revoked, {} lost; \
         {} on purpose a second time; {} results refused",
        account.granted,
        account.accepted,
        account.failed,
        account.expired,
        account.handed_back,
        account.revoked,
        account.lost,
        account.hedged,
        account.refused
    );
}

fn print_invariants(broken: &Violations) {
    if broken.is_clean() {
        print_line!(
            "every frame complete once, no pixel lost or doubled, no lease held twice unless on \
             purpose, nothing of a zombie merged, nobody silent unnoticed: all invariants hold"
        );
    } else {
        print_line!("broken invariants: {broken:?}");
    }
}

/// Plays a journal again.
fn replay(path: &Path, json: Option<&Path>) -> anyhow::Result<Outcome> {
    let reading = || format!("cannot replay {}", path.display());
    let file = File::open(path).with_context(reading)?;
    let report = journal::replay(file).with_context(reading)?;
    write_json(json, &report)?;
    print_replay(&report);
    Ok(if report.is_faithful() { Outcome::Done } else { Outcome::BrokenPromise })
}

fn print_replay(report: &ReplayReport) {
    print_line!(
        "{} events in {:.1} s, recorded by terrafarm {}: at most {} workers, {} frames, {} failed",
        report.events,
        report.span_s,
        report.build,
        report.workers,
        report.frames,
        report.failed_frames
    );
    print_leases(&report.account);
    print_invariants(&report.invariants);
    if let Some(violation) = &report.first_violation {
        print_line!("first violation: {violation}");
    }
    if let Some(torn) = report.torn {
        print_line!(
            "the last record, at byte {}, was not written to its end: {} bytes cut off",
            torn.offset,
            torn.bytes
        );
    }
    match &report.first_difference {
        None => print_line!(
            "the same {} actions after each of {} events, hash {:016x}",
            report.actions,
            report.proved,
            report.hash
        ),
        Some(difference) => print_line!("the actions are not the same: {difference}"),
    }
}

fn write_json(path: Option<&Path>, report: &impl Serialize) -> anyhow::Result<()> {
    let Some(path) = path else { return Ok(()) };
    let text = serde_json::to_string_pretty(report).context("cannot write the report as JSON")?;
    std::fs::write(path, text + "\n").with_context(|| format!("cannot write {}", path.display()))
}
