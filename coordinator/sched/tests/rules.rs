//! The rules of the scheduler, one by one, as any driver sees them.

#![allow(clippy::unwrap_used)]

use proptest::prelude::*;
use std::collections::VecDeque;
use terrafarm_common::accuracy::Share;
use terrafarm_common::id::{FrameIndex, LeaseId, ShotId, WorkerId};
use terrafarm_common::region::{Region, Split};
use terrafarm_sched::journal::{JOURNAL_BYTES, Recorder, replay};
use terrafarm_sched::*;

const SECOND: u64 = 1_000_000;

#[derive(Debug, Clone, Copy, PartialEq)]
struct Granted {
    worker: WorkerId,
    lease: LeaseId,
    shot: ShotId,
    frame: FrameIndex,
    region: Region,
}

/// A scheduler, its clock, and the grants that have not been answered.
struct Farm {
    scheduler: Scheduler,
    now: u64,
    grants: VecDeque<Granted>,
}

impl Farm {
    fn new() -> Self {
        let scheduler = Scheduler::new(Config::default(), 1);
        Farm { scheduler, now: 0, grants: VecDeque::new() }
    }

    /// Handles an event; returns what was asked for besides grants.
    fn tell(&mut self, event: Event) -> Vec<Action> {
        self.scheduler.handle(Micros(self.now), event);
        let mut others = Vec::new();
        while let Some(action) = self.scheduler.poll_action() {
            if let Action::Grant { worker, lease, shot, frame, region } = action {
                self.grants.push_back(Granted { worker, lease, shot, frame, region });
            } else {
                others.push(action);
            }
        }
        self.scheduler.check_invariants().unwrap();
        others
    }

    fn join(&mut self, worker: u64, threads: u32) {
        self.tell(Event::WorkerJoined { worker: WorkerId(worker), threads });
    }

    fn lose(&mut self, worker: u64) -> Vec<Action> {
        self.tell(Event::WorkerLost { worker: WorkerId(worker), why: LostReason::Broken })
    }

    /// Submits a shot of 640 x 100 pixels.
    fn submit(&mut self, shot: u64, frames: u32, priority: i32, in_flight: u32) -> Vec<Action> {
        self.submit_split(shot, frames, priority, in_flight, Split::Columns)
    }

    fn submit_split(
        &mut self,
        shot: u64,
        frames: u32,
        priority: i32,
        frames_in_flight: u32,
        split: Split,
    ) -> Vec<Action> {
        let (width, height) = (640, 100);
        let shot = ShotId(shot);
        self.tell(Event::ShotSubmitted {
            shot,
            frames,
            width,
            height,
            split,
            priority,
            frames_in_flight,
            live: false,
        })
    }

    fn done(&mut self, job: Granted, cost_us: u64) -> Vec<Action> {
        self.tell(Event::JobDone { worker: job.worker, lease: job.lease, cost_us, digest: 0 })
    }

    fn fail(&mut self, job: Granted) -> Vec<Action> {
        let reason = "no such tile".to_owned();
        self.tell(Event::JobFailed { worker: job.worker, lease: job.lease, reason })
    }

    /// The oldest unanswered grant to a worker.
    fn next_of(&mut self, worker: u64) -> Option<Granted> {
        let at = self.grants.iter().position(|job| job.worker == WorkerId(worker))?;
        self.grants.remove(at)
    }

    /// Answers every grant after a microsecond for each pixel; frames are taken at once.
    /// Returns all that was asked for besides grants.
    fn finish(&mut self) -> Vec<Action> {
        let mut all = Vec::new();
        while let Some(job) = self.grants.pop_front() {
            let cost_us = job.region.area();
            self.now += cost_us;
            let mut actions = self.done(job, cost_us);
            while let Some(action) = actions.pop() {
                if let Action::FrameComplete { shot, frame } = action {
                    actions.extend(self.tell(Event::FrameTaken { shot, frame }));
                }
                if let Action::Revoke { lease, .. } = action {
                    self.grants.retain(|job| job.lease != lease);
                }
                all.push(action);
            }
        }
        all
    }
}

fn is_accepted(actions: &[Action]) -> bool {
    matches!(actions[0], Action::Accept { .. })
}

fn refusal(actions: &[Action]) -> Option<RefuseReason> {
    match actions[0] {
        Action::Refuse { why, .. } => Some(why),
        _ => None,
    }
}

#[test]
fn every_worker_has_one_job_running_and_one_queued() {
    let mut farm = Farm::new();
    farm.submit(1, 10, 0, 4);
    assert!(farm.grants.is_empty(), "without workers a shot waits");
    farm.join(1, 4);
    farm.join(2, 4);
    let holders: Vec<u64> = farm.grants.iter().map(|job| job.worker.0).collect();
    assert_eq!(holders, [1, 1, 2, 2]);
}

#[test]
fn the_next_frame_starts_before_one_ends_but_only_so_many() {
    let mut farm = Farm::new();
    (1..=100).for_each(|worker| farm.join(worker, 1));
    farm.submit(1, 9, 0, 2);
    let frames: Vec<FrameIndex> = farm.grants.iter().map(|job| job.frame).collect();
    assert_eq!(frames.len(), 160, "80 strips of each of two frames");
    assert!(frames.is_sorted() && frames[0] == 0 && frames[159] == 1);
    let mut complete = Vec::new();
    for job in farm.grants.clone() {
        farm.now += 10;
        complete.extend(
            farm.done(job, 10)
                .into_iter()
                .filter(|action| matches!(action, Action::FrameComplete { .. })),
        );
    }
    let shot = ShotId(1);
    assert_eq!(complete, [0, 1].map(|frame| Action::FrameComplete { shot, frame }));
    assert!(farm.grants.iter().all(|job| job.frame < 2), "the client has taken none");
    farm.tell(Event::FrameTaken { shot, frame: 0 });
    assert!(farm.grants.iter().any(|job| job.frame == 2));
    assert!(farm.grants.iter().all(|job| job.frame < 3));
}

#[test]
fn what_a_lost_worker_held_is_granted_first_under_new_leases() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.submit(1, 5, 0, 4);
    let held = [farm.next_of(1).unwrap(), farm.next_of(1).unwrap()];
    farm.lose(1);
    farm.join(2, 1);
    let again = [farm.next_of(2).unwrap(), farm.next_of(2).unwrap()];
    assert_eq!(again.map(|job| job.region), held.map(|job| job.region));
    assert!(again[0].lease > held[1].lease);
    assert_eq!(refusal(&farm.done(held[0], 5)), Some(RefuseReason::Stale));
    assert!(is_accepted(&farm.done(again[0], 5)));
    assert_eq!(refusal(&farm.done(again[0], 5)), Some(RefuseReason::Duplicate));
    let forged = Granted { lease: LeaseId(999_999), ..again[0] };
    assert_eq!(refusal(&farm.done(forged, 5)), Some(RefuseReason::Unknown));
    let foreign = Granted { worker: WorkerId(7), ..again[1] };
    assert_eq!(refusal(&farm.done(foreign, 5)), Some(RefuseReason::Unknown));
    assert!(is_accepted(&farm.done(again[1], 5)), "the forger changed nothing");
}

#[test]
fn a_lease_that_runs_out_of_time_is_revoked_and_granted_anew() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.submit(1, 1, 0, 1);
    let held = farm.next_of(1).unwrap();
    farm.grants.clear();
    for _ in 0..60 {
        farm.now += SECOND / 2;
        let actions = farm.tell(Event::HeardFrom { worker: WorkerId(1) });
        if actions.contains(&Action::Revoke { worker: held.worker, lease: held.lease }) {
            assert!((10 * SECOND..12 * SECOND).contains(&farm.now), "{}", farm.now);
            let again = farm.next_of(1).unwrap();
            assert_eq!(again.region.x, held.region.x);
            assert_eq!(farm.next_of(1), None, "a suspect gets one job at a time");
            assert_eq!(refusal(&farm.done(held, 5)), Some(RefuseReason::Stale));
            assert!(is_accepted(&farm.done(again, 5)));
            return;
        }
    }
    panic!("the lease never ran out");
}

#[test]
fn a_silent_worker_is_probed_each_second_and_dropped_after_five() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.submit(1, 1, 0, 1);
    let (mut probes, worker) = (0, WorkerId(1));
    loop {
        farm.now = farm.scheduler.next_deadline().unwrap().0;
        for action in farm.tell(Event::Tick) {
            match action {
                Action::Probe { .. } => probes += 1,
                Action::Drop { worker: dropped, why } => {
                    assert_eq!((dropped, farm.now), (worker, 5 * SECOND));
                    assert_eq!(why, DropReason::Silent { silence_us: 5 * SECOND });
                    assert_eq!((probes, farm.scheduler.leases_held()), (4, 0));
                    assert_eq!(farm.scheduler.next_deadline(), None, "nobody is left");
                    return;
                }
                other => panic!("{other:?}"),
            }
        }
    }
}

#[test]
fn a_worker_that_answers_is_never_dropped() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    while farm.now < 60 * SECOND {
        farm.now = farm.scheduler.next_deadline().unwrap().0;
        for action in farm.tell(Event::Tick) {
            assert_eq!(action, Action::Probe { worker: WorkerId(1) });
            farm.tell(Event::HeardFrom { worker: WorkerId(1) });
        }
    }
    assert_eq!(farm.scheduler.workers(), 1);
}

#[test]
fn three_failures_fail_a_frame_by_name_and_the_shot_goes_on() {
    let mut farm = Farm::new();
    (1..=3).for_each(|worker| farm.join(worker, 1));
    farm.submit_split(1, 2, 0, 2, Split::Tiles(640));
    let mut tried_by = Vec::new();
    let failure = loop {
        let at = farm.grants.iter().position(|job| job.frame == 0).unwrap();
        let job = farm.grants.remove(at).unwrap();
        tried_by.push(job.worker);
        let actions = farm.fail(job);
        if let Some(action) = actions.into_iter().next() {
            break action;
        }
    };
    let (shot, region) = (ShotId(1), Region::whole(640, 100));
    let (worker, reason) = (tried_by[2], "no such tile".to_owned());
    let reason = FrameFailure::JobFailed { region, tries: 3, worker, reason };
    assert_eq!(failure, Action::FrameFailed { shot, frame: 0, reason });
    tried_by.sort_unstable();
    assert_eq!(tried_by, [1, 2, 3].map(WorkerId), "each worker is tried once");
    assert!(farm.finish().contains(&Action::ShotComplete { shot, failed_frames: 1 }));
}

#[test]
fn a_worker_that_fails_at_three_jobs_gets_no_more_of_the_shot() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.join(2, 1);
    farm.submit(1, 50, 0, 8);
    let blocked = Action::Blocked { worker: WorkerId(1), shot: ShotId(1) };
    for fault in 1..=3 {
        let job = farm.next_of(1).unwrap();
        assert_eq!(farm.fail(job).contains(&blocked), fault == 3);
    }
    farm.grants.retain(|job| job.worker != WorkerId(1));
    let other = farm.next_of(2).unwrap();
    farm.done(other, 5);
    assert_eq!(farm.next_of(1), None);
    farm.submit(2, 1, -1, 1);
    assert_eq!(farm.next_of(1).unwrap().shot, ShotId(2), "other shots are open to it");
    let unblocked = Action::Unblocked { worker: WorkerId(1), shot: ShotId(1) };
    assert!(farm.lose(2).contains(&unblocked), "nobody else is left");
}

#[test]
fn a_shot_that_renders_nowhere_is_given_up() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.submit_split(1, 100_000, 0, 4, Split::Tiles(640));
    for tries in 1.. {
        let job = farm.next_of(1).unwrap();
        let failed = farm.fail(job).into_iter().find_map(|action| match action {
            Action::ShotFailed { reason, .. } => Some(reason),
            _ => None,
        });
        if let Some(reason) = failed {
            assert_eq!(tries, 16 * 3);
            assert!(reason.to_string().contains("no such tile"), "{reason}");
            assert_eq!(farm.scheduler.leases_held(), 0);
            return;
        }
    }
}

#[test]
fn a_canceled_shot_is_revoked_at_once() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.submit(1, 5, 0, 4);
    let held = [farm.next_of(1).unwrap(), farm.next_of(1).unwrap()];
    let actions = farm.tell(Event::ShotCanceled { shot: ShotId(1) });
    let revokes = held.map(|job| Action::Revoke { worker: job.worker, lease: job.lease });
    assert_eq!(actions, revokes);
    assert_eq!(refusal(&farm.done(held[0], 5)), Some(RefuseReason::Stale));
    farm.submit(2, 1, 0, 1);
    assert_eq!(farm.next_of(1).unwrap().shot, ShotId(2));
}

#[test]
fn priority_comes_first_and_equals_take_turns() {
    let mut farm = Farm::new();
    farm.submit(1, 50, 0, 8);
    farm.submit(2, 50, 5, 8);
    farm.submit(3, 50, 5, 8);
    (1..=10).for_each(|worker| farm.join(worker, 1));
    let shots: Vec<u64> = farm.grants.iter().map(|job| job.shot.0).collect();
    assert_eq!(shots, [2, 3].repeat(10));
}

#[test]
fn a_draining_worker_gets_nothing_new_and_may_hand_back() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.submit(1, 5, 0, 4);
    let (first, second) = (farm.next_of(1).unwrap(), farm.next_of(1).unwrap());
    let worker = WorkerId(1);
    farm.tell(Event::WorkerDraining { worker });
    assert!(is_accepted(&farm.done(first, 5)));
    farm.tell(Event::HandedBack { worker, leases: vec![second.lease, LeaseId(77)] });
    assert_eq!((farm.next_of(1), farm.scheduler.leases_held()), (None, 0));
    farm.join(2, 1);
    assert_eq!(farm.next_of(2).unwrap().region.x, second.region.x);
    assert_eq!(farm.scheduler.account().handed_back, 1);
}

#[test]
fn an_idle_worker_gets_a_copy_of_what_is_late_and_the_first_result_wins() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.submit_split(1, 3, 0, 3, Split::Tiles(640));
    let warm_up = farm.next_of(1).unwrap();
    farm.now += 64_000;
    farm.done(warm_up, 64_000);
    let slow = farm.next_of(1).unwrap();
    farm.join(2, 1);
    let copied = farm.next_of(2);
    assert_eq!(copied, None, "what runs as expected is not copied");
    farm.now = farm.scheduler.next_deadline().unwrap().0;
    farm.tell(Event::Tick);
    let copy = farm.next_of(2).unwrap();
    assert_eq!((copy.frame, copy.region), (slow.frame, slow.region));
    assert_eq!(farm.scheduler.account().hedged, 1);
    let actions = farm.done(copy, 64_000);
    let revoked = Action::Revoke { worker: slow.worker, lease: slow.lease };
    assert!(is_accepted(&actions) && actions.contains(&revoked), "{actions:?}");
    assert_eq!(refusal(&farm.done(slow, 64_000)), Some(RefuseReason::Stale));
}

#[test]
fn jobs_follow_the_speed_of_their_worker_and_shrink_to_the_end() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.join(2, 1);
    farm.submit(1, 60, 0, 60);
    let mut widths = [Vec::new(), Vec::new()];
    // Worker 2 is three times as fast; results come in the order of their ends.
    let mut free_at = [0, 0];
    while !farm.grants.is_empty() {
        let one = if free_at[0] <= free_at[1] { 0 } else { 1 };
        let Some(job) = farm.next_of(one as u64 + 1).or_else(|| farm.grants.pop_front()) else {
            break;
        };
        let by = job.worker.0 as usize - 1;
        let cost_us = job.region.area() * [24, 8][by];
        free_at[by] = free_at[by].max(farm.now) + cost_us;
        farm.now = farm.now.max(free_at[by]);
        widths[by].push(job.region.width);
        for action in farm.done(job, cost_us) {
            if let Action::Revoke { lease, .. } = action {
                farm.grants.retain(|job| job.lease != lease);
            }
        }
    }
    let early = |by: usize| widths[by][20..40].iter().sum::<u32>();
    assert!(early(1) > 2 * early(0), "{widths:?}");
    assert!(widths[1].last().unwrap() * 4 <= widths[1][20], "{widths:?}");
    assert!(widths.iter().flatten().all(|width| width % 8 == 0));
}

#[test]
fn numbers_out_of_range_are_refused_with_their_limit() {
    let mut farm = Farm::new();
    let message = |actions: Vec<Action>| match &actions[..] {
        [Action::ShotFailed { reason, .. }] => reason.to_string(),
        other => panic!("{other:?}"),
    };
    let range = format!("the number of frames is 0; choose 1 to {MAX_FRAMES}");
    assert_eq!(message(farm.submit(1, 0, 0, 1)), range);
    assert!(message(farm.submit(1, 1, 0, 0)).contains("in flight"));
    for side in [0, 1, u32::MAX] {
        assert!(message(farm.submit_split(1, 1, 0, 1, Split::Tiles(side))).contains("tile"));
    }
}

#[test]
fn a_full_queue_of_endless_shots_costs_nothing_before_they_begin() {
    let mut farm = Farm::new();
    for shot in 0..MAX_SHOTS as u64 {
        // With a byte for each frame this would be 256 MiB.
        assert!(farm.submit(shot, MAX_FRAMES, 0, MAX_FRAMES_IN_FLIGHT).is_empty());
    }
    let refused = farm.submit(9999, 1, 0, 1);
    let full = ShotFailure::QueueFull;
    assert_eq!(refused, [Action::ShotFailed { shot: ShotId(9999), reason: full }]);
}

#[test]
fn a_shot_that_cannot_go_on_does_not_stop_its_equals() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.join(2, 1);
    // Of one, frames are never taken; of the other, worker 1 fails at everything.
    farm.submit_split(1, 100, 0, 1, Split::Tiles(640));
    farm.submit_split(2, 100, 0, 200, Split::Tiles(640));
    farm.submit_split(3, 100, 0, 200, Split::Tiles(640));
    let mut accepted = [0; 4];
    for _ in 0..100 {
        let Some(job) = farm.grants.pop_front() else { break };
        farm.now += 5;
        if job.shot == ShotId(2) && job.worker == WorkerId(1) {
            farm.fail(job);
        } else {
            farm.done(job, 5);
            accepted[job.shot.0 as usize] += 1;
        }
    }
    assert_eq!(accepted[1], 1, "its only frame in flight");
    assert!(accepted[2] > 30 && accepted[3] > 30, "{accepted:?}");
}

#[test]
fn a_frame_that_is_not_done_has_a_reason() {
    let mut farm = Farm::new();
    let (shot, other) = (ShotId(1), ShotId(2));
    let why = |farm: &Farm, frame| farm.scheduler.why(shot, frame);
    assert_eq!(why(&farm, 0), Why::NotUnderWay);
    farm.submit_split(1, 5, 0, 2, Split::Tiles(640));
    assert_eq!(why(&farm, 5), Why::NoSuchFrame);
    assert_eq!(why(&farm, 0), Why::NoWorker);
    farm.join(1, 1);
    let workers = vec![WorkerId(1)];
    assert_eq!(why(&farm, 0), Why::Running { jobs: 1, workers, waiting: 0 });
    assert_eq!(why(&farm, 3), Why::WindowFull { open: 2, untaken: 0, limit: 2 });
    assert!(why(&farm, 0).to_string().contains("1 job runs on"), "{}", why(&farm, 0));
    let first = farm.next_of(1).unwrap();
    farm.done(first, 5);
    assert_eq!(why(&farm, 0), Why::NotTaken);
    farm.tell(Event::FrameTaken { shot, frame: 0 });
    assert_eq!(why(&farm, 0), Why::Over);
    farm.tell(Event::ShotPaused { shot });
    assert_eq!((why(&farm, 1), farm.scheduler.is_paused(shot)), (Why::Paused, true));
    farm.tell(Event::ShotPrioritised { shot, priority: -3 });
    assert_eq!(farm.scheduler.priority(shot), Some(-3));
    farm.grants.clear();
    farm.submit(2, 50, 0, 8);
    farm.tell(Event::ShotResumed { shot });
    assert_eq!(why(&farm, 1), Why::Outranked { by: other });
    assert_eq!(farm.scheduler.blocked(WorkerId(1)), []);
    assert_eq!(farm.scheduler.heard_at(WorkerId(1)), Some(Micros(farm.now)));
    assert_eq!(farm.scheduler.heard_at(WorkerId(2)), None);
    assert_eq!(farm.scheduler.speed_of(WorkerId(1)), Some(1.0));
    farm.tell(Event::WorkerDraining { worker: WorkerId(1) });
    assert!(farm.scheduler.is_draining(WorkerId(1)));
    assert_eq!(why(&farm, 4), Why::NoWorker);
}

#[test]
fn a_job_that_waits_after_a_failure_names_who_failed() {
    let mut farm = Farm::new();
    farm.join(1, 1);
    farm.join(2, 1);
    farm.submit_split(1, 4, 0, 4, Split::Tiles(640));
    let failed = farm.next_of(1).unwrap();
    farm.fail(failed);
    let expected = Why::Retrying { jobs: 1, failed_on: vec![WorkerId(1)] };
    assert_eq!(farm.scheduler.why(failed.shot, failed.frame), expected);
    assert!(expected.to_string().contains("1 job waits after failing on"), "{expected}");
}

fn any_event() -> impl Strategy<Value = Event> {
    let worker = || (1u64..6).prop_map(WorkerId);
    let lease = || prop_oneof![9 => 0u64..80, 1 => any::<u64>()].prop_map(LeaseId);
    let shot = || (1u64..4).prop_map(ShotId);
    let cost = prop_oneof![0u64..2 * SECOND, any::<u64>()];
    let split = prop_oneof![Just(Split::Columns), (0u32..40).prop_map(Split::Tiles)];
    prop_oneof![
        3 => (worker(), any::<u32>()).prop_map(|(worker, threads)| Event::WorkerJoined { worker, threads }),
        1 => worker().prop_map(|worker| Event::WorkerLost { worker, why: LostReason::Left }),
        1 => worker().prop_map(|worker| Event::WorkerDraining { worker }),
        1 => (worker(), prop::collection::vec(lease(), 0..5)).prop_map(|(worker, leases)| Event::HandedBack { worker, leases }),
        2 => (shot(), 0u32..6, 0u32..90, 0u32..40, split, -1i32..2, 0u32..4, any::<bool>()).prop_map(
            |(shot, frames, width, height, split, priority, frames_in_flight, live)| {
                Event::ShotSubmitted {
                    shot, frames, width, height, split, priority, frames_in_flight, live,
                }
            }),
        12 => (worker(), lease(), cost, 0u64..2).prop_map(|(worker, lease, cost_us, digest)| {
            Event::JobDone { worker, lease, cost_us, digest }
        }),
        4 => (worker(), lease()).prop_map(|(worker, lease)| Event::JobFailed { worker, lease, reason: "bad".into() }),
        3 => (shot(), 0u32..6).prop_map(|(shot, frame)| Event::FrameTaken { shot, frame }),
        1 => shot().prop_map(|shot| Event::ShotCanceled { shot }),
        1 => shot().prop_map(|shot| Event::ShotPaused { shot }),
        1 => shot().prop_map(|shot| Event::ShotResumed { shot }),
        1 => (shot(), -1i32..2).prop_map(|(shot, priority)| Event::ShotPrioritised { shot, priority }),
        1 => (worker(), prop::option::of(shot())).prop_map(|(worker, shot)| Event::WorkerCleared { worker, shot }),
        1 => worker().prop_map(|worker| Event::WorkerDistrusted { worker }),
        1 => (worker(), any::<u64>()).prop_map(|(worker, pixels_per_s)| {
            Event::WorkerMeasured { worker, pixels_per_s }
        }),
        2 => worker().prop_map(|worker| Event::HeardFrom { worker }),
        2 => Just(Event::Tick),
    ]
}

fn any_story() -> impl Strategy<Value = Vec<(u64, Event)>> {
    let step = prop_oneof![8 => 0u64..SECOND / 4, 1 => 0u64..20 * SECOND, 1 => Just(u64::MAX)];
    prop::collection::vec((step, any_event()), 0..120)
}

proptest! {
    #[test]
    fn no_story_panics_or_breaks_an_invariant(story in any_story(), audit in 0u32..1_000_000) {
        let audit = Share::from_millionths(audit).unwrap();
        let config = Config { audit, ..Config::default() };
        let mut farm = Farm { scheduler: Scheduler::new(config, 1), ..Farm::new() };
        for (step, event) in story {
            // Time may also stand still, or jump to its end.
            farm.now = farm.now.saturating_add(step);
            let is_result = matches!(event, Event::JobDone { .. });
            let actions = farm.tell(event);
            let verdicts = actions.iter().filter(|action| {
                matches!(
                    action,
                    Action::Accept { .. } | Action::Refuse { .. } | Action::Compared { .. }
                )
            });
            prop_assert_eq!(verdicts.count(), usize::from(is_result));
            // A late copy may be examined in portions, but not for ever.
            for _ in 0..100 {
                if farm.scheduler.next_deadline().is_none_or(|at| at.0 > farm.now) {
                    break;
                }
                farm.tell(Event::Tick);
            }
            let deadline = farm.scheduler.next_deadline();
            prop_assert!(farm.now == u64::MAX || deadline.is_none_or(|at| at.0 > farm.now));
        }
    }

    #[test]
    fn the_same_story_has_the_same_end(story in any_story(), seed in any::<u64>()) {
        let play = || {
            let mut scheduler = Scheduler::new(Config::default(), seed);
            let mut now = 0u64;
            let mut told = Vec::new();
            for (step, event) in &story {
                now = now.saturating_add(*step);
                scheduler.handle(Micros(now), event.clone());
                told.extend(std::iter::from_fn(|| scheduler.poll_action()));
                told.push(Action::Probe { worker: WorkerId(u64::MAX) });
            }
            (told, scheduler.next_deadline(), scheduler.account())
        };
        prop_assert_eq!(play(), play());
    }

    #[test]
    fn any_story_on_record_replays_to_the_same_actions(story in any_story(), seed in any::<u64>()) {
        let config = Config::default();
        let mut scheduler = Scheduler::new(config.clone(), seed);
        let mut recorder = Recorder::begin(Vec::new(), &config, seed, JOURNAL_BYTES).unwrap();
        let (mut now, mut asked, events) = (0u64, 0, story.len() as u64);
        for (step, event) in story {
            now = now.saturating_add(step);
            recorder.handle(&mut scheduler, Micros(now), event).unwrap();
            // The owner may fetch what is asked for later, and some of it.
            if !now.is_multiple_of(3) {
                asked += std::iter::from_fn(|| scheduler.poll_action()).take(3).count() as u64;
            }
        }
        asked += std::iter::from_fn(|| scheduler.poll_action()).count() as u64;
        recorder.finish().unwrap();
        let report = replay(&*recorder.into_inner()).unwrap();
        prop_assert_eq!(&report.first_difference, &None);
        prop_assert_eq!((report.proved, report.actions), (events, asked));
        prop_assert_eq!(report.account, scheduler.account());
        prop_assert!(report.invariants.is_clean(), "{:?}", report.first_violation);
    }
}
