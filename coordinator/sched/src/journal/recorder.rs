//! Writes a journal while its scheduler works.

use super::record::{self, Chain, Record};
use super::{MAGIC, RECORD_BYTES_MAX};
use crate::config::Config;
use crate::event::{Event, Micros};
use crate::scheduler::Scheduler;
use std::io::{self, Write};

/// Bytes that are gathered before they are written.
const BUFFER_BYTES: usize = 64 << 10;
/// They are written after this time of the scheduler's clock even if they are few,
/// microseconds: the most that a killed process loses.
const WRITE_EVERY_US: u64 = 1_000_000;
/// A mark follows every so many events.
const MARK_EVERY: u64 = 1024;
/// Room that is kept for the last mark, bytes.
const LAST_MARK_BYTES: u64 = 64;

/// Why a journal does not go on. The scheduler works on without it.
#[derive(Debug, thiserror::Error)]
pub enum Stopped {
    /// When the next record does not fit any more.
    #[error(
        "the journal has reached its limit of {limit_bytes} bytes and ends here; it can be replayed up to now"
    )]
    Full {
        /// The limit, bytes.
        limit_bytes: u64,
    },
    /// When an event is too long for a record.
    #[error("the journal ends here: an event takes more than {} bytes", RECORD_BYTES_MAX)]
    TooLong,
    /// When it cannot be written.
    #[error("the journal ends here, it cannot be written: {0}; is the disk full?")]
    Write(#[from] io::Error),
}

/// Writes a journal. Gathers what it writes: call [`Self::finish`] at the end. A process
/// that is killed loses its last second.
#[derive(Debug)]
pub struct Recorder<W> {
    out: W,
    limit_bytes: u64,
    /// Not yet written.
    buffer: Vec<u8>,
    scratch: Vec<u8>,
    /// Bytes of the journal, `buffer` included.
    bytes: u64,
    records: u64,
    events: u64,
    chain: Chain,
    last: Micros,
    written_at: Micros,
    has_stopped: bool,
}

impl<W: Write> Recorder<W> {
    /// Begins a journal of a scheduler that is about to be made with these settings and
    /// this seed. It never grows beyond `limit_bytes`; [`super::JOURNAL_BYTES`] is usual.
    ///
    /// # Errors
    /// If the beginning cannot be written.
    pub fn begin(out: W, config: &Config, seed: u64, limit_bytes: u64) -> Result<Self, Stopped> {
        let mut recorder = Recorder {
            out,
            limit_bytes,
            buffer: MAGIC.to_vec(),
            scratch: Vec::new(),
            bytes: MAGIC.len() as u64,
            records: 0,
            events: 0,
            chain: Chain::default(),
            last: Micros(0),
            written_at: Micros(0),
            has_stopped: false,
        };
        let build = env!("CARGO_PKG_VERSION").to_owned();
        recorder.put::<&Event>(&Record::Start { build, config: config.clone(), seed })?;
        recorder.write_out()?;
        Ok(recorder)
    }

    /// Tells the scheduler, as [`Scheduler::handle`] does, and keeps a record of it. All of
    /// the scheduler's events have to take this way, from its first.
    ///
    /// # Errors
    /// Once, when the journal ends. The scheduler has been told in any case.
    pub fn handle(
        &mut self,
        scheduler: &mut Scheduler,
        now: Micros,
        event: Event,
    ) -> Result<(), Stopped> {
        if self.has_stopped {
            scheduler.handle(now, event);
            return Ok(());
        }
        if let Err(why) = self.note(now, &event) {
            let ended = self.end(why);
            scheduler.handle(now, event);
            return Err(ended);
        }
        // The owner may not have fetched all that was asked for before.
        let before = scheduler.actions.len();
        scheduler.handle(now, event);
        scheduler.actions.range(before..).for_each(|action| self.chain.add(action));
        self.mark_and_write().map_err(|why| self.end(why))
    }

    /// Writes all that is gathered, with a mark, so that the last event too can be proved.
    ///
    /// # Errors
    /// If it cannot be written; not if the journal has ended before.
    pub fn finish(&mut self) -> Result<(), Stopped> {
        if self.has_stopped {
            return Ok(());
        }
        self.mark().and_then(|()| self.write_out()).map_err(|why| self.end(why))
    }

    /// Gives back where it wrote to. What is gathered and not written is lost.
    pub fn into_inner(self) -> W {
        self.out
    }

    fn note(&mut self, now: Micros, event: &Event) -> Result<(), Stopped> {
        let after_us = now.since(self.last);
        self.last = self.last.max(now);
        self.put(&Record::Event { after_us, before: self.chain.low(), event })?;
        self.events += 1;
        Ok(())
    }

    fn mark_and_write(&mut self) -> Result<(), Stopped> {
        if self.events.is_multiple_of(MARK_EVERY) {
            self.mark()?;
        }
        let is_due = self.last.since(self.written_at) >= WRITE_EVERY_US;
        if is_due || self.buffer.len() >= BUFFER_BYTES {
            self.write_out()?;
        }
        Ok(())
    }

    fn mark(&mut self) -> Result<(), Stopped> {
        let Chain { actions, hash, .. } = self.chain;
        self.put::<&Event>(&Record::Mark { events: self.events, actions, hash })
    }

    /// Gathers a record, unless the journal is full.
    fn put<E: serde::Serialize>(&mut self, record: &Record<E>) -> Result<(), Stopped> {
        let before = self.buffer.len();
        record::write(record, self.records, &mut self.scratch, &mut self.buffer)
            .map_err(|_| Stopped::TooLong)?;
        let bytes = self.bytes + (self.buffer.len() - before) as u64;
        let kept = if self.has_stopped { 0 } else { LAST_MARK_BYTES };
        if bytes + kept > self.limit_bytes {
            self.buffer.truncate(before);
            return Err(Stopped::Full { limit_bytes: self.limit_bytes });
        }
        self.bytes = bytes;
        self.records += 1;
        Ok(())
    }

    fn write_out(&mut self) -> Result<(), Stopped> {
        self.written_at = self.last;
        self.out.write_all(&self.buffer)?;
        self.buffer.clear();
        self.out.flush()?;
        Ok(())
    }

    /// Ends the journal, with a last mark if it can be written; returns why.
    fn end(&mut self, why: Stopped) -> Stopped {
        self.has_stopped = true;
        let is_writable = !matches!(why, Stopped::Write(_));
        let ended = is_writable.then(|| self.mark().and_then(|()| self.write_out()));
        self.buffer = Vec::new();
        match ended {
            Some(Err(worse)) => worse,
            _ => why,
        }
    }
}
