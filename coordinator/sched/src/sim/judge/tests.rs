//! An honest run is clean, and each crime is counted.

use super::*;
use crate::event::LostReason;

const WORKER: WorkerId = WorkerId(1);
const SHOT: ShotId = ShotId(1);
const WHOLE: Region = Region { x: 0, y: 0, width: 16, height: 8 };

fn watching() -> Judge {
    let mut judge = Judge::new(&Config::default());
    judge.event(Micros(0), &Event::WorkerJoined { worker: WORKER, threads: 1 });
    judge.event(
        Micros(0),
        &Event::ShotSubmitted {
            shot: SHOT,
            frames: 2,
            width: 16,
            height: 8,
            split: Default::default(),
            priority: 0,
            frames_in_flight: 1,
            live: true,
        },
    );
    judge
}

fn grant(lease: u64, frame: FrameIndex) -> Action {
    Action::Grant { worker: WORKER, lease: LeaseId(lease), shot: SHOT, frame, region: WHOLE }
}

fn accept(judge: &mut Judge, lease: u64) {
    let lease = LeaseId(lease);
    judge.event(Micros(0), &Event::JobDone { worker: WORKER, lease, cost_us: 1, digest: 0 });
    judge.action(&Action::Accept { lease, shot: SHOT, frame: 0, region: WHOLE });
}

#[test]
fn an_honest_run_is_clean() {
    let mut judge = watching();
    judge.action(&grant(1, 0));
    accept(&mut judge, 1);
    judge.action(&Action::FrameComplete { shot: SHOT, frame: 0 });
    judge.settled(Micros(0));
    assert!(judge.violations.is_clean(), "{:?}", judge.first);
}

#[test]
fn each_crime_is_counted() {
    let mut judge = watching();
    judge.action(&grant(1, 0));
    judge.action(&grant(1, 0));
    assert_eq!(judge.violations.lease_order, 1);
    judge.action(&grant(2, 0));
    judge.action(&grant(3, 0));
    assert_eq!(judge.violations.held_twice, 1);
    judge.action(&grant(4, 1));
    assert_eq!(judge.violations.in_flight, 1);
    accept(&mut judge, 3);
    accept(&mut judge, 3);
    assert_eq!(judge.violations.verdicts, 1);
    assert_eq!(judge.violations.pixels_twice, 1);
    judge.event(
        Micros(0),
        &Event::JobDone { worker: WORKER, lease: LeaseId(4), cost_us: 1, digest: 0 },
    );
    judge.settled(Micros(0));
    assert_eq!(judge.violations.verdicts, 2);
    judge.action(&Action::FrameComplete { shot: SHOT, frame: 1 });
    assert_eq!(judge.violations.pixels_missing, 1);
    judge.action(&Action::FrameComplete { shot: SHOT, frame: 1 });
    assert_eq!(judge.violations.frames_twice, 1);
    judge.settled(Micros(450_000));
    assert_eq!(judge.violations.unnoticed, 1);
    judge.event(Micros(0), &Event::WorkerDraining { worker: WORKER });
    judge.action(&grant(5, 0));
    assert_eq!(judge.violations.bad_grants, 1);
    judge.event(Micros(0), &Event::WorkerLost { worker: WORKER, why: LostReason::Broken });
    accept(&mut judge, 5);
    assert_eq!(judge.violations.zombie_pixels, 1);
    judge.action(&grant(6, 0));
    judge.ended(99);
    assert_eq!(judge.violations.unfinished, 1);
    assert_eq!(judge.violations.lease_ends, 1);
}
