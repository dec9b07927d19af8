//! How long a call takes that nothing else should slow down.

use std::time::{Duration, Instant};

/// The shortest time of a call, seconds, and what it returned last: the time that this thread
/// has had on a core, where the system tells.
pub fn best<T>(runs: usize, mut call: impl FnMut() -> T) -> (f64, T) {
    let mut time = f64::INFINITY;
    let mut result = None;
    for _ in 0..runs.max(1) {
        let (start, core) = (Instant::now(), core_time());
        result = Some(call());
        let taken = core_time().zip(core).map(|(end, start)| end.saturating_sub(start));
        time = time.min(taken.unwrap_or(start.elapsed()).as_secs_f64());
    }
    (time, result.expect("it was called at least once"))
}

#[cfg(unix)]
fn core_time() -> Option<Duration> {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Some(Duration::new(time.tv_sec.try_into().ok()?, time.tv_nsec.try_into().ok()?))
}

#[cfg(not(unix))]
fn core_time() -> Option<Duration> {
    None
}
