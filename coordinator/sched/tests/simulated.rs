//! The scheduler on a virtual clock: how well it uses a farm, and that no fault order
//! makes it lose, repeat or tear a frame.

use terrafarm_common::region::Split;
use terrafarm_sched::sim::{Faults, SimConfig, SimReport, simulate};

fn run(config: &SimConfig) -> SimReport {
    let report = simulate(config);
    println!(
        "{:4} workers, seed {}: efficiency {:.4}, {:.1} s, {} frames, {} jobs, redo {:.4}, {:?} {:?}",
        report.workers,
        report.seed,
        report.efficiency,
        report.makespan_s,
        report.frames,
        report.jobs,
        report.redo_share,
        report.time,
        report.account,
    );
    assert!(report.invariants.is_clean(), "{:?} {:?}", report.invariants, report.first_violation);
    report
}

#[test]
fn thirty_one_mixed_workers_are_used_to_98_percent() {
    for seed in 1..=5 {
        let report = run(&SimConfig::for_workers(31, seed));
        assert!(report.efficiency >= 0.98, "{report:?}");
    }
}

#[test]
fn a_thousand_mixed_workers_are_used_to_95_percent() {
    let report = run(&SimConfig::for_workers(1000, 1));
    assert!(report.efficiency >= 0.95, "{report:?}");
}
