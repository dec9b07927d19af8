//! Whole-program tests: real processes, real sockets, real files.
#![allow(clippy::unwrap_used)]

/// A fresh folder and the program, as a test needs them.
#[path = "whole/support.rs"]
mod support;

/// The house keeps its shape: which crate may depend on which.
#[path = "whole/tidy.rs"]
mod tidy;

/// The same picture for any number of workers and any split; workers that die, fall
/// silent, are cut off or come late.
#[path = "whole/farm.rs"]
mod farm;

/// While somebody waits for frames, a worker that freezes is noticed within half a second.
#[cfg(unix)]
#[path = "whole/live.rs"]
mod live;

/// Twenty times kill -9.
#[path = "whole/faults.rs"]
mod faults;

/// The queue on disk outlives its coordinator.
#[path = "whole/queue.rs"]
mod queue;

/// The record of a night plays again.
#[path = "whole/journal.rs"]
mod journal;

/// Terrain that comes from other workers, or damaged.
#[path = "whole/terrain_on_farm.rs"]
mod terrain_on_farm;

/// Whoever has not the token, floods, dawdles or lies harms nobody who works.
#[path = "whole/hostile.rs"]
mod hostile;

/// A coordinator with a queue and a page, and what asks it.
#[path = "whole/office.rs"]
mod office;

/// The coordinator's API: what it answers, whom it lets in, and how soon.
#[path = "whole/api.rs"]
mod api;

/// The page in a browser.
#[cfg(unix)]
#[path = "whole/page.rs"]
mod page;

/// What is wrong is said, nothing half-written stays, the exit code is 2.
#[path = "whole/bad_input.rs"]
mod bad_input;

/// Commands that write files: what they leave, and what it says.
#[path = "whole/commands.rs"]
mod commands;

/// Short runs of every bench: what is reported, and that nothing is wrong.
#[path = "whole/bench.rs"]
mod bench;

/// Two pictures and how far they are apart, against other programs.
#[path = "whole/compare.rs"]
mod compare;

/// Every command in the documents is one that works.
#[path = "whole/documents.rs"]
mod documents;

/// What is visible, against other programs.
#[path = "whole/oracles.rs"]
mod oracles;

/// Several PCs within one: links that are cut, workers that help each other.
#[cfg(target_os = "linux")]
#[path = "whole/namespaces.rs"]
mod namespaces;

/// Workers that look for their coordinator on such a network.
#[cfg(target_os = "linux")]
#[path = "whole/search.rs"]
mod search;

/// What `deploy/` starts: units, the ssh launcher, manifests.
#[cfg(unix)]
#[path = "whole/deploy.rs"]
mod deploy;

/// Workers as jobs of a real Slurm.
#[cfg(target_os = "linux")]
#[path = "whole/slurm.rs"]
mod slurm;
