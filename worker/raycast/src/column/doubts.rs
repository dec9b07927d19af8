//! Pixels of which the rays around them do not tell enough: compared with the surface.

use super::{ALLOWED, Columns};
use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};
use crate::lattice::Frame;
use crate::lod::Alone;
use crate::walk::Slopes;
use glam::DVec3;

/// How often a pixel is compared with the surface at most ...
const CORRECTIONS: usize = 4;
/// ... and by what share of its depth it may be moved each time.
const FARTHEST: f32 = 0.05;
/// How much closer than the nearest ground seen around a pixel its own ray begins to look:
/// a ridge may come closer between the rays around it.
const SHARE_FREE: f32 = 0.9;

/// Pixels, N of which are compared at once.
pub(super) struct Doubts {
    /// Column and row in the picture.
    x: Vec<i32>,
    y: Vec<i32>,
    /// One over the depths at which they may be, in the order in which they are tried; 0
    /// for none, [`SKY`] if it is the sky then.
    guesses: [Vec<f32>; GUESSES],
}

/// Guesses of a pixel at most.
pub(super) const GUESSES: usize = 3;
/// The guess that a pixel sees the sky.
pub(super) const SKY: f32 = -1.0;

impl Doubts {
    pub fn new() -> Self {
        Doubts { x: Vec::new(), y: Vec::new(), guesses: [const { Vec::new() }; GUESSES] }
    }

    #[inline]
    pub fn push(&mut self, [x, y]: [u32; 2], guesses: [f32; GUESSES]) {
        self.x.push(x as i32);
        self.y.push(y as i32);
        for (list, guess) in self.guesses.iter_mut().zip(guesses) {
            list.push(guess);
        }
    }

    fn clear(&mut self) {
        for list in [&mut self.x, &mut self.y] {
            list.clear();
        }
        for list in &mut self.guesses {
            list.clear();
        }
    }

    /// Repeats the last pixel until the vectors are full. Returns how many there were.
    fn fill(&mut self) -> usize {
        let count = self.x.len();
        let full = count.next_multiple_of(MOST);
        for list in [&mut self.x, &mut self.y] {
            list.resize(full, list.last().copied().unwrap_or_default());
        }
        for list in &mut self.guesses {
            list.resize(full, list.last().copied().unwrap_or_default());
        }
        count
    }
}

impl Columns<'_, '_> {
    /// Puts pixels where their rays meet the surface, and clears the list. Those that are
    /// not found are added to `alone`.
    #[inline(always)]
    pub(super) fn decide<L: Lanes>(
        &self,
        doubts: &mut Doubts,
        inverse_depth: &mut [f32],
        alone: &mut Vec<Alone>,
    ) {
        let count = doubts.fill();
        let frame = Frame::new(self.camera, true);
        let part = |vector: DVec3| vector.as_vec3().to_array();
        let (corner, right, down) = (part(frame.corner), part(frame.minor), part(frame.major));
        let half = L::F::splat(0.5);
        let (left, top) = (L::I::splat(self.region.x as i32), L::I::splat(self.region.y as i32));
        for at in (0..count).step_by(L::N) {
            let (x, y) = (L::I::load(&doubts.x[at..]), L::I::load(&doubts.y[at..]));
            let (u, v) = (x.to_floats() + half, y.to_floats() + half);
            let mut ray = [u; 3];
            for n in 0..3 {
                let change = u * L::F::splat(right[n]) + v * L::F::splat(down[n]);
                ray[n] = L::F::splat(corner[n]) + change;
            }
            let all = L::M::from_bits(u32::MAX >> (32 - L::N.min(count - at)));
            let (zero, sky) = (L::F::splat(0.0), L::F::splat(SKY));
            let (mut answer, mut sure, mut open) = (zero, L::M::none(), all);
            for guesses in &doubts.guesses {
                let guess = L::F::load(&guesses[at..]);
                let next = open & zero.lt(guess);
                if next.any() {
                    let (found, settled, unknown) = self.settle::<L>(ray, guess, next);
                    answer = L::F::select(next & settled, found, answer);
                    sure = sure | (next & settled);
                    open = open & !settled & !unknown;
                }
                // The answer then is 0.
                sure = sure | (open & guess.eq(sky));
                open = open & !sure;
            }
            let places = (y - top).times(L::I::splat(self.region.width as i32)) + (x - left);
            answer.scatter(inverse_depth, places, all);
            let mut lost = (all & !sure).bits();
            if lost != 0 {
                let (mut nearest, mut lanes) = ([0.0; MOST], [0; MOST]);
                L::F::load(&doubts.guesses[0][at..]).store(&mut nearest);
                places.store(&mut lanes);
                while lost != 0 {
                    let lane = lost.trailing_zeros() as usize % MOST;
                    lost &= lost - 1;
                    let nearest = nearest[lane];
                    let free = if nearest > 0.0 { SHARE_FREE / nearest } else { 0.0 };
                    alone.push(Alone { at: lanes[lane] as u32, free });
                }
            }
        }
        doubts.clear();
    }

    /// Moves guesses along rays until they are on the surface, where it faces the camera.
    /// Returns which have got there, and which came to a tile that is not loaded.
    #[inline(always)]
    fn settle<L: Lanes>(&self, ray: [L::F; 3], guess: L::F, lanes: L::M) -> (L::F, L::M, L::M) {
        let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
        let [x, y, z] = ray;
        let across = x * x + y * y;
        // The tolerance as a length at depth 1: |ray| / focal.
        let allowed = ALLOWED * (self.tolerance_px / self.camera.focal_px());
        let allowed = L::F::splat((allowed * allowed) as f32) * (across + z * z);
        let (mut answer, mut sure, mut left) = (guess, L::M::none(), lanes);
        let mut unknown = L::M::none();
        for _ in 0..CORRECTIONS {
            let depth = one.div(answer);
            let (solid, absent, ground, slopes) =
                self.relief.surface::<L>([x * depth, y * depth], left);
            unknown = unknown | absent;
            let (height, rise) = if self.relief.curvature == 0.0 {
                (z * depth, z)
            } else {
                let length = across.sqrt();
                let slopes = Slopes::<L>::new(self.relief, z.div(length));
                let bend = L::F::splat(self.relief.curvature as f32) * across * depth;
                (slopes.height(length * depth), z + bend)
            };
            let off = height - ground;
            let share = off * answer;
            let closing = rise - slopes[0] * x - slopes[1] * y;
            let near = (share * share).le(allowed) & closing.lt(zero);
            sure = sure | (left & solid & near);
            left = left & solid & !sure;
            if !left.any() {
                break;
            }
            let corrected = one.div(depth - off.div(closing));
            let near = (corrected - answer).abs().lt(L::F::splat(FARTHEST) * answer);
            left = left & near;
            answer = L::F::select(left, corrected, answer);
        }
        (answer, sure, unknown)
    }
}
