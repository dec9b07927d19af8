//! What equals get of a farm.

#![allow(clippy::unwrap_used)]

mod world;

use std::collections::BTreeMap;
use terrafarm_common::id::ShotId;
use terrafarm_sched::*;
use world::{SECOND, World};

/// Work done for each shot so far.
fn worked(world: &World) -> BTreeMap<ShotId, f64> {
    let mut sums = BTreeMap::new();
    for machine in world.machines.values() {
        for (&shot, &work) in &machine.worked {
            *sums.entry(shot).or_default() += work;
        }
    }
    sums
}

/// The share of every shot in what the farm does in the next seconds.
fn shares(world: &mut World, seconds: u64) -> Vec<f64> {
    let before = worked(world);
    world.play(world.now + seconds * SECOND, |_| ());
    let after = worked(world);
    let done = |(shot, sum): (&ShotId, &f64)| sum - before.get(shot).copied().unwrap_or(0.0);
    let all: f64 = after.iter().map(done).sum();
    after.iter().map(|entry| done(entry) / all).collect()
}

fn mixed_farm(workers: u64) -> World {
    let mut world = World::new(Config::default());
    for worker in 1..=workers {
        world.join(worker, 4, 0.5 + (worker % 8) as f64 * 0.5);
    }
    world
}

#[test]
fn three_shots_of_different_costs_get_equal_parts_of_a_mixed_farm() {
    for workers in [3, 31] {
        let mut world = mixed_farm(workers);
        world.submit(1, 1_000_000, 0, 0.5e6);
        world.submit(2, 1_000_000, 0, 4e6);
        world.submit(3, 1_000_000, 0, 32e6);
        world.play(2 * SECOND, |_| ());
        let shares = shares(&mut world, 30);
        println!("{workers} workers: {shares:?}, frames {:?}", world.frames);
        assert!(shares.iter().all(|share| (share - 1.0 / 3.0).abs() < 0.01), "{shares:?}");
    }
}

#[test]
fn a_shot_that_comes_later_or_was_paused_gets_its_part_and_no_more() {
    let mut world = mixed_farm(8);
    world.submit(1, 1_000_000, 0, 4e6);
    world.play(20 * SECOND, |_| ());
    world.submit(2, 1_000_000, 0, 1e6);
    let late = shares(&mut world, 10);
    assert!((late[1] - 0.5).abs() < 0.03, "{late:?}");
    world.tell(Event::ShotPaused { shot: ShotId(1) });
    assert!(shares(&mut world, 20)[1] > 0.99);
    world.tell(Event::ShotResumed { shot: ShotId(1) });
    let resumed = shares(&mut world, 10);
    assert!((resumed[0] - 0.5).abs() < 0.03, "{resumed:?}");
    world.tell(Event::ShotPrioritised { shot: ShotId(2), priority: 1 });
    assert!(shares(&mut world, 5)[1] > 0.99);
    world.tell(Event::ShotPrioritised { shot: ShotId(2), priority: 0 });
    let equal_again = shares(&mut world, 10);
    assert!((equal_again[0] - 0.5).abs() < 0.03, "{equal_again:?}");
}
