//! How many jobs a second go through the scheduler alone: 1000 workers that answer at
//! once. `cargo run --release -p terrafarm-sched --example throughput`

use std::collections::VecDeque;
use std::time::Instant;
use terrafarm_common::id::{ShotId, WorkerId};
use terrafarm_common::region::Split;
use terrafarm_sched::{Action, Config, Event, Micros, Scheduler};

const WORKERS: u64 = 1000;
const FRAMES: u32 = 5_000;
/// Time of a job, microseconds: long enough that every job is one strip of columns.
const JOB_US: u64 = 200_000;

fn main() {
    let mut scheduler = Scheduler::new(Config::default(), 1);
    for worker in 1..=WORKERS {
        scheduler.handle(Micros(0), Event::WorkerJoined { worker: WorkerId(worker), threads: 1 });
    }
    scheduler.handle(
        Micros(0),
        Event::ShotSubmitted {
            shot: ShotId(1),
            frames: FRAMES,
            width: 1920,
            height: 1080,
            split: Split::Columns,
            priority: 0,
            frames_in_flight: 32,
        },
    );
    let mut answers = VecDeque::new();
    let mut now = 0;
    let began = Instant::now();
    loop {
        let mut is_over = false;
        let mut taken = Vec::new();
        while let Some(action) = scheduler.poll_action() {
            match action {
                Action::Grant { worker, lease, .. } => {
                    // The one before it at the same worker is done first.
                    answers.push_back((now + 2 * JOB_US, worker, lease));
                }
                Action::FrameComplete { shot, frame } => taken.push((shot, frame)),
                Action::ShotComplete { .. } => is_over = true,
                _ => {}
            }
        }
        for (shot, frame) in taken {
            scheduler.handle(Micros(now), Event::FrameTaken { shot, frame });
        }
        if is_over {
            break;
        }
        let Some((at, worker, lease)) = answers.pop_front() else { continue };
        now = at.max(now);
        scheduler.handle(Micros(now), Event::JobDone { worker, lease, cost_us: JOB_US, digest: 0 });
    }
    let jobs = scheduler.account().accepted;
    let seconds = began.elapsed().as_secs_f64();
    println!("{jobs} jobs in {seconds:.2} s: {:.0} jobs/s", jobs as f64 / seconds);
}
