//! The patches of a store that were used last, for all regions and frames.
//!
//! A patch is a function of its key and the store, so it does not matter who makes it or
//! how often: pictures are the same whatever is kept.

use super::patch::Patch;
use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

/// Memory of the patches that are kept, bytes, with what keeping them takes.
pub(crate) const MOST_BYTES: usize = 64 << 20;
/// What a patch takes beside its own bytes: its places in the table and on the heap.
const KEEPING_BYTES: usize = 128;

/// What a patch is of: the plot by its number, its level, and the weight of the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Blend {
    pub plot: i32,
    pub level: u32,
    pub weight: u32,
}

/// Patches by what they are of. What was not used since half of the memory was filled anew
/// is forgotten.
pub(crate) struct Patches {
    shelves: Mutex<Shelves>,
}

/// Each at most half of the memory.
#[derive(Default)]
struct Shelves {
    young: HashMap<Blend, Arc<Patch>>,
    young_bytes: usize,
    old: HashMap<Blend, Arc<Patch>>,
}

impl Patches {
    pub(crate) fn new() -> Self {
        Patches { shelves: Mutex::default() }
    }

    /// The patch of a blend; makes it if there is none. Two threads may make the same one at
    /// a time: either is right.
    pub(crate) fn get(&self, blend: Blend, make: impl FnOnce() -> Patch) -> Arc<Patch> {
        if let Some(patch) = self.find(blend) {
            return patch;
        }
        let patch = Arc::new(make());
        self.keep(blend, patch.clone());
        patch
    }

    fn find(&self, blend: Blend) -> Option<Arc<Patch>> {
        let mut shelves = self.shelves.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(patch) = shelves.young.get(&blend) {
            return Some(patch.clone());
        }
        let patch = shelves.old.remove(&blend)?;
        let forgotten = shelves.add(blend, patch.clone());
        drop(shelves);
        drop(forgotten);
        Some(patch)
    }

    fn keep(&self, blend: Blend, patch: Arc<Patch>) {
        let mut shelves = self.shelves.lock().unwrap_or_else(PoisonError::into_inner);
        let forgotten = shelves.add(blend, patch);
        drop(shelves);
        // Freed where nobody waits for it.
        drop(forgotten);
    }

    /// Bytes of what is kept.
    #[cfg(test)]
    pub(crate) fn bytes(&self) -> usize {
        let shelves = self.shelves.lock().unwrap_or_else(PoisonError::into_inner);
        shelves.young.values().chain(shelves.old.values()).map(|patch| bytes_of(patch)).sum()
    }
}

fn bytes_of(patch: &Patch) -> usize {
    patch.memory_bytes() + KEEPING_BYTES
}

impl Shelves {
    /// Adds a patch to the young. Returns those that are forgotten for it.
    fn add(&mut self, blend: Blend, patch: Arc<Patch>) -> HashMap<Blend, Arc<Patch>> {
        let bytes = bytes_of(&patch);
        let mut forgotten = HashMap::new();
        if self.young_bytes + bytes > MOST_BYTES / 2 {
            forgotten = std::mem::replace(&mut self.old, std::mem::take(&mut self.young));
            self.young_bytes = 0;
        }
        if self.young.insert(blend, patch).is_none() {
            self.young_bytes += bytes;
        }
        forgotten
    }
}

impl fmt::Debug for Patches {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Patches").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn patch(side: usize) -> Patch {
        let codes = vec![1; side * side + 1].into_boxed_slice();
        Patch { codes, base: 0.0, step: 1.0, side, lift: 0.0 }
    }

    fn blend(plot: i32) -> Blend {
        Blend { plot, level: 0, weight: 1 }
    }

    #[test]
    fn what_is_kept_never_takes_more_than_the_limit_and_what_is_used_stays() {
        let patches = Patches::new();
        let used = patches.get(blend(-1), || patch(257));
        for plot in 0..3000 {
            let kept = patches.get(blend(-1), || panic!("it was used all the time"));
            assert!(Arc::ptr_eq(&used, &kept));
            patches.get(blend(plot), || patch(if plot % 3 == 0 { 257 } else { 2 }));
            if plot % 64 == 0 {
                assert!(patches.bytes() <= MOST_BYTES);
            }
        }
        assert!(patches.bytes() > MOST_BYTES / 4, "something is kept");
        let mut again = false;
        patches.get(blend(0), || {
            again = true;
            patch(2)
        });
        assert!(again, "the first of so many is forgotten");
    }

    #[test]
    fn another_weight_level_or_plot_is_another_patch() {
        let patches = Patches::new();
        let blends = [(0, 0, 1), (0, 0, 2), (0, 1, 1), (1, 0, 1)];
        let blends = blends.map(|(plot, level, weight)| Blend { plot, level, weight });
        for (side, blend) in (2..).zip(blends) {
            assert_eq!(patches.get(blend, || patch(side)).side, side);
        }
        for (side, blend) in (2..).zip(blends) {
            assert_eq!(patches.get(blend, || panic!("it is kept")).side, side);
        }
    }
}
