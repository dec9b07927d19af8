//! The promises of the protocol, checked from outside.
#![allow(clippy::unwrap_used, missing_docs)]

mod samples;

/// The bytes of a released version never change.
mod golden;
/// Damage, garbage and lies give an error: never a panic, never an allocation.
mod hostile;
/// Every message arrives as it was sent.
mod round_trip;
/// Who has not the token gets nothing; what was changed on the way is noticed.
mod secure;
/// One suite over TCP and over memory, plain and secure: greetings, ends, silence, heartbeats.
mod transport;
