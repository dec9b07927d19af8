//! What stands in a journal, and how it becomes bytes.

use super::RECORD_BYTES_MAX;
use crate::config::Config;
use crate::event::{Action, Event};
use serde::{Deserialize, Serialize};
use std::io::{self, Read};
use xxhash_rust::xxh3::xxh3_64_with_seed;

/// Bits of the length in one byte of it.
const LENGTH_BITS: u32 = 7;
/// The most bytes of a length.
const LENGTH_BYTES_MAX: u32 = 3;

/// One record. `E` is an event, or a borrowed one.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(super) enum Record<E> {
    /// The first one.
    Start {
        /// Version of the program that wrote it.
        build: String,
        /// Settings of the scheduler.
        config: Config,
        /// Its seed.
        seed: u64,
    },
    /// Something that the scheduler was told.
    Event {
        /// Time since the event before, microseconds.
        after_us: u64,
        /// Low half of the hash of all actions before it.
        before: u32,
        /// What happened.
        event: E,
    },
    /// What came of all records before it.
    Mark {
        /// Events so far.
        events: u64,
        /// Actions so far.
        actions: u64,
        /// Their hash.
        hash: u64,
    },
}

/// The running hash of the actions.
#[derive(Debug, Default)]
pub(super) struct Chain {
    pub(super) actions: u64,
    pub(super) hash: u64,
    scratch: Vec<u8>,
}

impl Chain {
    /// Takes in one action.
    pub(super) fn add(&mut self, action: &Action) {
        let mut bytes = std::mem::take(&mut self.scratch);
        bytes.clear();
        // Writing plain enums and numbers to memory does not fail.
        self.scratch = postcard::to_extend(action, bytes).unwrap_or_default();
        self.hash = xxh3_64_with_seed(&self.scratch, self.hash);
        self.actions += 1;
    }

    /// What an event's record keeps of it.
    pub(super) fn low(&self) -> u32 {
        self.hash as u32
    }
}

pub(super) fn check_of_length(length: usize, number: u64) -> [u8; 2] {
    let hash = xxh3_64_with_seed(&(length as u64).to_le_bytes(), number);
    (hash as u16).to_le_bytes()
}

fn check_of_body(body: &[u8], number: u64) -> [u8; 4] {
    (xxh3_64_with_seed(body, number) as u32).to_le_bytes()
}

/// Appends a record as the `number`-th of its journal.
pub(super) fn write<E: Serialize>(
    record: &Record<E>,
    number: u64,
    scratch: &mut Vec<u8>,
    out: &mut Vec<u8>,
) -> Result<(), postcard::Error> {
    let mut body = std::mem::take(scratch);
    body.clear();
    *scratch = postcard::to_extend(record, body)?;
    if scratch.len() > RECORD_BYTES_MAX {
        return Err(postcard::Error::SerializeBufferFull);
    }
    let mut rest = scratch.len();
    while rest >> LENGTH_BITS > 0 {
        out.push(rest as u8 | 1 << LENGTH_BITS);
        rest >>= LENGTH_BITS;
    }
    out.push(rest as u8);
    out.extend(check_of_length(scratch.len(), number));
    out.extend_from_slice(scratch);
    out.extend(check_of_body(scratch, number));
    Ok(())
}

/// Why no record was read.
#[derive(Debug)]
pub(super) enum NoRecord {
    /// The journal ends here, between two records.
    End,
    /// It ends inside a record, of which so many bytes are there.
    Torn(u64),
    /// These are not the bytes that were written.
    Corrupt(&'static str),
    Io(io::Error),
}

/// Bytes on their way in, counted.
struct Source<'a, R> {
    from: &'a mut R,
    taken: u64,
}

impl<R: Read> Source<'_, R> {
    /// Fills the buffer; an end before that is a torn record, or the end of all.
    fn fill(&mut self, buffer: &mut [u8]) -> Result<(), NoRecord> {
        let mut filled = 0;
        while filled < buffer.len() {
            match self.from.read(&mut buffer[filled..]) {
                Ok(0) if self.taken == 0 => return Err(NoRecord::End),
                Ok(0) => return Err(NoRecord::Torn(self.taken)),
                Ok(count) => {
                    filled += count;
                    self.taken += count as u64;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(NoRecord::Io(error)),
            }
        }
        Ok(())
    }

    fn length(&mut self) -> Result<usize, NoRecord> {
        let mut length = 0;
        for place in 0..LENGTH_BYTES_MAX {
            let mut byte = [0];
            self.fill(&mut byte)?;
            length |= usize::from(byte[0] & 0x7f) << (place * LENGTH_BITS);
            if byte[0] >> LENGTH_BITS == 0 {
                return Ok(length);
            }
        }
        Err(NoRecord::Corrupt("the length of a record has no end"))
    }
}

/// Reads the `number`-th record of a journal; also how many bytes it took.
pub(super) fn read(
    from: &mut impl Read,
    number: u64,
    scratch: &mut Vec<u8>,
) -> Result<(Record<Event>, u64), NoRecord> {
    let mut source = Source { from, taken: 0 };
    let length = source.length()?;
    let mut check = [0; 2];
    source.fill(&mut check)?;
    if check != check_of_length(length, number) {
        return Err(NoRecord::Corrupt("the length of a record is not what was written"));
    }
    if length > RECORD_BYTES_MAX {
        return Err(NoRecord::Corrupt("a record is longer than any can be"));
    }
    scratch.resize(length, 0);
    source.fill(scratch)?;
    let mut check = [0; 4];
    source.fill(&mut check)?;
    if check != check_of_body(scratch, number) {
        return Err(NoRecord::Corrupt("a record is not what was written"));
    }
    match postcard::take_from_bytes(scratch) {
        Ok((record, [])) => Ok((record, source.taken)),
        _ => Err(NoRecord::Corrupt("a record is of no kind that this program knows")),
    }
}
