//! The coordinator: driver task, peers, clients and the files that pictures go to.
//!
//! [`run`] serves a farm. One task, the driver, owns everything that is decided
//! (`farm::Farm`: scheduler, film, blob broker); every connection has one task that reads
//! and one that writes, and talks to the driver through bounded channels. [`client`] is
//! the other side: it submits a shot, supplies terrain, and takes frames. [`sink`] writes
//! frames to files.

pub mod api;
pub mod ask;
mod blobs;
pub mod client;
pub mod dial;
mod driver;
mod farm;
#[doc(hidden)]
pub mod fuzz;
mod journal;
pub mod order;
mod peer;
pub mod queue;
mod shots;
pub mod sink;
mod strangers;
mod thumbnails;
pub mod view;

pub use driver::{Config, Coordinator, CoordinatorError, run};
pub use journal::JournalError;
