//! The promises of the protocol, checked from outside.
#![allow(clippy::unwrap_used, missing_docs)]

mod samples;

/// The bytes of a released version never change.
mod golden;
/// Damage, garbage and lies give an error: never a panic, never an allocation.
mod hostile;
/// Every message arrives as it was sent.
mod round_trip;
/// One suite over TCP and over memory: greetings, ends, silence, heartbeats.
mod transport;
