//! What a journal promises.

#![allow(clippy::unwrap_used)]

use super::record::{self, Record, write};
use super::*;
use crate::config::Config;
use crate::event::{Action, Event, Micros};
use crate::scheduler::Scheduler;
use proptest::prelude::*;
use terrafarm_common::id::{ShotId, WorkerId};
use terrafarm_common::region::Split;

fn joined(worker: u64) -> Event {
    Event::WorkerJoined { worker: WorkerId(worker), threads: 4 }
}

fn submitted() -> Event {
    Event::ShotSubmitted {
        shot: ShotId(1),
        frames: 3,
        width: 640,
        height: 100,
        split: Split::Columns,
        priority: -1,
        frames_in_flight: 2,
        live: true,
    }
}

/// A journal of a farm in which each job is done after a tenth of a second.
fn night(workers: u64) -> Vec<u8> {
    let mut scheduler = Scheduler::new(Config::default(), 7);
    let mut journal = Recorder::begin(Vec::new(), &Config::default(), 7, JOURNAL_BYTES).unwrap();
    let mut told: Vec<Event> = (1..=workers).map(joined).chain([submitted()]).collect();
    told.reverse();
    let mut now = 0;
    while let Some(event) = told.pop() {
        journal.handle(&mut scheduler, Micros(now), event).unwrap();
        now += 100_000;
        while let Some(action) = scheduler.poll_action() {
            let answer = match action {
                Action::Grant { worker, lease, .. } => {
                    Event::JobDone { worker, lease, cost_us: 90_000, digest: 5 }
                }
                Action::FrameComplete { shot, frame } => Event::FrameTaken { shot, frame },
                _ => continue,
            };
            told.insert(0, answer);
        }
    }
    journal.finish().unwrap();
    journal.into_inner()
}

/// Where each record of a journal begins, and its content.
fn records(journal: &[u8]) -> Vec<(usize, Record<Event>)> {
    let (mut at, mut found) = (MAGIC.len(), Vec::new());
    while at < journal.len() {
        let mut rest = &journal[at..];
        let number = found.len() as u64;
        let (record, bytes) = record::read(&mut rest, number, &mut Vec::new()).unwrap();
        found.push((at, record));
        at += bytes as usize;
    }
    found
}

fn journal_of(records: impl IntoIterator<Item = Record<Event>>) -> Vec<u8> {
    let mut journal = MAGIC.to_vec();
    for (number, record) in records.into_iter().enumerate() {
        write(&record, number as u64, &mut Vec::new(), &mut journal).unwrap();
    }
    journal
}

#[test]
fn a_night_plays_again_to_the_same_actions() {
    let report = replay(&*night(3)).unwrap();
    assert!(report.is_faithful() && report.torn.is_none(), "{report:?}");
    assert_eq!((report.workers, report.frames, report.failed_frames), (3, 3, 0));
    assert_eq!(report.proved, report.events);
    assert_eq!(report.account.granted, report.account.accepted + report.account.revoked);
    assert!(report.events > 50 && report.actions > report.events);
}

#[test]
fn an_event_that_was_changed_is_named() {
    let whole = night(2);
    let mut list: Vec<Record<Event>> =
        records(&whole).into_iter().map(|(_, record)| record).collect();
    // The third event is the submission; now of lower frames.
    let Record::Event { event: Event::ShotSubmitted { height, .. }, .. } = &mut list[3] else {
        panic!("{:?}", list[3]);
    };
    *height = 50;
    let difference = replay(&*journal_of(list)).unwrap().first_difference.unwrap();
    assert_eq!((difference.event, difference.at_us), (3, 200_000));
    assert!(difference.told.contains("height: 50"), "{difference}");
    assert!(difference.asks.contains("Grant"), "{difference}");
}

#[test]
fn other_settings_or_another_mark_are_a_difference_too() {
    let mut list: Vec<Record<Event>> =
        records(&night(2)).into_iter().map(|(_, record)| record).collect();
    let events = list.len() as u64 - 2;
    let Some(Record::Mark { hash, .. }) = list.last_mut() else { panic!() };
    *hash ^= 1 << 40;
    let report = replay(&*journal_of(list)).unwrap();
    assert_eq!(report.first_difference.unwrap().event, events);
    let mut list: Vec<Record<Event>> =
        records(&night(2)).into_iter().map(|(_, record)| record).collect();
    let Record::Start { config, .. } = &mut list[0] else { panic!() };
    config.queue_depth = 3;
    assert!(replay(&*journal_of(list)).unwrap().first_difference.is_some());
}

#[test]
fn a_journal_cut_anywhere_plays_as_far_as_it_goes() {
    let whole = night(2);
    let starts: Vec<usize> = records(&whole).into_iter().map(|(at, _)| at).collect();
    for end in 0..whole.len() {
        let replayed = replay(&whole[..end]);
        // Without the whole of its settings it is none.
        if end < starts[1] {
            assert!(matches!(replayed, Err(ReplayError::NotAJournal)), "{end}");
            continue;
        }
        let report = replayed.unwrap();
        let last = *starts.iter().rfind(|&&start| start <= end).unwrap();
        let torn = (last < end).then(|| Torn { offset: last as u64, bytes: (end - last) as u64 });
        assert_eq!((report.torn, report.first_difference), (torn, None), "{end}");
    }
}

#[test]
fn a_byte_changed_anywhere_is_found_and_its_record_is_named() {
    let whole = night(2);
    let starts: Vec<usize> = records(&whole).into_iter().map(|(at, _)| at).collect();
    for at in 0..whole.len() {
        let mut changed = whole.clone();
        changed[at] ^= 0x11;
        let Some(&start) = starts.iter().rfind(|&&start| start <= at) else {
            assert!(matches!(replay(&*changed), Err(ReplayError::NotAJournal)));
            continue;
        };
        match replay(&*changed) {
            Err(ReplayError::Corrupt { offset, .. }) => assert_eq!(offset, start as u64),
            other => panic!("byte {at}: {other:?}"),
        }
    }
}

#[test]
fn records_that_are_missing_swapped_or_doubled_are_found() {
    let whole = night(2);
    let starts: Vec<usize> = records(&whole).into_iter().map(|(at, _)| at).collect();
    let (a, b, c) = (starts[4], starts[5], starts[6]);
    let missing = [&whole[..a], &whole[b..]].concat();
    let doubled = [&whole[..b], &whole[a..]].concat();
    let swapped = [&whole[..a], &whole[b..c], &whole[a..b], &whole[c..]].concat();
    for (changed, at) in [(missing, a), (doubled, b), (swapped, a)] {
        match replay(&*changed) {
            Err(ReplayError::Corrupt { offset, .. }) => assert_eq!(offset, at as u64),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn a_record_that_claims_to_be_long_is_refused_before_memory_is_taken() {
    let mut journal = MAGIC.to_vec();
    journal.extend([0xff, 0xff, 0x7f]);
    journal.extend(record::check_of_length((1 << 21) - 1, 0));
    let error = replay(&*journal).unwrap_err();
    assert!(error.to_string().contains("longer than any can be"), "{error}");
    let endless = [&MAGIC[..], &[0xff; 16]].concat();
    let error = replay(&*endless).unwrap_err();
    assert!(matches!(error, ReplayError::Corrupt { offset: 8, .. }), "{error}");
}

#[test]
fn settings_that_no_scheduler_can_work_with_are_refused() {
    let bad = [
        Config { queue_depth: usize::MAX, ..Config::default() },
        Config { lease_factor: f64::NAN, ..Config::default() },
        Config { heartbeat_us: u64::MAX, ..Config::default() },
        Config { live_silence_us: u64::MAX, ..Config::default() },
        Config { max_job_px: 0, ..Config::default() },
    ];
    for config in bad {
        let journal = journal_of([Record::Start { build: "x".into(), config, seed: 1 }]);
        assert!(matches!(replay(&*journal), Err(ReplayError::Setting { .. })));
    }
}

#[test]
fn a_full_journal_ends_with_a_mark_and_the_farm_works_on() {
    let mut scheduler = Scheduler::new(Config::default(), 7);
    let mut journal = Recorder::begin(Vec::new(), &Config::default(), 7, 400).unwrap();
    let mut ends = 0;
    for worker in 1..=100 {
        let told = journal.handle(&mut scheduler, Micros(worker), joined(worker));
        ends += u32::from(told.is_err());
    }
    assert_eq!((ends, scheduler.workers()), (1, 100), "said once, told always");
    journal.finish().unwrap();
    let bytes = journal.into_inner();
    assert!((336..=400).contains(&bytes.len()), "{}", bytes.len());
    let report = replay(&*bytes).unwrap();
    assert!(report.is_faithful() && report.torn.is_none(), "{report:?}");
    assert!(report.events > 10 && report.proved == report.events);
}

#[test]
fn an_event_too_long_for_a_record_ends_the_journal_cleanly() {
    let mut scheduler = Scheduler::new(Config::default(), 7);
    let mut journal = Recorder::begin(Vec::new(), &Config::default(), 7, JOURNAL_BYTES).unwrap();
    journal.handle(&mut scheduler, Micros(5), joined(1)).unwrap();
    let (worker, lease) = (WorkerId(1), terrafarm_common::id::LeaseId(1));
    let reason = "x".repeat(70_000);
    let failed = Event::JobFailed { worker, lease, reason };
    let error = journal.handle(&mut scheduler, Micros(6), failed).unwrap_err();
    assert!(matches!(error, crate::journal::Stopped::TooLong), "{error}");
    assert_eq!(replay(&*journal.into_inner()).unwrap().proved, 1);
}

#[test]
fn a_disk_that_is_full_ends_the_journal_and_not_the_farm() {
    let mut disk = [0; 200];
    let mut scheduler = Scheduler::new(Config::default(), 7);
    let mut journal = Recorder::begin(&mut disk[..], &Config::default(), 7, JOURNAL_BYTES).unwrap();
    let mut errors = 0;
    for worker in 1..=100 {
        let now = Micros(worker * 1_000_000);
        errors += u32::from(journal.handle(&mut scheduler, now, joined(worker)).is_err());
    }
    assert_eq!(errors, 1);
    assert_eq!(scheduler.workers(), 5, "all but those that were silent for 5 s");
    assert!(journal.finish().is_ok());
}

#[test]
fn the_bytes_of_version_2_are_these() {
    let journal = journal_of([
        Record::Start { build: "0.1.0".into(), config: Config::default(), seed: 9 },
        Record::Event { after_us: 300, before: 0, event: joined(1) },
        Record::Event { after_us: 0, before: 0, event: submitted() },
        Record::Event { after_us: 7, before: 0xdead_beef, event: Event::Tick },
        Record::Mark { events: 3, actions: 5, hash: 1 << 63 },
    ]);
    let hash = xxhash_rust::xxh3::xxh3_64(&journal);
    assert_eq!(
        (journal.len(), hash),
        (130, 5_085_232_544_417_095_315),
        "the layout changed: raise the version"
    );
}

proptest! {
    #[test]
    fn no_bytes_make_the_reader_panic(
        bytes in prop::collection::vec(any::<u8>(), 0..400),
        at in any::<prop::sample::Index>(),
    ) {
        let mut journal = night(1);
        let at = at.index(journal.len());
        let end = (at + bytes.len()).min(journal.len());
        journal[at..end].copy_from_slice(&bytes[..end - at]);
        let _ = replay(&*journal);
        let _ = replay(&*[&MAGIC[..], &bytes].concat());
    }
}
