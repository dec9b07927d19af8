//! Which levels of a pyramid a pixel is filtered from.

use crate::lanes::{Floats, Ints, Lanes, Mask};

/// The levels whose samples are at most, and at least, as large as what is asked for.
pub(crate) struct Between<L: Lanes> {
    pub level: L::I,
    /// Share of the next coarser level.
    pub share: L::F,
}

impl<L: Lanes> Between<L> {
    /// A size in samples of level 0: sizes 2^n (1 + w) give level n and the share of
    /// [`blend`]; sizes below 1 give level 0 alone, large ones the last one.
    #[inline(always)]
    pub(crate) fn of(size: L::F, last: usize) -> Self {
        let bits = size.max(L::F::splat(1.0)).to_bits();
        let last = L::I::splat(last as i32);
        let level = bits.shr(L::I::splat(23)) - L::I::splat(127);
        let one_to_two = (bits & L::I::splat(0x7F_FFFF)) + L::I::splat(127 << 23);
        let share = blend::<L>(L::F::from_bits(one_to_two) - L::F::splat(1.0));
        let zero = L::F::splat(0.0);
        Between { level: level.min(last), share: L::F::select(level.lt(last), share, zero) }
    }
}

/// Only the middle half of the way from one level to the next is blended: at its ends one
/// of them does alone, at half the cost.
#[inline(always)]
fn blend<L: Lanes>(way: L::F) -> L::F {
    (way + way - L::F::splat(0.5)).max(L::F::splat(0.0)).min(L::F::splat(1.0))
}

/// 2^-level.
#[inline(always)]
pub(crate) fn shrink<L: Lanes>(level: L::I) -> L::F {
    L::F::from_bits((L::I::splat(127) - level).shl(L::I::splat(23)))
}

/// The value of the first lane of those in a mask that has any.
#[inline(always)]
pub(crate) fn first<L: Lanes>(values: L::I, lanes: L::M) -> i32 {
    let mut all = [0; crate::lanes::MOST];
    values.store(&mut all);
    all[lanes.bits().trailing_zeros() as usize & (crate::lanes::MOST - 1)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::One;

    fn level_of(size: f32, last: usize) -> (i32, f32) {
        let between = Between::<One>::of(Floats::splat(size), last);
        let (mut level, mut share) = ([0], [0.0]);
        between.level.store(&mut level);
        between.share.store(&mut share);
        (level[0], share[0])
    }

    #[test]
    fn levels_are_continuous_in_size() {
        assert_eq!(level_of(0.3, 5), (0, 0.0));
        assert_eq!(level_of(1.0, 5), (0, 0.0));
        assert_eq!(level_of(3.0, 5), (1, 0.5));
        assert_eq!(level_of(1e9, 5), (5, 0.0));
        assert_eq!(level_of(f32::NAN, 5), (0, 0.0));
        assert_eq!(level_of(f32::INFINITY, 5), (5, 0.0));
        assert_eq!(level_of(7.0, 0), (0, 0.0));
        let mut last = 0.0;
        for step in 0..40_000 {
            let (level, share) = level_of(0.5 + step as f32 * 1e-3, 9);
            let place = level as f32 + share;
            assert!((0.0..0.003).contains(&(place - last)), "{step}");
            last = place;
        }
    }
}
