//! Plays a journal to a new scheduler and compares what it asks for.

use super::MAGIC;
use super::record::{self, Chain, NoRecord, Record};
use crate::config::Config;
use crate::event::{Action, Event, Micros};
use crate::scheduler::{Account, Scheduler};
use crate::sim::Violations;
use crate::sim::judge::Judge;
use serde::Serialize;
use std::fmt;
use std::io::{self, BufReader, Read};

/// The longest time that a setting of a journal may name, microseconds: a year.
const SETTING_US_MAX: u64 = 365 * 86_400_000_000;
/// The most jobs at one worker that a journal may name.
const HELD_MAX: usize = 4096;
/// Actions of one event that a [`Difference`] spells out.
const ACTIONS_SHOWN: usize = 8;

/// Why a journal cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// When it cannot be read.
    #[error("cannot read the journal: {0}")]
    Read(#[from] io::Error),
    /// When it begins otherwise than any journal of this version.
    #[error("this is no journal of version {}; was it written by another terrafarm?", MAGIC[7])]
    NotAJournal,
    /// When its bytes are not those that were written.
    #[error(
        "the journal is damaged at byte {offset}: {what}; copy it again, or replay an older one"
    )]
    Corrupt {
        /// Where the bad record begins.
        offset: u64,
        /// What is wrong.
        what: &'static str,
    },
    /// When it names a setting that no farm has.
    #[error("the journal's setting {what} is out of range")]
    Setting {
        /// Which.
        what: &'static str,
    },
}

/// A last record that was not written to its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Torn {
    /// Where it begins.
    pub offset: u64,
    /// Bytes of it that are there.
    pub bytes: u64,
}

/// The first event after which the scheduler asked for something else than it did then.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Difference {
    /// Its number, from 1.
    pub event: u64,
    /// Its time, microseconds.
    pub at_us: u64,
    /// The event in words.
    pub told: String,
    /// What the scheduler asks for now, in words; what it asked for then is not on record.
    pub asks: String,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Difference { event, at_us, told, asks } = self;
        let seconds = *at_us as f64 / 1e6;
        write!(f, "at event {event}, {seconds:.6} s, {told}, the scheduler now asks for {asks}")
    }
}

/// What a replay has shown.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReplayReport {
    /// Version of the program that wrote the journal.
    pub build: String,
    /// Seed of the scheduler.
    pub seed: u64,
    /// Events told, until the first difference.
    pub events: u64,
    /// Events whose actions are proved to be the same. One less than `events` where the
    /// journal does not end with a mark.
    pub proved: u64,
    /// Actions asked for.
    pub actions: u64,
    /// Their hash.
    pub hash: u64,
    /// Time of the last event, seconds.
    pub span_s: f64,
    /// The most workers connected at once.
    pub workers: usize,
    /// Frames complete.
    pub frames: u64,
    /// Frames that failed with a reason.
    pub failed_frames: u64,
    /// What became of the leases.
    pub account: Account,
    /// What must not happen, and did: all zero.
    pub invariants: Violations,
    /// The first violation in words.
    pub first_violation: Option<String>,
    /// Where the replay stopped because the actions were not the same.
    pub first_difference: Option<Difference>,
    /// The end that was cut off.
    pub torn: Option<Torn>,
}

impl ReplayReport {
    /// Whether all actions are the same, and nothing happened that must not.
    pub fn is_faithful(&self) -> bool {
        self.first_difference.is_none() && self.invariants.is_clean()
    }
}

/// Tells a new scheduler all that stands in a journal, one record after the other, and
/// watches from outside whether anything happens that must not.
///
/// # Errors
/// If it cannot be read, is none, or is damaged other than by a torn end.
pub fn replay(from: impl Read) -> Result<ReplayReport, ReplayError> {
    let mut from = BufReader::new(from);
    let mut magic = [0; MAGIC.len()];
    match from.read_exact(&mut magic) {
        Ok(()) if magic == MAGIC => {}
        Err(error) if error.kind() != io::ErrorKind::UnexpectedEof => return Err(error.into()),
        _ => return Err(ReplayError::NotAJournal),
    }
    let mut journal = Journal { from, number: 0, offset: MAGIC.len() as u64, scratch: Vec::new() };
    let mut night = match journal.next()? {
        Ok(Record::Start { build, config, seed }) => {
            check(&config)?;
            Night::new(build, &config, seed)
        }
        Ok(_) => return Err(journal.corrupt("its first record is not the settings")),
        Err(_) => return Err(ReplayError::NotAJournal),
    };
    loop {
        match journal.next()? {
            Ok(Record::Event { after_us, before, event }) => {
                if before != night.chain.low() {
                    night.differ();
                    break;
                }
                night.tell(after_us, event);
            }
            Ok(Record::Mark { events, actions, hash }) => {
                if (events, actions, hash) != (night.events, night.chain.actions, night.chain.hash)
                {
                    night.differ();
                    break;
                }
                night.proved = night.events;
            }
            Ok(Record::Start { .. }) => return Err(journal.corrupt("it begins anew")),
            Err(torn) => {
                night.torn = torn;
                break;
            }
        }
    }
    Ok(night.report())
}

/// The records of a journal, and where the last one stood.
struct Journal<R> {
    from: BufReader<R>,
    number: u64,
    offset: u64,
    scratch: Vec<u8>,
}

impl<R: Read> Journal<R> {
    /// The next record, or how the journal ends.
    fn next(&mut self) -> Result<Result<Record<Event>, Option<Torn>>, ReplayError> {
        match record::read(&mut self.from, self.number, &mut self.scratch) {
            Ok((record, bytes)) => {
                self.number += 1;
                self.offset += bytes;
                Ok(Ok(record))
            }
            Err(NoRecord::End) => Ok(Err(None)),
            Err(NoRecord::Torn(bytes)) => Ok(Err(Some(Torn { offset: self.offset, bytes }))),
            Err(NoRecord::Corrupt(what)) => Err(self.corrupt(what)),
            Err(NoRecord::Io(error)) => Err(error.into()),
        }
    }

    fn corrupt(&self, what: &'static str) -> ReplayError {
        ReplayError::Corrupt { offset: self.offset, what }
    }
}

/// Refuses settings with which the scheduler could not work.
fn check(config: &Config) -> Result<(), ReplayError> {
    let times_us = [
        config.job_min_us,
        config.job_max_us,
        config.lease_floor_us,
        config.heartbeat_us,
        config.silence_us,
        config.live_heartbeat_us,
        config.live_silence_us,
    ];
    let is_factor = config.lease_factor >= 0.0 && config.lease_factor <= 1e6;
    let fits = [
        ("queue_depth or max_held", config.queue_depth.max(config.max_held) <= HELD_MAX),
        ("of a time", times_us.iter().all(|&us| us <= SETTING_US_MAX)),
        ("lease_factor", is_factor),
        ("max_job_px", config.max_job_px >= 1),
    ];
    match fits.into_iter().find(|&(_, fits)| !fits) {
        Some((what, _)) => Err(ReplayError::Setting { what }),
        None => Ok(()),
    }
}

/// A night as it is played again.
struct Night {
    build: String,
    seed: u64,
    scheduler: Scheduler,
    judge: Judge,
    chain: Chain,
    now: Micros,
    events: u64,
    proved: u64,
    workers: usize,
    frames: u64,
    failed_frames: u64,
    /// The last event, and what was asked for after it.
    told: Option<Event>,
    asked: Vec<Action>,
    first_difference: Option<Difference>,
    torn: Option<Torn>,
}

impl Night {
    fn new(build: String, config: &Config, seed: u64) -> Self {
        Night {
            build,
            seed,
            scheduler: Scheduler::new(config.clone(), seed),
            judge: Judge::new(config),
            chain: Chain::default(),
            now: Micros(0),
            events: 0,
            proved: 0,
            workers: 0,
            frames: 0,
            failed_frames: 0,
            told: None,
            asked: Vec::new(),
            first_difference: None,
            torn: None,
        }
    }

    fn tell(&mut self, after_us: u64, event: Event) {
        self.proved = self.events;
        self.events += 1;
        self.now = self.now.after(after_us);
        if self.scheduler.overslept(self.now) {
            self.judge.overslept(self.now);
        }
        self.judge.event(self.now, &event);
        self.told = Some(event.clone());
        self.asked.clear();
        self.scheduler.handle(self.now, event);
        while let Some(action) = self.scheduler.poll_action() {
            self.chain.add(&action);
            self.judge.action(&action);
            self.frames += u64::from(matches!(action, Action::FrameComplete { .. }));
            self.failed_frames += u64::from(matches!(action, Action::FrameFailed { .. }));
            self.asked.push(action);
        }
        self.judge.settled(self.now);
        self.workers = self.workers.max(self.scheduler.workers());
    }

    /// The last event had other consequences then.
    fn differ(&mut self) {
        let shown: Vec<String> =
            self.asked.iter().take(ACTIONS_SHOWN).map(|action| format!("{action:?}")).collect();
        let more = self.asked.len() - shown.len();
        let mut asks = if shown.is_empty() { "nothing".into() } else { shown.join(", ") };
        if more > 0 {
            asks += &format!(" and {more} more");
        }
        let told = self.told.as_ref().map_or("before any".into(), |event| format!("{event:?}"));
        let (event, at_us) = (self.events, self.now.0);
        self.first_difference = Some(Difference { event, at_us, told, asks });
    }

    fn report(mut self) -> ReplayReport {
        self.judge.self_checked(self.scheduler.check_invariants());
        ReplayReport {
            build: self.build,
            seed: self.seed,
            events: self.events,
            proved: self.proved,
            actions: self.chain.actions,
            hash: self.chain.hash,
            span_s: self.now.0 as f64 / 1e6,
            workers: self.workers,
            frames: self.frames,
            failed_frames: self.failed_frames,
            account: self.scheduler.account(),
            invariants: self.judge.violations,
            first_violation: self.judge.first,
            first_difference: self.first_difference,
            torn: self.torn,
        }
    }
}
