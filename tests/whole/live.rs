//! A live render: somebody waits for each frame, and a worker that freezes is noticed within
//! half a second.

use crate::support::{Running, World, coordinator, frame_hashes, succeed, worker};
use std::path::Path;
use std::time::{Duration, Instant};

/// What `render --live` promises.
const NOTICED: Duration = Duration::from_millis(500);
/// A worker that goes on comes back within this time: its first pause is half of it.
const BACK: Duration = Duration::from_millis(1000);
/// Where other programs hold the cores, a coordinator that is late itself does not blame the
/// workers, and these tests are late to see it: one attempt of so many has to be in time.
/// Without the promise none ever is: silence lasts five seconds.
const ATTEMPTS: u32 = 8;
/// By the usual rule it would be noticed after five seconds.
const AT_LAST: Duration = Duration::from_secs(10);

/// A render of some seconds for one worker.
fn render(world: &World) -> std::process::Command {
    let mut command = world.render();
    command.args(["--size", "320x180", "--fps", "10", "--samples", "2", "--split", "tiles:32"]);
    command
}

/// What came of one worker that was stopped in the middle of a job.
struct Attempt {
    /// From the signal to the line in the coordinator's log.
    noticed: Duration,
    /// Since the coordinator had last heard of it, by its own clock.
    silence: Duration,
    /// From the signal to go on to its return.
    back: Duration,
}

impl Attempt {
    fn is_in_time(&self) -> bool {
        self.noticed <= NOTICED && self.silence <= NOTICED && self.back <= BACK
    }
}

/// Stops a worker with SIGSTOP while it renders for the shot of this number, and lets it go
/// on when it is dropped. `None` if the shot was over before that, or the worker gone.
fn freeze(coordinator: &mut Running, frozen: &mut Running, shot: &str) -> Option<Attempt> {
    // A worker that waits for no word between two jobs of other shots is no test.
    frozen.expect_within(&format!("shot={shot} "), AT_LAST)?;
    let stopped = Instant::now();
    frozen.signal("STOP");
    let dropped = loop {
        let left = AT_LAST.saturating_sub(stopped.elapsed());
        match coordinator.expect_within("worker dropped: silent", left) {
            // This machine may be so busy that the other one is late, too.
            Some(line) if !line.contains("name=frozen") => {}
            dropped => break dropped,
        }
    };
    let noticed = stopped.elapsed();
    let began = Instant::now();
    frozen.signal("CONT");
    let us = dropped?.split_once("silent for ")?.1.split(' ').next()?.parse().ok()?;
    coordinator.expect_within("name=frozen", AT_LAST)?;
    Some(Attempt { noticed, silence: Duration::from_micros(us), back: began.elapsed() })
}

#[test]
fn a_worker_that_freezes_is_noticed_within_half_a_second_of_a_live_render() {
    let world = World::new(300);
    let calm = world.dir.path("calm");
    succeed(render(&world).args(["--workers", "2", "--threads", "1", "-o"]).arg(&calm));
    let calm = frame_hashes(&calm.join("manifest.json"));
    let (mut farm, address) = coordinator();
    let mut frozen = worker(&address, "frozen");
    let _other = worker(&address, "other");
    // In any order.
    farm.expect("worker joined");
    farm.expect("worker joined");
    let mut seen = Vec::new();
    for attempt in 0..ATTEMPTS {
        let output = world.dir.path(&format!("film-{attempt}"));
        let mut command = render(&world);
        command.args(["--live", "--coordinator", &address, "-o"]).arg(&output);
        let running = Running::start(&mut command);
        let line = farm.expect("shot submitted");
        assert!(line.contains("live=true"), "{line}");
        let shot = line.split_once("shot=").unwrap().1.split(' ').next().unwrap().to_owned();
        let came = freeze(&mut farm, &mut frozen, &shot);
        let (code, lines) = running.finish();
        assert_eq!(code, Some(0), "{lines:#?}");
        assert!(is_the_same(&output, &calm), "attempt {attempt}");
        if let Some(came) = came {
            let Attempt { noticed, silence, back } = came;
            println!("noticed after {noticed:?}, silent for {silence:?}, back after {back:?}");
            if came.is_in_time() {
                return;
            }
            seen.push((noticed, silence, back));
        }
    }
    panic!("never in time: {seen:?}");
}

fn is_the_same(output: &Path, expected: &[String]) -> bool {
    frame_hashes(&output.join("manifest.json")) == expected
}
