//! Whatever is killed, the film is the same and nothing finished is rendered again.

use crate::support::{Running, World, coordinator_on, frame_hashes, succeed, worker};

/// Where things are killed: the same places in every run of this test.
const SEED: u64 = 0x7e44_afa4;
/// kill -9 of workers and of the coordinator.
const KILLS: usize = 20;
/// At most so many jobs between one kill and the next.
const JOBS_MAX: u64 = 25;

/// A small generator of its own: these tests must be able to repeat themselves.
struct Dice(u64);

impl Dice {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (self.0 >> 33) % limit
    }
}

#[test]
fn twenty_kills_of_workers_and_coordinator_change_no_frame() {
    let size = ["--size", "192x108", "--fps", "60"];
    let world = World::new(300);
    let calm = world.dir.path("calm");
    succeed(world.render().args(size).args(["--workers", "2", "--threads", "1", "-o"]).arg(&calm));
    let calm = frame_hashes(&calm.join("manifest.json"));

    let (mut coordinator, address) = coordinator_on("127.0.0.1:0");
    let mut workers = [worker(&address, "one"), worker(&address, "two")];
    let output = world.dir.path("farm");
    let render = Running::start(
        world
            .render()
            .args(size)
            .args(["--split", "tiles:32", "--coordinator", &address, "-o"])
            .arg(&output),
    );
    let submitted = |coordinator: &mut Running| -> usize {
        let line = coordinator.expect("shot submitted");
        let frames = line.split_once("frames=").unwrap().1;
        frames.split(|c: char| !c.is_ascii_digit()).next().unwrap().parse().unwrap()
    };
    assert_eq!(submitted(&mut coordinator), calm.len());
    let mut dice = Dice(SEED);
    let (mut left, mut restarts) = (calm.len(), 0);
    for kill in 0..KILLS {
        // In the middle of things: a job has just begun somewhere.
        let busy = dice.below(2) as usize;
        for _ in 0..=dice.below(JOBS_MAX) {
            workers[busy].expect("job begins");
        }
        match dice.below(3) {
            0 => {
                coordinator.kill();
                coordinator = coordinator_on(&address).0;
                restarts += 1;
                let again = submitted(&mut coordinator);
                assert!(again <= left, "{again} frames of {left} after kill {kill}");
                left = again;
            }
            victim => {
                let victim = victim as usize - 1;
                workers[victim].kill();
                workers[victim] = worker(&address, ["one", "two"][victim]);
            }
        }
    }
    assert!(restarts >= 3 && left < calm.len(), "{restarts} restarts, {left} frames left");
    let (code, lines) = render.finish();
    assert_eq!(code, Some(0), "{lines:#?}");
    assert_eq!(frame_hashes(&output.join("manifest.json")), calm);
}
