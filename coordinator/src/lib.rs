//! The coordinator: driver task, peers, sinks.
