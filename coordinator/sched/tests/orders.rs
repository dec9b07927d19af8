//! How soon the workers obey an order, and what it costs.

#![allow(clippy::unwrap_used)]

mod world;

use proptest::prelude::*;
use terrafarm_common::id::ShotId;
use terrafarm_sched::*;
use world::{SECOND, World};

/// A farm of mixed workers, busy with a shot of priority 0 whose jobs have their full size.
fn busy(workers: u64) -> World {
    let mut world = World::new(Config::default());
    for worker in 1..=workers {
        world.join(worker, 4, 1.0 + (worker % 4) as f64);
    }
    world.submit(1, 100_000, 0, 4e6);
    world.play(5 * SECOND, |_| ());
    world
}

/// Plays on after an order; the last time at which a worker rendered another shot than
/// this one, microseconds after the order. The two messages are counted.
fn obeyed_after(world: &mut World, shot: u64) -> u64 {
    let ordered_at = world.now;
    let mut last = ordered_at;
    world.play(ordered_at + SECOND, |world| {
        let busy = |machine: &world::Machine| machine.running.map(|(job, ..)| job.shot);
        if world.machines.values().any(|machine| busy(machine) != Some(ShotId(shot))) {
            last = world.now;
        }
    });
    last - ordered_at
}

#[test]
fn a_more_urgent_shot_runs_everywhere_within_100_ms_of_its_submission() {
    let mut world = busy(16);
    world.submit(2, 100_000, 5, 4e6);
    let after_us = obeyed_after(&mut world, 2);
    println!("submission obeyed after {after_us} us");
    assert!(after_us <= YIELD_US + 2 * world.wire_us, "{after_us}");
}

#[test]
fn a_resumed_or_reprioritised_shot_runs_everywhere_within_100_ms() {
    let mut world = busy(16);
    let shot = ShotId(2);
    world.submit(2, 100_000, 5, 4e6);
    world.tell(Event::ShotPaused { shot });
    world.play(8 * SECOND, |_| ());
    world.tell(Event::ShotResumed { shot });
    assert!(obeyed_after(&mut world, 2) <= YIELD_US + 2 * world.wire_us);
    world.tell(Event::ShotPrioritised { shot: ShotId(1), priority: 6 });
    assert!(obeyed_after(&mut world, 1) <= YIELD_US + 2 * world.wire_us);
    // Less of one is more of the other.
    world.tell(Event::ShotPrioritised { shot: ShotId(1), priority: 4 });
    assert!(obeyed_after(&mut world, 2) <= YIELD_US + 2 * world.wire_us);
}

#[test]
fn a_shot_that_stops_is_gone_from_the_workers_after_one_message() {
    for order in [Event::ShotPaused { shot: ShotId(1) }, Event::ShotCanceled { shot: ShotId(1) }] {
        let mut world = busy(16);
        world.tell(order);
        let wire_us = world.wire_us;
        world.play(world.now + wire_us + 1, |_| ());
        let holds = |machine: &world::Machine| machine.running.is_some();
        assert!(!world.machines.values().any(holds));
    }
}

#[test]
fn what_was_accepted_of_a_frame_is_not_rendered_again_after_an_order() {
    let mut world = busy(4);
    let before: f64 = world.machines.values().map(|machine| machine.wasted).sum();
    assert_eq!(before, 0.0);
    world.submit(2, 3, 5, 4e6);
    world.play(world.now + 60 * SECOND, |_| ());
    // Each worker loses at most what it was rendering.
    let wasted: f64 = world.machines.values().map(|machine| machine.wasted).sum();
    assert!(wasted > 0.0 && wasted <= 4.0 * 4.0 * 0.3 * SECOND as f64, "{wasted}");
    assert_eq!(world.frames[&ShotId(2)], 3);
}

#[test]
fn a_small_urgent_shot_takes_no_more_workers_than_it_has_jobs_for() {
    let mut world = busy(64);
    // Its only frame has two strips of 8 columns.
    world.px_us.insert(ShotId(2), 1.0);
    world.tell(Event::ShotSubmitted {
        shot: ShotId(2),
        frames: 1,
        width: 16,
        height: 100,
        split: Default::default(),
        priority: 1,
        frames_in_flight: 1,
        live: false,
    });
    // One running job and one that was queued behind it, of each.
    assert!(world.scheduler.account().preempted <= 4, "{:?}", world.scheduler.account());
}

#[test]
fn a_running_job_that_is_nearly_done_may_end_and_one_that_is_late_may_not() {
    let mut world = busy(1);
    // A hundred times as costly from now on: whatever is expected, it takes longer.
    *world.px_us.get_mut(&ShotId(1)).unwrap() *= 100.0;
    world.play(world.now + SECOND, |_| ());
    world.submit(2, 1000, 1, 4e6);
    assert!(obeyed_after(&mut world, 2) <= YIELD_US + 2 * world.wire_us);
}

fn any_order() -> impl Strategy<Value = (u64, Event)> {
    let shot = || (1u64..4).prop_map(ShotId);
    let order = prop_oneof![
        3 => (shot(), 0i32..4).prop_map(|(shot, priority)| Event::ShotPrioritised { shot, priority }),
        1 => shot().prop_map(|shot| Event::ShotPaused { shot }),
        2 => shot().prop_map(|shot| Event::ShotResumed { shot }),
    ];
    (0u64..SECOND / 2, order)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn after_any_orders_the_most_urgent_runs_everywhere_and_little_is_thrown_away(
        workers in 1u64..9, orders in prop::collection::vec(any_order(), 1..12),
    ) {
        let mut world = World::new(Config::default());
        let mut able = 0.0;
        for worker in 1..=workers {
            let speed = 1.0 + (worker % 3) as f64;
            able += speed;
            world.join(worker, 4, speed);
        }
        let mut state = Vec::new();
        for shot in 1..4 {
            world.submit(shot, 100_000, 0, 3e6);
            state.push((0, false));
        }
        world.play(3 * SECOND, |_| ());
        let wasted_before: f64 = world.machines.values().map(|machine| machine.wasted).sum();
        let count = orders.len() as f64;
        for (pause, order) in orders {
            world.play(world.now + pause, |_| ());
            match order {
                Event::ShotPrioritised { shot, priority } => state[shot.0 as usize - 1].0 = priority,
                Event::ShotPaused { shot } => state[shot.0 as usize - 1].1 = true,
                Event::ShotResumed { shot } => state[shot.0 as usize - 1].1 = false,
                _ => {}
            }
            world.tell(order);
        }
        let limit = world.now + YIELD_US + 2 * world.wire_us;
        world.play(limit + 1, |_| ());
        let most = state.iter().filter(|shot| !shot.1).map(|shot| shot.0).max();
        for machine in world.machines.values() {
            let running = machine.running.map(|(job, ..)| state[job.shot.0 as usize - 1].0);
            prop_assert_eq!(running, most);
        }
        // An order costs each worker one running job at most: a quarter of a second, or a
        // little more where it was mispredicted.
        let wasted: f64 = world.machines.values().map(|machine| machine.wasted).sum();
        let bound = count * able * 0.4 * SECOND as f64;
        prop_assert!(wasted - wasted_before <= bound, "{} of {}", wasted - wasted_before, bound);
    }
}
