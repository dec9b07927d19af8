//! Time that this thread has had on a core.
//!
//! A bench shares its PC with others: wall time counts their work, too. Where the system
//! does not tell (Windows), wall time it is, and reports say so.

/// What [`timed`] measures, for reports.
pub const KIND: &str = if cfg!(unix) { "thread cpu" } else { "wall" };

/// The shortest time ever reported, seconds: so that nobody divides by zero.
const SHORTEST_S: f64 = 1e-9;

/// The time that a call takes, seconds, and what it returns.
pub fn timed<T>(call: impl FnOnce() -> T) -> (f64, T) {
    let start_s = now_s();
    let result = call();
    ((now_s() - start_s).max(SHORTEST_S), result)
}

#[cfg(unix)]
fn now_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

#[cfg(not(unix))]
fn now_s() -> f64 {
    use std::sync::OnceLock;
    use std::time::Instant;
    static START: OnceLock<Instant> = OnceLock::new();
    START.get_or_init(Instant::now).elapsed().as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_work_takes_more_time() {
        let work = |steps: u64| timed(|| (0..steps).fold(1u64, |a, b| (a ^ b).rotate_left(5)));
        let (short_s, _) = work(std::hint::black_box(1_000));
        let (long_s, _) = work(std::hint::black_box(10_000_000));
        assert!(0.0 < short_s && short_s < long_s, "{short_s} {long_s}");
    }
}
