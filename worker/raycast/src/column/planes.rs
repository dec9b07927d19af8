//! What the rays of N lines see, from plane to plane: many rays of a line that follow each
//! other see the same one, over which one over the depth changes evenly from ray to ray.

use crate::column::{TOLD, WHOLE};
use crate::lanes::{Floats, Ints, Lanes, MOST};
use crate::walk::Places;

/// Stands where the plane is that of the ray before. A NaN that no sum gives.
const SAME: u32 = 0x7FC5_A3E1;

/// Values in a line of the cache.
const CACHE_LINE: usize = 16;

/// For each ray of N lines one over the depth of the plane that it sees, at ray 0, and what
/// that changes by from ray to ray, in whose last bits is what is known of the ground.
#[derive(Default)]
pub(super) struct Planes {
    found: Vec<f32>,
    /// Where they begin: at a line of the cache.
    first: usize,
}

impl Planes {
    /// Room for so many rays of each line, which find nothing yet.
    pub fn clear<L: Lanes>(&mut self, rays: usize) {
        let count = rays * 2 * L::N;
        self.found.clear();
        self.found.resize(count + CACHE_LINE, f32::from_bits(SAME));
        let first = self.found.as_ptr().align_offset(CACHE_LINE * size_of::<f32>());
        self.first = first.min(CACHE_LINE);
        self.found.truncate(self.first + count);
    }

    /// What it holds.
    pub fn bytes(&self) -> usize {
        self.found.capacity() * size_of::<f32>()
    }

    /// Where they belong.
    pub fn found(&mut self) -> &mut [f32] {
        &mut self.found[self.first..]
    }

    /// At which places.
    #[inline(always)]
    pub fn places<L: Lanes>(&self) -> Places<L> {
        let mut at = [0; MOST];
        for (at, lane) in at.iter_mut().zip(0..) {
            *at = lane;
        }
        Places { at: L::I::load(&at), pitch: 2 * L::N as i32, behind: Some(L::N as i32) }
    }

    /// One over the depths at which rays meet the planes, ray by ray from the first one, into
    /// `answers` from `at` on, and each so many further; the last bits are [`WHOLE`] and
    /// [`TOLD`].
    #[inline(always)]
    pub fn fill<L: Lanes>(&self, first: i32, answers: &mut [f32], mut at: usize, pitch: isize) {
        let (marks, rest) = (L::I::splat(WHOLE | TOLD), L::I::splat(!(WHOLE | TOLD)));
        let same = L::I::splat(SAME as i32);
        let (mut start, mut change) = (L::F::splat(0.0), L::F::splat(0.0));
        for (found, ray) in self.found[self.first..].chunks_exact(2 * L::N).zip(first..) {
            let next = L::F::load(found);
            let is_same = next.to_bits().eq(same);
            start = L::F::select(is_same, start, next);
            change = L::F::select(is_same, change, L::F::load(&found[L::N..]));
            let answer = start + L::F::splat(ray as f32) * change;
            let bits = (answer.to_bits() & rest) + (change.to_bits() & marks);
            L::F::from_bits(bits).store(&mut answers[at..]);
            at = at.wrapping_add_signed(pitch);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::{self, Kernel, Width};
    use crate::oracle::Dice;

    /// Puts planes in, and looks at what comes out for each ray.
    struct Filled<'d> {
        dice: &'d mut Dice,
        planes: &'d mut Planes,
    }

    impl Kernel for Filled<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Lanes>(self) {
            let Filled { dice, planes } = self;
            let (rays, first) = (1 + dice.below(40) as usize, dice.below(2000) as i32 - 1000);
            planes.clear::<L>(rays);
            let width = 2 * L::N;
            let mut truth = vec![[0.0f32; 2]; rays * L::N];
            for lane in 0..L::N {
                let mut plane = [0.0, 0.0];
                for ray in 0..rays {
                    if dice.below(3) == 0 {
                        let start =
                            [dice.between(0.1, 9.0) as f32, f32::NAN][dice.below(9) as usize / 8];
                        plane = [start, dice.between(-1e-3, 1e-3) as f32];
                        planes.found()[ray * width + lane] = plane[0];
                        planes.found()[ray * width + L::N + lane] = plane[1];
                    }
                    truth[ray * L::N + lane] = plane;
                }
            }
            // From the last row up, with a margin of one.
            let stride = L::N + 1;
            let mut answers = vec![-1.0; rays * stride];
            planes.fill::<L>(first, &mut answers, (rays - 1) * stride, -(stride as isize));
            for ray in 0..rays {
                let row = &answers[(rays - 1 - ray) * stride..][..stride];
                for lane in 0..L::N {
                    let [start, change] = truth[ray * L::N + lane];
                    let depth = start + (first + ray as i32) as f32 * change;
                    let marks = (WHOLE | TOLD) as u32;
                    let bits = depth.to_bits() & !marks | change.to_bits() & marks;
                    assert_eq!(row[lane].to_bits(), bits, "{ray} of {rays}, lane {lane}");
                }
                assert_eq!(row[L::N], -1.0);
            }
        }
    }

    #[test]
    fn every_ray_sees_the_plane_that_began_last() {
        for width in Width::available() {
            let (mut dice, mut planes) = (Dice::new(5), Planes::default());
            for _ in 0..400 {
                lanes::run(Filled { dice: &mut dice, planes: &mut planes }, width);
            }
        }
    }
}
