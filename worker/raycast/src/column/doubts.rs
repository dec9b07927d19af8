//! Pixels of which the rays around them do not tell enough: compared with the surface.

use super::{ALLOWED, Columns};
use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};
use crate::lattice::Frame;
use crate::lod::Alone;
use crate::walk::Slopes;

/// How often a pixel is compared with the surface at most ...
const CORRECTIONS: usize = 4;
/// ... and by what share of its depth it may be moved each time.
const FARTHEST: f32 = 0.05;
/// How much closer than the nearest ground seen around a pixel its own ray begins to look:
/// a ridge may come closer between the rays around it.
const SHARE_FREE: f32 = 0.9;

/// Pixels, N of which are compared at once.
#[derive(Default)]
pub(super) struct Doubts {
    /// How many there are. The lists are longer: whole vectors are written and read.
    count: usize,
    /// Column and row in the picture.
    x: Vec<i32>,
    y: Vec<i32>,
    /// One over the least depth at which they may be.
    nearest: Vec<f32>,
    /// One over the depths at which they may be, in the order in which they are tried; 0
    /// for none, [`SKY`] if it is the sky then.
    guesses: [Vec<f32>; GUESSES],
}

/// Guesses of a pixel at most.
pub(super) const GUESSES: usize = 3;
/// The guess that a pixel sees the sky.
pub(super) const SKY: f32 = -1.0;

/// What comes of a guess.
struct Step<L: Lanes> {
    /// Pixels that are on the surface at `answer` ...
    sure: L::M,
    /// ... that may be there, ...
    open: L::M,
    /// ... and that came to a tile that is not loaded.
    unknown: L::M,
    answer: L::F,
}

/// N pixels: their rays, for one along the axis of the camera.
struct Sights<L: Lanes> {
    ray: [L::F; 3],
    /// The square of the ray's length along the map.
    across: L::F,
    /// The square of what the tolerance allows at a depth of 1.
    allowed: L::F,
}

impl Doubts {
    /// Adds pixels whose first guess is the closest one.
    #[inline(always)]
    pub fn push<L: Lanes>(&mut self, place: [L::I; 2], guesses: [L::F; GUESSES], lanes: L::M) {
        self.add::<L>(place, guesses[0], guesses, lanes);
    }

    #[inline(always)]
    fn add<L: Lanes>(
        &mut self,
        [x, y]: [L::I; 2],
        nearest: L::F,
        guesses: [L::F; GUESSES],
        lanes: L::M,
    ) {
        let at = self.count;
        self.reserve(at + MOST);
        x.pack(&mut self.x[at..], lanes);
        y.pack(&mut self.y[at..], lanes);
        nearest.pack(&mut self.nearest[at..], lanes);
        for n in 0..GUESSES {
            guesses[n].pack(&mut self.guesses[n][at..], lanes);
        }
        self.count = at + lanes.count() as usize;
    }

    /// Makes the lists so long at least.
    #[inline(always)]
    fn reserve(&mut self, length: usize) {
        if self.x.len() < length {
            self.grow(length);
        }
    }

    #[cold]
    #[inline(never)]
    fn grow(&mut self, length: usize) {
        let length = (2 * length).next_multiple_of(MOST);
        self.x.resize(length, 0);
        self.y.resize(length, 0);
        for list in self.guesses.iter_mut().chain([&mut self.nearest]) {
            list.resize(length, 0.0);
        }
    }

    #[inline(always)]
    fn place<L: Lanes>(&self, at: usize) -> [L::I; 2] {
        [L::I::load(&self.x[at..]), L::I::load(&self.y[at..])]
    }

    /// The lanes from `at` on that are pixels. The others are pixels that were here before.
    #[inline(always)]
    fn lanes<L: Lanes>(&self, at: usize) -> L::M {
        L::M::from_bits(u32::MAX >> (32 - L::N.min(self.count - at)))
    }
}

impl Columns<'_, '_> {
    /// Puts pixels where their rays meet the surface, and clears the lists. Those that are
    /// not found are added to `alone`.
    ///
    /// Most are found where they are looked for first. The others are put into `rest`, so
    /// that no lane waits for another.
    #[inline(always)]
    pub(super) fn decide<L: Lanes>(
        &self,
        [doubts, rest]: [&mut Doubts; 2],
        inverse_depth: &mut [f32],
        alone: &mut Vec<Alone>,
    ) {
        let frame = Frame::new(self.camera, true);
        let zero = L::F::splat(0.0);
        doubts.reserve(doubts.count + MOST);
        for at in (0..doubts.count).step_by(L::N) {
            let (place, lanes) = (doubts.place::<L>(at), doubts.lanes::<L>(at));
            let [first, second, third] = &doubts.guesses;
            let guess = L::F::load(&first[at..]);
            let sights = self.sights::<L>(&frame, place);
            let step = self.step::<L>(&sights, guess, lanes & zero.lt(guess));
            step.answer.scatter(inverse_depth, self.places::<L>(place), step.sure);
            let left = lanes & !step.sure;
            if left.any() {
                let guesses = [
                    L::F::select(step.open, step.answer, zero),
                    L::F::select(step.unknown, zero, L::F::load(&second[at..])),
                    L::F::select(step.unknown, zero, L::F::load(&third[at..])),
                ];
                rest.add::<L>(place, guess, guesses, left);
            }
        }
        doubts.count = 0;
        rest.reserve(rest.count + MOST);
        for at in (0..rest.count).step_by(L::N) {
            let (place, lanes) = (rest.place::<L>(at), rest.lanes::<L>(at));
            let sights = self.sights::<L>(&frame, place);
            let (mut answer, mut sure, mut open) = (zero, L::M::none(), lanes);
            for guesses in &rest.guesses {
                let guess = L::F::load(&guesses[at..]);
                let next = open & zero.lt(guess);
                if next.any() {
                    let (found, settled, unknown) = self.settle::<L>(&sights, guess, next);
                    answer = L::F::select(settled, found, answer);
                    sure = sure | settled;
                    open = open & !settled & !unknown;
                }
                // The answer then is 0.
                sure = sure | (open & guess.eq(L::F::splat(SKY)));
                open = open & !sure;
            }
            let places = self.places::<L>(place);
            answer.scatter(inverse_depth, places, lanes);
            let mut lost = (lanes & !sure).bits();
            if lost != 0 {
                let mut numbers = [0; MOST];
                places.store(&mut numbers);
                while lost != 0 {
                    let lane = lost.trailing_zeros() as usize % MOST;
                    lost &= lost - 1;
                    let nearest = rest.nearest[at + lane];
                    let free = if nearest > 0.0 { SHARE_FREE / nearest } else { 0.0 };
                    alone.push(Alone { at: numbers[lane] as u32, free });
                }
            }
        }
        rest.count = 0;
    }

    /// Places of pixels in the region.
    #[inline(always)]
    fn places<L: Lanes>(&self, [x, y]: [L::I; 2]) -> L::I {
        let row = y - L::I::splat(self.region.y as i32);
        let column = x - L::I::splat(self.region.x as i32);
        row.times(L::I::splat(self.region.width as i32)) + column
    }

    #[inline(always)]
    fn sights<L: Lanes>(&self, frame: &Frame, [x, y]: [L::I; 2]) -> Sights<L> {
        let half = L::F::splat(0.5);
        let (u, v) = (x.to_floats() + half, y.to_floats() + half);
        let mut ray = [u; 3];
        for n in 0..3 {
            let change =
                u * L::F::splat(frame.minor[n] as f32) + v * L::F::splat(frame.major[n] as f32);
            ray[n] = L::F::splat(frame.corner[n] as f32) + change;
        }
        let across = ray[0] * ray[0] + ray[1] * ray[1];
        // The tolerance as a length at depth 1: |ray| / focal.
        let allowed = ALLOWED * (self.tolerance_px / self.camera.focal_px());
        let allowed = L::F::splat((allowed * allowed) as f32) * (across + ray[2] * ray[2]);
        Sights { ray, across, allowed }
    }

    /// Moves guesses along rays until they are on the surface, where it faces the camera.
    /// Returns which have got there, and which came to a tile that is not loaded.
    #[inline(always)]
    fn settle<L: Lanes>(&self, sights: &Sights<L>, guess: L::F, lanes: L::M) -> (L::F, L::M, L::M) {
        let (mut answer, mut sure, mut left) = (guess, L::M::none(), lanes);
        let mut unknown = L::M::none();
        for _ in 0..CORRECTIONS {
            let step = self.step::<L>(sights, answer, left);
            answer = L::F::select(left, step.answer, answer);
            sure = sure | step.sure;
            unknown = unknown | step.unknown;
            left = step.open;
            if !left.any() {
                break;
            }
        }
        (answer, sure, unknown)
    }

    /// Compares guesses with the surface, and moves them to where their rays meet the tangent
    /// plane. That is the surface if it is in the same cell and this bends little between.
    #[inline(always)]
    fn step<L: Lanes>(&self, sights: &Sights<L>, guess: L::F, lanes: L::M) -> Step<L> {
        let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
        let Sights { ray: [x, y, z], across, allowed } = *sights;
        let depth = one.div(guess);
        let ground = self.relief.surface::<L>([x * depth, y * depth], lanes);
        let curvature = self.relief.curvature as f32;
        let (height, rise) = if curvature == 0.0 {
            (z * depth, z)
        } else {
            let length = across.sqrt();
            let slopes = Slopes::<L>::new(self.relief, z.div(length));
            (slopes.height(length * depth), z + L::F::splat(curvature) * across * depth)
        };
        let off = height - ground.height;
        let closing = rise - ground.slopes[0] * x - ground.slopes[1] * y;
        let share = off * guess;
        let facing = closing.lt(zero) & ground.solid;
        let near = facing & (share * share).le(allowed);
        let moved = off.div(closing);
        let answer = one.div(depth - moved);
        let close = (answer - guess).abs().lt(L::F::splat(FARTHEST) * guess);
        // Within the cell the slopes change by its twist alone.
        let (along_x, along_y) = (x * ground.pace[0], y * ground.pace[1]);
        let (du, dv) = (along_x * moved, along_y * moved);
        let (u, v) = (ground.part[0] - du, ground.part[1] - dv);
        let inside = zero.le(u) & u.le(one) & zero.le(v) & v.le(one);
        let turned = closing + ground.twist * (dv * along_x + du * along_y);
        let bent = (ground.twist * du * dv).abs() + L::F::splat(curvature) * across * moved * moved;
        let share = bent * answer;
        let there = inside & (share * share).le(allowed) & turned.lt(zero);
        let reached = ground.solid & close & there;
        Step {
            sure: lanes & (near | reached),
            open: lanes & ground.solid & close & !near & !reached,
            unknown: lanes & ground.absent,
            answer: L::F::select(near & !reached, guess, answer),
        }
    }
}
