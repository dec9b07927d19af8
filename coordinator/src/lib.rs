//! The coordinator: driver task, peers, sinks.

pub mod sink;
