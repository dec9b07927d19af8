//! When to try again: later each time, and not all workers at once.

use std::time::Duration;

/// What to do when there is no connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reconnect {
    /// How often to try again in a row before giving up; `None` for ever.
    pub attempts: Option<u32>,
    /// The first pause. Each one is twice as long as the one before.
    pub first: Duration,
    /// The longest pause.
    pub longest: Duration,
}

impl Reconnect {
    /// Gives up at once.
    pub const NEVER: Reconnect =
        Reconnect { attempts: Some(0), first: Duration::ZERO, longest: Duration::ZERO };
}

impl Default for Reconnect {
    /// For ever, after a quarter of a second to two seconds: a thousand workers that knock so
    /// often cost a coordinator nothing, and none is idle for long after a cut.
    fn default() -> Self {
        let (first, longest) = (Duration::from_millis(250), Duration::from_secs(2));
        Reconnect { attempts: None, first, longest }
    }
}

/// The pauses of one worker.
#[derive(Debug)]
pub(crate) struct Backoff {
    policy: Reconnect,
    failures: u32,
    state: u64,
}

impl Backoff {
    /// Pauses as the policy says, the same for the same seed.
    pub fn new(policy: Reconnect, seed: u64) -> Self {
        Backoff { policy, failures: 0, state: seed }
    }

    /// A connection has been made.
    pub fn reset(&mut self) {
        self.failures = 0;
    }

    /// The next pause: half of the full one, and a random share of the other half, so
    /// that a restarted coordinator is not met by all workers in the same instant.
    /// `None` to give up.
    pub fn next(&mut self) -> Option<Duration> {
        if self.policy.attempts.is_some_and(|attempts| self.failures >= attempts) {
            return None;
        }
        let doubled = self.policy.first.saturating_mul(1 << self.failures.min(20));
        self.failures = self.failures.saturating_add(1);
        let full = doubled.min(self.policy.longest);
        Some(full / 2 + (full / 2).mul_f64(self.unit()))
    }

    /// The next number from 0 to 1, by splitmix64.
    fn unit(&mut self) -> f64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut bits = self.state;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        bits ^= bits >> 31;
        (bits >> 11) as f64 / (1u64 << 53) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_up_to_the_longest_and_start_over_after_a_connection() {
        let mut backoff = Backoff::new(Reconnect::default(), 3);
        let within = |pause: Option<Duration>, full_ms: u64| {
            let full = Duration::from_millis(full_ms);
            pause.is_some_and(|pause| pause >= full / 2 && pause <= full)
        };
        for full_ms in [250, 500, 1000, 2000, 2000] {
            assert!(within(backoff.next(), full_ms), "{full_ms}");
        }
        for _ in 0..100 {
            assert!(within(backoff.next(), 2000));
        }
        backoff.reset();
        assert!(within(backoff.next(), 250));
    }

    #[test]
    fn the_same_seed_gives_the_same_pauses_and_another_one_others() {
        let pauses = |seed| {
            let mut backoff = Backoff::new(Reconnect::default(), seed);
            (0..5).map(|_| backoff.next()).collect::<Vec<_>>()
        };
        assert_eq!(pauses(1), pauses(1));
        assert_ne!(pauses(1), pauses(2));
    }

    #[test]
    fn it_gives_up_after_so_many_attempts_in_a_row() {
        assert_eq!(Backoff::new(Reconnect::NEVER, 1).next(), None);
        let policy = Reconnect { attempts: Some(2), ..Reconnect::default() };
        let mut backoff = Backoff::new(policy, 1);
        assert!(backoff.next().is_some() && backoff.next().is_some());
        assert_eq!(backoff.next(), None);
    }
}
