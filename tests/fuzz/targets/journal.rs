//! Journals of the scheduler. First byte: a journal's bytes as they are, or settings and
//! events, of which a journal is made whose check sums are right. What was recorded plays
//! again to the same actions.

#![no_main]

use terrafarm_common::id::{LeaseId, ShotId, WorkerId};
use terrafarm_common::region::Split;
use terrafarm_sched::journal::{Recorder, replay};
use terrafarm_sched::{Config, Event, Micros, Scheduler};

const RAW: u8 = 0;
const MADE: u8 = 1;
/// More than enough to come anywhere in the scheduler.
const EVENTS_MAX: usize = 500;
const JOURNAL_BYTES: u64 = 1 << 20;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let night = night();
    let mut made = vec![MADE];
    made.extend(bytes_of(&(Config::default(), 7u64)));
    night.iter().for_each(|event| made.extend(bytes_of(event)));
    let raw = recorded(&Config::default(), 7, &night).expect("the usual settings");
    vec![[&[RAW][..], &raw].concat(), made]
}

fn bytes_of(value: &impl serde::Serialize) -> Vec<u8> {
    postcard::to_extend(value, Vec::new()).expect("memory is there")
}

/// Two workers, a shot, and what may happen.
fn night() -> Vec<(u32, Event)> {
    let (worker, shot) = (WorkerId(1), ShotId(1));
    let submitted = Event::ShotSubmitted {
        shot,
        frames: 3,
        width: 64,
        height: 36,
        split: Split::default(),
        priority: 0,
        frames_in_flight: 2,
        live: true,
    };
    let done = |lease| Event::JobDone { worker, lease: LeaseId(lease), cost_us: 900, digest: 1 };
    let failed = Event::JobFailed { worker, lease: LeaseId(2), reason: "no".to_owned() };
    vec![
        (0, Event::WorkerJoined { worker, threads: 2 }),
        (1, Event::WorkerJoined { worker: WorkerId(2), threads: 1 }),
        (5, submitted),
        (900, done(1)),
        (10, failed),
        (2_000_000, Event::Tick),
        (9_000_000, done(3)),
        (50_000_000, Event::Tick),
    ]
}

fn accepts(input: &[u8]) -> bool {
    match input.split_first() {
        Some((&RAW, journal)) => replay(journal).is_ok(),
        Some((_, described)) => is_the_same_again(described),
        None => false,
    }
}

fn is_the_same_again(described: &[u8]) -> bool {
    let start = postcard::take_from_bytes::<(Config, u64)>(described);
    let Ok(((config, seed), mut rest)) = start else { return false };
    let mut night = Vec::new();
    while night.len() < EVENTS_MAX
        && let Ok((event, after)) = postcard::take_from_bytes::<(u32, Event)>(rest)
    {
        night.push(event);
        rest = after;
    }
    let Some(journal) = recorded(&config, seed, &night) else { return false };
    let report = replay(&journal[..]).expect("it was recorded");
    assert!(report.first_difference.is_none(), "{report:?}");
    assert_eq!(report.invariants, Default::default(), "{:?}", report.first_violation);
    !night.is_empty()
}

/// A journal of these events; `None` with settings that no farm has.
fn recorded(config: &Config, seed: u64, night: &[(u32, Event)]) -> Option<Vec<u8>> {
    let mut journal = Vec::new();
    let mut start = Recorder::begin(&mut journal, config, seed, JOURNAL_BYTES).ok()?;
    start.finish().ok()?;
    replay(&journal[..]).ok()?;
    let mut recorder = Recorder::begin(Vec::new(), config, seed, JOURNAL_BYTES).ok()?;
    let mut scheduler = Scheduler::new(config.clone(), seed);
    let mut now = Micros(0);
    for (after_us, event) in night {
        now = now.after(u64::from(*after_us));
        recorder.handle(&mut scheduler, now, event.clone()).ok()?;
        while scheduler.poll_action().is_some() {}
    }
    recorder.finish().ok()?;
    Some(recorder.into_inner())
}
