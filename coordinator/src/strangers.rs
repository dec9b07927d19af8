//! Connections that have not greeted yet: so many and no more.
//!
//! When all places are taken, the one who has waited longest gives way to the newcomer. A
//! flood of silent peers can so keep nobody out who greets at once, as every worker does:
//! with 256 places it would take 256 new connections within that one exchange.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use tokio_util::sync::CancellationToken;

/// The places.
pub struct Strangers {
    most: usize,
    waiting: Mutex<Waiting>,
}

#[derive(Default)]
struct Waiting {
    last: u64,
    /// Number and place of each, the oldest first.
    places: VecDeque<(u64, CancellationToken)>,
}

/// One place; left when it is dropped.
pub struct Place<'a> {
    strangers: &'a Strangers,
    number: u64,
    given_away: CancellationToken,
}

impl Strangers {
    /// So many places, at least one.
    pub fn new(most: usize) -> Self {
        Strangers { most: most.max(1), waiting: Mutex::default() }
    }

    /// Takes a place, the oldest one's if all are taken.
    pub fn enter(&self) -> Place<'_> {
        let given_away = CancellationToken::new();
        let mut waiting = self.lock();
        waiting.last += 1;
        let number = waiting.last;
        waiting.places.push_back((number, given_away.clone()));
        if waiting.places.len() > self.most
            && let Some((_, oldest)) = waiting.places.pop_front()
        {
            oldest.cancel();
        }
        Place { strangers: self, number, given_away }
    }

    /// Nothing that could panic happens under the lock.
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Place<'_> {
    /// Done when a newcomer has got this place.
    pub async fn given_away(&self) {
        self.given_away.cancelled().await;
    }
}

impl Drop for Place<'_> {
    fn drop(&mut self) {
        let mut waiting = self.strangers.lock();
        if let Ok(at) = waiting.places.binary_search_by_key(&self.number, |(number, _)| *number) {
            waiting.places.remove(at);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_gives_way_and_places_that_are_left_are_free() {
        let strangers = Strangers::new(2);
        let (first, second) = (strangers.enter(), strangers.enter());
        let third = strangers.enter();
        let given_away = |place: &Place| place.given_away.is_cancelled();
        assert_eq!([&first, &second, &third].map(given_away), [true, false, false]);
        drop(third);
        let fourth = strangers.enter();
        assert_eq!([&second, &fourth].map(given_away), [false, false]);
        drop(first);
        let fifth = strangers.enter();
        assert_eq!([&second, &fourth, &fifth].map(given_away), [true, false, false]);
        drop((second, fourth, fifth));
        assert!(strangers.lock().places.is_empty());
    }
}
