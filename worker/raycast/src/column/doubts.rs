//! Pixels of which the rays around them do not tell enough: compared with the surface.

use super::{ALLOWED, Columns};
use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};
use crate::lattice::Frame;
use crate::lod::Alone;
use crate::walk::Slopes;

/// How often a pixel is compared with the surface at most ...
const CORRECTIONS: i32 = 4;
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
    /// Places in the picture along the rows of the frame and across.
    minor: Vec<i32>,
    major: Vec<i32>,
    /// One over the least depth at which they may be.
    nearest: Vec<f32>,
    /// One over the depths at which they may be, in the order in which they are tried; 0
    /// for none, [`SKY`] if it is the sky then.
    guesses: [Vec<f32>; GUESSES],
    /// How often the first guess was moved.
    tries: Vec<i32>,
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

/// N of the pixels.
struct Pixels<L: Lanes> {
    place: [L::I; 2],
    nearest: L::F,
    guesses: [L::F; GUESSES],
    tries: L::I,
}

impl Doubts {
    /// Adds pixels of a row, by their place along it. The first guess is the closest one; the
    /// others are for those pixels that may need them.
    #[inline(always)]
    pub fn push<L: Lanes>(
        &mut self,
        [minor, major]: [L::I; 2],
        guess: L::F,
        others: Option<[L::F; 2]>,
        lanes: L::M,
    ) {
        let at = self.count;
        self.reserve(at + MOST);
        let (zero, guess) = (L::F::splat(0.0), guess.pack(lanes));
        let [mut second, mut third] = [zero; 2];
        if let Some(others) = others {
            (second, third) = (others[0].pack(lanes), others[1].pack(lanes));
        }
        minor.pack(lanes).store(&mut self.minor[at..]);
        major.store(&mut self.major[at..]);
        guess.store(&mut self.nearest[at..]);
        for (list, guess) in self.guesses.iter_mut().zip([guess, second, third]) {
            guess.store(&mut list[at..]);
        }
        L::I::splat(0).store(&mut self.tries[at..]);
        self.count = at + lanes.count() as usize;
    }

    #[inline(always)]
    fn add<L: Lanes>(&mut self, pixels: &Pixels<L>, lanes: L::M) {
        let at = self.count;
        self.reserve(at + MOST);
        let [minor, major] = pixels.place;
        minor.pack(lanes).store(&mut self.minor[at..]);
        major.pack(lanes).store(&mut self.major[at..]);
        pixels.nearest.pack(lanes).store(&mut self.nearest[at..]);
        for (list, guess) in self.guesses.iter_mut().zip(pixels.guesses) {
            guess.pack(lanes).store(&mut list[at..]);
        }
        pixels.tries.pack(lanes).store(&mut self.tries[at..]);
        self.count = at + lanes.count() as usize;
    }

    /// What it holds.
    pub fn bytes(&self) -> usize {
        (GUESSES + 4) * self.minor.capacity() * size_of::<i32>()
    }

    /// Makes the lists so long at least.
    #[inline(always)]
    fn reserve(&mut self, length: usize) {
        if self.minor.len() < length {
            self.grow(length);
        }
    }

    #[cold]
    #[inline(never)]
    fn grow(&mut self, length: usize) {
        let length = (2 * length).next_multiple_of(MOST);
        self.minor.resize(length, 0);
        self.major.resize(length, 0);
        self.tries.resize(length, 0);
        for list in self.guesses.iter_mut().chain([&mut self.nearest]) {
            list.resize(length, 0.0);
        }
    }

    #[inline(always)]
    fn place<L: Lanes>(&self, at: usize) -> [L::I; 2] {
        [L::I::load(&self.minor[at..]), L::I::load(&self.major[at..])]
    }

    /// The lanes from `at` on that are pixels. The others are pixels that were here before.
    #[inline(always)]
    fn lanes<L: Lanes>(&self, at: usize) -> L::M {
        L::M::from_bits(u32::MAX >> (32 - L::N.min(self.count - at)))
    }
}

impl Columns<'_, '_> {
    /// Puts pixels where their rays meet the surface, and clears the list. Those that are
    /// not found are added to `alone`.
    ///
    /// One step is done for all pixels before the next is for those that need it, so that no
    /// lane waits for another; `rest` is room for these.
    #[inline(always)]
    pub(super) fn decide<L: Lanes>(
        &self,
        frame: &Frame,
        doubts: &mut Doubts,
        rest: &mut Doubts,
        inverse_depth: &mut [f32],
        alone: &mut Vec<Alone>,
    ) {
        let (zero, none) = (L::F::splat(0.0), L::I::splat(0));
        while doubts.count > 0 {
            doubts.reserve(doubts.count + MOST);
            for at in (0..doubts.count).step_by(L::N) {
                let (place, lanes) = (doubts.place::<L>(at), doubts.lanes::<L>(at));
                let guess = L::F::load(&doubts.guesses[0][at..]);
                let step = self.step::<L>(frame, place, guess, lanes & zero.lt(guess));
                let places = self.places::<L>(frame, place);
                step.answer.scatter(inverse_depth, places, step.sure);
                let left = lanes & !step.sure;
                if !left.any() {
                    continue;
                }
                let tries = L::I::load(&doubts.tries[at..]) + L::I::splat(1);
                let open = step.open & tries.lt(L::I::splat(CORRECTIONS));
                let second = L::F::load(&doubts.guesses[1][at..]);
                let third = L::F::load(&doubts.guesses[2][at..]);
                let guesses = [
                    L::F::select(open, step.answer, second),
                    L::F::select(open, second, third),
                    L::F::select(open, third, zero),
                ];
                let again = left & zero.lt(guesses[0]) & !step.unknown;
                let nearest = L::F::load(&doubts.nearest[at..]);
                let tries = L::I::select(open, tries, none);
                rest.add::<L>(&Pixels { place, nearest, guesses, tries }, again);
                let done = left & !again;
                if done.any() {
                    let sky = done & guesses[0].eq(L::F::splat(SKY)) & !step.unknown;
                    zero.scatter(inverse_depth, places, sky);
                    lose::<L>(places, nearest, done & !sky, alone);
                }
            }
            doubts.count = 0;
            std::mem::swap(doubts, rest);
        }
    }

    /// Places of pixels in the region.
    #[inline(always)]
    fn places<L: Lanes>(&self, frame: &Frame, [minor, major]: [L::I; 2]) -> L::I {
        let (x, y) = if frame.by_rows { (minor, major) } else { (major, minor) };
        let row = y - L::I::splat(self.region.y as i32);
        let column = x - L::I::splat(self.region.x as i32);
        row.times(L::I::splat(self.region.width as i32)) + column
    }

    /// Compares guesses with the surface, and moves them to where their rays meet the tangent
    /// plane. That is the surface if it is in the same cell and this bends little between.
    #[inline(always)]
    fn step<L: Lanes>(&self, frame: &Frame, pixel: [L::I; 2], guess: L::F, lanes: L::M) -> Step<L> {
        let (zero, one, half) = (L::F::splat(0.0), L::F::splat(1.0), L::F::splat(0.5));
        let (minor, major) = (pixel[0].to_floats() + half, pixel[1].to_floats() + half);
        let mut ray = [zero; 3];
        for n in 0..3 {
            let along = minor * L::F::splat(frame.minor[n] as f32);
            let across = major * L::F::splat(frame.major[n] as f32);
            ray[n] = L::F::splat(frame.corner[n] as f32) + (along + across);
        }
        let [x, y, z] = ray;
        let across = x * x + y * y;
        // The square of what the tolerance allows at a depth of 1, where it is |ray| / focal.
        let allowed = ALLOWED * (self.tolerance_px / self.camera.focal_px());
        let allowed = L::F::splat((allowed * allowed) as f32) * (across + z * z);
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

/// Gives pixels rays of their own.
#[inline(always)]
fn lose<L: Lanes>(places: L::I, nearest: L::F, lanes: L::M, alone: &mut Vec<Alone>) {
    let (mut numbers, mut inverses) = ([0; MOST], [0.0; MOST]);
    places.store(&mut numbers);
    nearest.store(&mut inverses);
    let mut bits = lanes.bits();
    while bits != 0 {
        let lane = bits.trailing_zeros() as usize % MOST;
        bits &= bits - 1;
        let nearest = inverses[lane];
        let free = if nearest > 0.0 { SHARE_FREE / nearest } else { 0.0 };
        alone.push(Alone { at: numbers[lane] as u32, free });
    }
}
