//! A night on record: every event that a scheduler was told, in a file that plays again.
//!
//! A [`Recorder`] stands between the owner of a [`crate::Scheduler`] and
//! [`crate::Scheduler::handle`]. It writes the settings, the seed, and each event with its
//! time; of the actions it keeps a running hash, of which a piece goes into every record.
//! [`replay`] tells a new scheduler the same events, and knows at which of them the actions
//! are no longer the same. No picture, name or address of a PC is in a journal; words are,
//! that workers gave for their failures.
//!
//! ```text
//! journal  "TFNIGHT", version 2, then records: Start, then Events and Marks
//! record   length of the body (LEB128, 1 to 3 bytes)
//!          check of the length (2 bytes), body (postcard), check of the body (4 bytes)
//! ```
//!
//! The checks are seeded with the number of the record, so that a record that is missing,
//! or stands in the place of another, is found. A process that was killed leaves a torn
//! last record: [`replay`] cuts it off and says so. Anything else that is wrong is an error
//! that names the offset.

mod record;
mod recorder;
mod replay;
#[cfg(test)]
mod tests;

pub use recorder::{Recorder, Stopped};
pub use replay::{Difference, ReplayError, ReplayReport, Torn, replay};

/// What every journal begins with; the last byte is the version of the format. Raise it
/// when [`crate::Event`] or [`crate::Config`] are changed other than by new variants at the
/// end of an enum.
const MAGIC: [u8; 8] = *b"TFNIGHT\x02";
/// The largest record, bytes of its body. The longest event, jobs handed back as the wire
/// allows it, takes a sixth of that.
const RECORD_BYTES_MAX: usize = 64 << 10;
/// A usual bound for a journal, bytes: about 50 million events.
pub const JOURNAL_BYTES: u64 = 1 << 30;
