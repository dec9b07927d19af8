//! The worker against a scripted coordinator over TCP on loopback.
#![allow(clippy::unwrap_used, missing_docs)]

/// A small store, its blobs, and what its pictures must look like.
mod scene;
/// The scripted coordinator, and a ray caster that stops at a gate.
mod script;

/// What breaks and what must happen then.
mod faults;
/// Terrain before its turn, and from worker to worker.
mod peers;
/// Whom a worker finds that was told no address.
mod search;
/// Jobs, terrain, pixels, and leaving.
mod work;
