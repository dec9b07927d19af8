//! How many jobs a second go through the scheduler alone: 1000 workers, or as many as are
//! asked for, that answer at once; with `journal`, while a journal of it is written.
//! `cargo run --release -p terrafarm-sched --example throughput [WORKERS] [journal]`

use std::collections::VecDeque;
use std::time::Instant;
use terrafarm_common::id::{ShotId, WorkerId};
use terrafarm_common::region::Split;
use terrafarm_sched::journal::{JOURNAL_BYTES, Recorder};
use terrafarm_sched::{Action, Config, Event, Micros, Scheduler};

const WORKERS: u64 = 1000;
const SEED: u64 = 1;
const FRAMES: u32 = 5_000;
/// Time of a job, microseconds: long enough that every job is one strip of columns.
const JOB_US: u64 = 200_000;

fn main() {
    let mut words = std::env::args().skip(1).peekable();
    let workers = words.next_if(|word| word != "journal");
    let workers = workers.map_or(WORKERS, |word| word.parse().expect("a number of workers"));
    let mut journal = words.next().map(|_| {
        Recorder::begin(std::io::sink(), &Config::default(), SEED, JOURNAL_BYTES)
            .expect("nothing is written")
    });
    let mut scheduler = Scheduler::new(Config::default(), SEED);
    let mut events = 0u64;
    let mut tell = |scheduler: &mut Scheduler, now, event| {
        events += 1;
        match &mut journal {
            Some(journal) => journal.handle(scheduler, Micros(now), event).expect("it has room"),
            None => scheduler.handle(Micros(now), event),
        }
    };
    for worker in 1..=workers {
        let joined = Event::WorkerJoined { worker: WorkerId(worker), threads: 1 };
        tell(&mut scheduler, 0, joined);
    }
    let began = Instant::now();
    tell(
        &mut scheduler,
        0,
        Event::ShotSubmitted {
            shot: ShotId(1),
            frames: FRAMES,
            width: 1920,
            height: 1080,
            split: Split::Columns,
            priority: 0,
            // Twice 240 strips for every 240 workers, and some.
            frames_in_flight: 32.max((workers / 100) as u32),
            live: false,
        },
    );
    let mut answers = VecDeque::new();
    let mut now = 0;
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
            tell(&mut scheduler, now, Event::FrameTaken { shot, frame });
        }
        if is_over {
            break;
        }
        let Some((at, worker, lease)) = answers.pop_front() else { continue };
        now = at.max(now);
        tell(&mut scheduler, now, Event::JobDone { worker, lease, cost_us: JOB_US, digest: 0 });
    }
    let jobs = scheduler.account().accepted;
    let seconds = began.elapsed().as_secs_f64();
    let (job_rate, event_rate) = (jobs as f64 / seconds, events as f64 / seconds);
    println!("{workers} workers: {jobs} jobs in {seconds:.2} s");
    println!("{job_rate:.0} jobs/s, {event_rate:.0} events/s");
}
