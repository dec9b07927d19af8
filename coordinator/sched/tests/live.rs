//! While somebody waits for frames: how soon silence is noticed, and what is no silence.

#![allow(clippy::unwrap_used)]

use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};
use terrafarm_common::region::{Region, Split};
use terrafarm_sched::*;

const MS: u64 = 1000;
const LIVE: ShotId = ShotId(1);

/// A scheduler and its clock. Workers answer nothing by themselves.
struct Farm {
    scheduler: Scheduler,
    now: u64,
}

impl Farm {
    /// Workers 1 and 2 have just joined, nothing is to do.
    fn of_two() -> Self {
        let mut farm = Farm { scheduler: Scheduler::new(Config::default(), 1), now: 0 };
        for worker in [1, 2] {
            farm.tell(Event::WorkerJoined { worker: WorkerId(worker), threads: 1 });
        }
        farm
    }

    fn tell(&mut self, event: Event) -> Vec<Action> {
        self.scheduler.handle(Micros(self.now), event);
        self.scheduler.check_invariants().unwrap();
        std::iter::from_fn(|| self.scheduler.poll_action()).collect()
    }

    fn hear(&mut self, worker: u64) {
        self.tell(Event::HeardFrom { worker: WorkerId(worker) });
    }

    fn submit(&mut self, shot: ShotId, live: bool) -> Vec<Action> {
        self.tell(Event::ShotSubmitted {
            shot,
            frames: 1000,
            width: 640,
            height: 100,
            split: Split::Columns,
            priority: 0,
            frames_in_flight: 4,
            live,
        })
    }

    /// Plays until a time; these workers answer at once. What was asked for, and when.
    fn play(&mut self, until: u64, answering: &[u64]) -> Vec<(u64, Action)> {
        let mut asked = Vec::new();
        while let Some(at) = self.scheduler.next_deadline().filter(|at| at.0 <= until) {
            self.now = self.now.max(at.0);
            let actions = self.tell(Event::Tick);
            for action in &actions {
                if let Action::Probe { worker } = action
                    && answering.contains(&worker.0)
                {
                    self.hear(worker.0);
                }
            }
            asked.extend(actions.into_iter().map(|action| (self.now, action)));
        }
        self.now = until;
        asked
    }
}

fn drops(asked: &[(u64, Action)]) -> Vec<(u64, u64)> {
    let drops = asked.iter().filter_map(|(at, action)| match action {
        Action::Drop { worker, why: DropReason::Silent { .. } } => Some((*at, worker.0)),
        _ => None,
    });
    drops.collect()
}

fn probes(asked: &[(u64, Action)], worker: u64) -> usize {
    let probe = Action::Probe { worker: WorkerId(worker) };
    asked.iter().filter(|(_, action)| *action == probe).count()
}

/// The jobs that a worker was granted.
fn grants(actions: &[Action], to: u64) -> Vec<(LeaseId, FrameIndex, Region)> {
    let grants = actions.iter().filter_map(|action| match *action {
        Action::Grant { worker, lease, frame, region, .. } if worker.0 == to => {
            Some((lease, frame, region))
        }
        _ => None,
    });
    grants.collect()
}

#[test]
fn a_worker_that_falls_silent_is_dropped_in_time_and_its_jobs_are_the_next_to_go() {
    let mut farm = Farm::of_two();
    let granted = farm.submit(LIVE, true);
    farm.play(1000 * MS, &[1, 2]);
    farm.hear(1);
    let asked = farm.play(2000 * MS, &[2]);
    assert_eq!(drops(&asked), [(1450 * MS, 1)]);
    assert!(probes(&asked, 1) >= 2, "one question may be lost: {asked:?}");
    assert_eq!((farm.scheduler.workers(), farm.scheduler.account().lost), (1, 2));
    let (lease, ..) = grants(&granted, 2)[0];
    let next = farm.tell(Event::JobDone { worker: WorkerId(2), lease, cost_us: 1, digest: 0 });
    let (_, frame, region) = grants(&granted, 1)[0];
    let (_, next_frame, next_region) = grants(&next, 2)[0];
    assert_eq!((next_frame, next_region.x), (frame, region.x));
}

#[test]
fn who_was_left_alone_before_is_asked_before_it_is_dropped() {
    let mut farm = Farm::of_two();
    farm.submit(ShotId(2), false);
    assert_eq!(drops(&farm.play(700 * MS, &[])), []);
    let asked = farm.submit(LIVE, true);
    for worker in [1, 2] {
        assert!(asked.contains(&Action::Probe { worker: WorkerId(worker) }), "{asked:?}");
    }
    farm.now += 2 * MS;
    farm.hear(1);
    assert_eq!(drops(&farm.play(2000 * MS, &[1])), [(1150 * MS, 2)]);
}

#[test]
fn without_anyone_who_waits_silence_may_last_as_long_as_ever() {
    let ends = [
        Event::ShotCanceled { shot: LIVE },
        Event::ShotPaused { shot: LIVE },
        Event::ShotResumed { shot: LIVE },
    ];
    for (case, end) in ends.into_iter().enumerate() {
        let mut farm = Farm::of_two();
        farm.submit(ShotId(2), false);
        farm.submit(LIVE, true);
        assert_eq!(drops(&farm.play(400 * MS, &[])), []);
        farm.tell(end);
        let dropped_at = if case < 2 { 5000 * MS } else { 450 * MS };
        let expected = [(dropped_at, 1), (dropped_at, 2)];
        assert_eq!(drops(&farm.play(6000 * MS, &[])), expected, "case {case}");
    }
}

#[test]
fn a_live_shot_that_waits_and_goes_on_asks_first_again() {
    let mut farm = Farm::of_two();
    farm.submit(LIVE, true);
    farm.tell(Event::ShotPaused { shot: LIVE });
    assert_eq!(drops(&farm.play(3000 * MS, &[1])), []);
    let asked = farm.tell(Event::ShotResumed { shot: LIVE });
    assert!(asked.contains(&Action::Probe { worker: WorkerId(2) }), "{asked:?}");
    assert_eq!(drops(&farm.play(4000 * MS, &[1])), [(3450 * MS, 2)]);
}

#[test]
fn whatever_a_worker_says_shows_that_it_lives() {
    let (worker, lease) = (WorkerId(1), LeaseId(99));
    let words = [
        Event::HeardFrom { worker },
        Event::JobDone { worker, lease, cost_us: 1, digest: 0 },
        Event::JobFailed { worker, lease, reason: "no".into() },
        Event::HandedBack { worker, leases: Vec::new() },
        Event::WorkerMeasured { worker, pixels_per_s: 5 },
        Event::WorkerDraining { worker },
    ];
    let mut farm = Farm::of_two();
    farm.submit(LIVE, true);
    for word in words {
        let until = farm.now + 440 * MS;
        assert_eq!(drops(&farm.play(until, &[2])), [], "before {word:?}");
        farm.tell(word);
    }
    let silent_at = farm.now;
    assert_eq!(drops(&farm.play(silent_at + 500 * MS, &[2])), [(silent_at + 450 * MS, 1)]);
}

#[test]
fn a_worker_that_joins_while_somebody_waits_is_watched_from_then_on() {
    let mut farm = Farm::of_two();
    farm.submit(LIVE, true);
    farm.play(300 * MS, &[1, 2]);
    farm.tell(Event::WorkerJoined { worker: WorkerId(3), threads: 1 });
    assert_eq!(drops(&farm.play(2000 * MS, &[1, 2])), [(750 * MS, 3)]);
}

#[test]
fn a_coordinator_that_oversleeps_does_not_take_that_for_the_silence_of_others() {
    let mut farm = Farm::of_two();
    farm.submit(LIVE, true);
    farm.play(100 * MS, &[1, 2]);
    // It hears nothing for longer than anyone may be silent; what they said waits.
    farm.now = 1000 * MS;
    let asked = farm.tell(Event::Tick);
    assert!(asked.contains(&Action::Probe { worker: WorkerId(1) }), "{asked:?}");
    farm.hear(1);
    assert_eq!(drops(&farm.play(2000 * MS, &[1])), [(1450 * MS, 2)]);
    // Not even so for longer than the batch rule allows.
    farm.now = 7100 * MS;
    assert_eq!(farm.tell(Event::Tick).len(), 1);
    assert_eq!(farm.scheduler.workers(), 0);
}

#[test]
fn one_live_shot_of_several_is_enough_and_the_last_one_ends_it() {
    let mut farm = Farm::of_two();
    farm.submit(LIVE, true);
    farm.submit(ShotId(2), true);
    farm.tell(Event::ShotCanceled { shot: LIVE });
    assert_eq!(drops(&farm.play(1000 * MS, &[1])), [(450 * MS, 2)]);
    farm.tell(Event::ShotCanceled { shot: ShotId(2) });
    assert_eq!(drops(&farm.play(3000 * MS, &[])), []);
}
