//! Frames back into the order of the flight.

use std::collections::{BTreeMap, BTreeSet};
use terrafarm_common::id::FrameIndex;

/// Why a frame was not taken in. The buffer is as it was before.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OrderError {
    /// When as many frames wait as the buffer may hold, and this is not the next one.
    #[error(
        "cannot keep frame {frame}: {waiting} frames wait for frame {next}; let fewer be in flight"
    )]
    Full {
        /// The frame.
        frame: FrameIndex,
        /// How many wait.
        waiting: usize,
        /// The frame that they wait for.
        next: FrameIndex,
    },
    /// When a frame comes twice, or after it was skipped.
    #[error("frame {frame} has come or been skipped before")]
    Repeated {
        /// The frame.
        frame: FrameIndex,
    },
}

/// Holds whole frames until all before them have been taken.
///
/// Frames that will never come are skipped; each costs a few bytes until its turn.
#[derive(Debug)]
pub struct OrderedFrames<T> {
    max_waiting: usize,
    next: FrameIndex,
    waiting: BTreeMap<FrameIndex, T>,
    skipped: BTreeSet<FrameIndex>,
}

impl<T> OrderedFrames<T> {
    /// Begins with frame 0 and holds at most so many, and beyond that only the next one:
    /// as many as may be in flight is enough.
    pub fn new(max_waiting: usize) -> Self {
        OrderedFrames { max_waiting, next: 0, waiting: BTreeMap::new(), skipped: BTreeSet::new() }
    }

    /// Takes a frame in.
    ///
    /// # Errors
    /// [`OrderError::Full`], [`OrderError::Repeated`]; the frame is lost then.
    pub fn put(&mut self, frame: FrameIndex, item: T) -> Result<(), OrderError> {
        self.check_new(frame)?;
        let waiting = self.waiting.len();
        if waiting >= self.max_waiting && frame != self.next {
            return Err(OrderError::Full { frame, waiting, next: self.next });
        }
        self.waiting.insert(frame, item);
        Ok(())
    }

    /// Notes that a frame will never come.
    ///
    /// # Errors
    /// [`OrderError::Repeated`].
    pub fn skip(&mut self, frame: FrameIndex) -> Result<(), OrderError> {
        self.check_new(frame)?;
        self.skipped.insert(frame);
        self.pass_skipped();
        Ok(())
    }

    /// Hands the next frame out, if it is there.
    pub fn take(&mut self) -> Option<(FrameIndex, T)> {
        let frame = self.next;
        let item = self.waiting.remove(&frame)?;
        self.next += 1;
        self.pass_skipped();
        Some((frame, item))
    }

    /// The frame that is waited for: all before it have been taken or skipped.
    pub fn next(&self) -> FrameIndex {
        self.next
    }

    /// Number of frames that wait.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    fn pass_skipped(&mut self) {
        while self.skipped.remove(&self.next) {
            self.next += 1;
        }
    }

    fn check_new(&self, frame: FrameIndex) -> Result<(), OrderError> {
        let is_known = frame < self.next
            // So that `next` cannot overflow.
            || frame == FrameIndex::MAX
            || self.waiting.contains_key(&frame)
            || self.skipped.contains(&frame);
        if is_known { Err(OrderError::Repeated { frame }) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn frames_in_any_order_come_out_in_theirs(
            order in Just((0u32..40).collect::<Vec<_>>()).prop_shuffle(),
            skipped in prop::collection::btree_set(0u32..40, 0..20),
        ) {
            let mut frames = OrderedFrames::new(40);
            let mut out = Vec::new();
            for frame in order {
                if skipped.contains(&frame) {
                    frames.skip(frame).unwrap();
                } else {
                    frames.put(frame, frame * 10).unwrap();
                }
                out.extend(std::iter::from_fn(|| frames.take()));
            }
            let expected = (0..40).filter(|frame| !skipped.contains(frame));
            prop_assert_eq!(out, expected.map(|frame| (frame, frame * 10)).collect::<Vec<_>>());
            prop_assert_eq!((frames.next(), frames.waiting()), (40, 0));
        }

        #[test]
        fn the_limit_holds_whatever_is_put(puts in prop::collection::vec(any::<(u32, bool)>(), 0..80)) {
            let mut frames = OrderedFrames::new(3);
            for (frame, is_skipped) in puts {
                let frame = if frame % 5 == 0 { frame } else { frame % 12 };
                let _ = if is_skipped { frames.skip(frame) } else { frames.put(frame, ()) };
                prop_assert!(frames.waiting() <= 4);
            }
        }
    }

    #[test]
    fn a_full_buffer_still_takes_the_frame_that_all_wait_for() {
        let mut frames = OrderedFrames::new(2);
        frames.put(1, 'b').unwrap();
        frames.put(2, 'c').unwrap();
        assert_eq!(frames.put(3, 'd'), Err(OrderError::Full { frame: 3, waiting: 2, next: 0 }));
        frames.put(0, 'a').unwrap();
        let out: String = std::iter::from_fn(|| frames.take()).map(|(_, letter)| letter).collect();
        assert_eq!(out, "abc");
    }

    #[test]
    fn a_repeated_frame_is_refused() {
        let mut frames = OrderedFrames::new(2);
        frames.put(0, ()).unwrap();
        assert_eq!(frames.put(0, ()), Err(OrderError::Repeated { frame: 0 }));
        assert!(frames.take().is_some());
        assert_eq!(frames.put(0, ()), Err(OrderError::Repeated { frame: 0 }));
        frames.skip(1).unwrap();
        assert_eq!(frames.put(1, ()), Err(OrderError::Repeated { frame: 1 }));
        assert_eq!(frames.put(u32::MAX, ()), Err(OrderError::Repeated { frame: u32::MAX }));
    }
}
