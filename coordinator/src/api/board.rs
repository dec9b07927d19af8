//! The shots and workers that there are: those of the queue and those of clients, chosen
//! by state and name, in the order in which people want to see them.

use super::Desk;
use super::refusal::Refusal;
use crate::view::{FarmView, ShotState, ShotView, WorkerState, WorkerView};
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::{Arc, PoisonError};
use terrafarm_common::id::ShotId;

/// Most entries of a page of a list.
pub const LIMIT_MAX: usize = 1000;
/// Entries of a page of a list, unless asked for.
const LIMIT: usize = 100;

/// Everything at one moment.
pub struct Board {
    /// The farm.
    pub farm: Arc<FarmView>,
    /// Every shot: those under way first, by priority and number, then those that are
    /// over, the newest first.
    pub shots: Vec<Arc<ShotView>>,
    /// How many shots are in each state.
    pub states: BTreeMap<ShotState, usize>,
    queued: Option<Arc<Vec<Arc<ShotView>>>>,
}

/// What part of a list is wanted.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
pub struct Window {
    /// States, separated by commas; `active` are those that are not over. All if empty.
    pub state: String,
    /// A part of the name, in any case.
    pub name: String,
    /// How many to leave out.
    pub offset: usize,
    /// How many to give.
    pub limit: Option<usize>,
}

/// A part of a list.
#[derive(Debug, Serialize)]
pub struct Page<T> {
    /// How many fit the question, on all pages.
    pub total: usize,
    /// How many were left out before these.
    pub offset: usize,
    /// These.
    #[serde(skip)]
    pub entries: Vec<T>,
}

impl Desk {
    /// The newest board: made anew only when something has changed.
    pub(super) fn board(&self) -> Arc<Board> {
        let farm = self.farm.view();
        let queued = self.queue.as_ref().map(|queue| queue.shots());
        let mut kept = self.board.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(board) = &*kept
            && Arc::ptr_eq(&board.farm, &farm)
            && match (&board.queued, &queued) {
                (Some(one), Some(other)) => Arc::ptr_eq(one, other),
                (one, other) => one.is_none() && other.is_none(),
            }
        {
            return board.clone();
        }
        let board = Arc::new(Board::new(farm, queued));
        *kept = Some(board.clone());
        board
    }
}

impl Board {
    fn new(farm: Arc<FarmView>, queued: Option<Arc<Vec<Arc<ShotView>>>>) -> Self {
        let mut shots: Vec<_> = queued.iter().flat_map(|list| list.iter().cloned()).collect();
        // Shots of the queue are in the farm, too, while they are rendered.
        let own = farm.shots.iter().filter(|shot| !shot.queued);
        shots.extend(own.map(|shot| Arc::new(shot.clone())));
        shots.sort_by_cached_key(|shot| {
            let order = if shot.state.is_over() { u64::MAX - shot.id.0 } else { shot.id.0 };
            (rank(shot.state), Reverse(if shot.state.is_over() { 0 } else { shot.priority }), order)
        });
        let mut states = BTreeMap::new();
        for shot in &shots {
            *states.entry(shot.state).or_insert(0) += 1;
        }
        Board { farm, shots, states, queued }
    }

    /// One shot.
    pub fn shot(&self, id: ShotId) -> Result<&Arc<ShotView>, Refusal> {
        let found = self.shots.iter().find(|shot| shot.id == id);
        found.ok_or_else(|| Refusal::not_there(format!("there is no {id} on this farm")))
    }

    /// Some shots.
    pub fn page_of_shots(&self, window: &Window) -> Result<Page<Arc<ShotView>>, Refusal> {
        let states = window.states(|word| match word {
            "active" => Some(ShotState::ALL.into_iter().filter(|state| !state.is_over()).collect()),
            "over" => Some(ShotState::ALL.into_iter().filter(|state| state.is_over()).collect()),
            word => ShotState::ALL.into_iter().find(|state| state.name() == word).map(|s| vec![s]),
        })?;
        let fits = |shot: &&Arc<ShotView>| {
            states.as_ref().is_none_or(|states| states.contains(&shot.state))
                && window.fits_name(&shot.name)
        };
        Ok(window.page(self.shots.iter().filter(fits).cloned()))
    }

    /// Some workers.
    pub fn page_of_workers(&self, window: &Window) -> Result<Page<&WorkerView>, Refusal> {
        let all = [WorkerState::Idle, WorkerState::Busy, WorkerState::Draining];
        let states = window
            .states(|word| all.into_iter().find(|state| state.name() == word).map(|s| vec![s]))?;
        let fits = |worker: &&WorkerView| {
            states.as_ref().is_none_or(|states| states.contains(&worker.state))
                && window.fits_name(&worker.name)
        };
        Ok(window.page(self.farm.workers.iter().filter(fits)))
    }
}

impl Window {
    /// The states that are wanted; `None` for all.
    fn states<S>(&self, read: impl Fn(&str) -> Option<Vec<S>>) -> Result<Option<Vec<S>>, Refusal> {
        let words = self.state.split(',').map(str::trim).filter(|word| !word.is_empty());
        let mut states: Option<Vec<S>> = None;
        for word in words {
            let more = read(word)
                .ok_or_else(|| Refusal::malformed(format!("no state is called {word:?}")))?;
            states.get_or_insert_default().extend(more);
        }
        Ok(states)
    }

    fn fits_name(&self, name: &str) -> bool {
        self.name.is_empty() || name.to_lowercase().contains(&self.name.to_lowercase())
    }

    fn page<T>(&self, all: impl Iterator<Item = T>) -> Page<T> {
        let limit = self.limit.unwrap_or(LIMIT).min(LIMIT_MAX);
        let (mut total, mut entries) = (0usize, Vec::new());
        for entry in all {
            if total >= self.offset && entries.len() < limit {
                entries.push(entry);
            }
            total += 1;
        }
        Page { total, offset: self.offset, entries }
    }
}

/// Where a state stands in a list.
fn rank(state: ShotState) -> u8 {
    match state {
        ShotState::Running | ShotState::Finishing | ShotState::Stalled => 0,
        ShotState::Waiting | ShotState::Paused => 1,
        ShotState::Done | ShotState::Failed | ShotState::Canceled => 2,
    }
}
