//! The state machine itself.
use crate::config::Config;
use crate::event::{Action, Event, Micros};
use serde::Serialize;
use std::collections::VecDeque;

/// What became of every lease so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Account {
    /// Leases granted; the others add up to it, together with those still held.
    pub granted: u64,
    /// Ended by a result that was merged.
    pub accepted: u64,
    /// Ended by a failure that the worker reported.
    pub failed: u64,
    /// Ended by their time.
    pub expired: u64,
    /// Given back.
    pub handed_back: u64,
    /// Ended because nobody wants the result any more.
    pub revoked: u64,
    /// Ended with the worker's connection.
    pub lost: u64,
    /// Granted on purpose while another worker held the same job; part of `granted`.
    pub hedged: u64,
    /// Results refused: not leases, since those had ended before.
    pub refused: u64,
}

/// The state machine. See the crate's documentation for how to drive it.
#[derive(Debug)]
pub struct Scheduler {
    actions: VecDeque<Action>,
    account: Account,
}

impl Scheduler {
    /// A scheduler without workers or shots.
    pub fn new(_config: Config, _seed: u64) -> Self {
        Scheduler { actions: VecDeque::new(), account: Account::default() }
    }

    /// Takes in what happened. `now` must not go back between calls; an earlier time is
    /// taken for the latest one seen. Drain [`Self::poll_action`] afterwards.
    pub fn handle(&mut self, _now: Micros, _event: Event) {}

    /// The next thing to be done; `None` when all is said. Call it until then after each
    /// [`Self::handle`].
    #[must_use]
    pub fn poll_action(&mut self) -> Option<Action> {
        self.actions.pop_front()
    }

    /// When to send [`Event::Tick`] if nothing else happens before; `None` if nothing will
    /// ever be due. May change with every [`Self::handle`], and only with it.
    #[must_use]
    pub fn next_deadline(&self) -> Option<Micros> {
        None
    }

    /// What became of every lease so far.
    pub fn account(&self) -> Account {
        self.account
    }
}
