//! Decoded blocks of a raster: a bounded cache of them, and windows copied out of them.
//!
//! The cache forgets the block that was not used for the longest time. Two threads that
//! want the same absent block may both decode it; the lock is never held meanwhile.

use crate::info::{RasterError, RasterInfo, Window};
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, PoisonError};

/// A decoded rectangle of samples.
pub struct Block<T> {
    /// Samples along a row.
    pub width: usize,
    /// The samples, row by row.
    pub samples: Vec<T>,
}

/// Blocks by number.
pub struct BlockCache<T> {
    budget_bytes: usize,
    inner: Mutex<Shelf<T>>,
}

struct Shelf<T> {
    blocks: HashMap<u64, (Arc<Block<T>>, u64)>,
    /// Block numbers by the time of their last use.
    by_age: BTreeMap<u64, u64>,
    bytes: usize,
    clock: u64,
}

impl<T: Copy> BlockCache<T> {
    /// An empty cache that holds at most so many bytes of samples.
    pub fn new(budget_bytes: usize) -> Self {
        let shelf = Shelf { blocks: HashMap::new(), by_age: BTreeMap::new(), bytes: 0, clock: 0 };
        BlockCache { budget_bytes, inner: Mutex::new(shelf) }
    }

    /// The block of that number, decoded if it is not held.
    pub fn get(
        &self,
        number: u64,
        decode: impl FnOnce() -> Result<Block<T>, RasterError>,
    ) -> Result<Arc<Block<T>>, RasterError> {
        if let Some(block) = self.lock().touch(number) {
            return Ok(block);
        }
        let block = Arc::new(decode()?);
        self.lock().insert(number, block.clone(), self.budget_bytes);
        Ok(block)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Shelf<T>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T: Copy> Shelf<T> {
    fn touch(&mut self, number: u64) -> Option<Arc<Block<T>>> {
        self.clock += 1;
        let (block, used) = self.blocks.get_mut(&number)?;
        self.by_age.remove(used);
        *used = self.clock;
        self.by_age.insert(self.clock, number);
        Some(block.clone())
    }

    fn insert(&mut self, number: u64, block: Arc<Block<T>>, budget: usize) {
        let size = block.samples.len() * size_of::<T>();
        if size > budget || self.blocks.contains_key(&number) {
            return;
        }
        while self.bytes + size > budget {
            let Some((_, oldest)) = self.by_age.pop_first() else { break };
            if let Some((gone, _)) = self.blocks.remove(&oldest) {
                self.bytes -= gone.samples.len() * size_of::<T>();
            }
        }
        self.clock += 1;
        self.bytes += size;
        self.by_age.insert(self.clock, number);
        self.blocks.insert(number, (block, self.clock));
    }
}

/// Fills a window from blocks of `size` (width, height) samples; `fetch` gives the block
/// of a block column and row.
pub fn read_window<T: Copy>(
    window: Window,
    size: [u64; 2],
    into: &mut [T],
    mut fetch: impl FnMut(u64, u64) -> Result<Arc<Block<T>>, RasterError>,
) -> Result<(), RasterError> {
    let (right, bottom) = (window.column + window.width as u64, window.row + window.height as u64);
    if window.width == 0 || window.height == 0 {
        return Ok(());
    }
    for by in window.row / size[1]..=(bottom - 1) / size[1] {
        for bx in window.column / size[0]..=(right - 1) / size[0] {
            let block = fetch(bx, by)?;
            let (left, top) = (bx * size[0], by * size[1]);
            let columns = window.column.max(left)..right.min(left + size[0]);
            for row in window.row.max(top)..bottom.min(top + size[1]) {
                let from = (row - top) as usize * block.width + (columns.start - left) as usize;
                let to = (row - window.row) as usize * window.width
                    + (columns.start - window.column) as usize;
                let count = (columns.end - columns.start) as usize;
                into[to..to + count].copy_from_slice(&block.samples[from..from + count]);
            }
        }
    }
    Ok(())
}

/// Refuses a window that leaves the raster, or a buffer of another size.
pub fn check_window(info: &RasterInfo, window: Window, buffer: usize) -> Result<(), RasterError> {
    let inside = |start: u64, count: usize, side: u64| {
        start.checked_add(count as u64).is_some_and(|end| end <= side)
    };
    if inside(window.column, window.width, info.width)
        && inside(window.row, window.height, info.height)
        && window.width.checked_mul(window.height) == Some(buffer)
    {
        return Ok(());
    }
    let what = format!(
        "a window of {} x {} samples at ({}, {}) with room for {buffer} does not fit the raster \
         of {} x {}",
        window.width, window.height, window.column, window.row, info.width, info.height
    );
    Err(RasterError::unsupported(&info.path, what))
}

/// The answer to a wrong question: colours of heights, or heights of a photo.
pub fn wrong_content(info: &RasterInfo, asked: &str) -> RasterError {
    let is = match info.content {
        crate::info::Content::Heights => "heights",
        crate::info::Content::Photo => "a photo",
    };
    RasterError::unsupported(&info.path, format!("{asked} are asked for, but the file is {is}"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_cache_forgets_the_block_that_was_unused_the_longest() {
        let cache = BlockCache::<u8>::new(20);
        let mut decoded = Vec::new();
        for number in [1, 2, 1, 3, 1, 2] {
            let block = cache.get(number, || {
                decoded.push(number);
                Ok(Block { width: 10, samples: vec![number as u8; 10] })
            });
            assert_eq!(block.unwrap().samples[0], number as u8);
        }
        assert_eq!(decoded, [1, 2, 3, 2]);
        assert_eq!(cache.lock().bytes, 20);
    }

    #[test]
    fn a_window_is_put_together_from_its_blocks() {
        let fetch = |bx: u64, by: u64| {
            let samples =
                (0..12).map(|k| (by * 3 + k / 4) * 100 + bx * 4 + k % 4).collect::<Vec<u64>>();
            Ok(Arc::new(Block { width: 4, samples }))
        };
        let window = Window { column: 3, row: 2, width: 6, height: 5 };
        let mut into = vec![0; 30];
        read_window(window, [4, 3], &mut into, fetch).unwrap();
        for (k, value) in into.iter().enumerate() {
            assert_eq!(*value, (2 + k as u64 / 6) * 100 + 3 + k as u64 % 6);
        }
    }
}
