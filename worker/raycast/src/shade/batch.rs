//! Places on their way from step to step of the shading.

use super::photo::Rows;
use super::slope::Cells;
use crate::lanes::{Floats, Lanes, MOST};
use crate::srgb;
use std::ops::{Deref, DerefMut};

/// Places of the picture, and how far away the ground is that is seen there.
#[derive(Clone, Copy)]
pub(crate) struct Places<'p> {
    pub at: At<'p>,
    pub far: Far<'p>,
}

/// Places of the picture, x and y, pixels from its top left corner.
#[derive(Clone, Copy)]
pub(crate) enum At<'p> {
    /// One for each x, with the y of the same number.
    Each(&'p [f32], &'p [f32]),
    /// All of the columns at the first y, then all at the second, and so on.
    Net(&'p [f32], &'p [f32]),
}

/// How far away the ground is.
#[derive(Clone, Copy)]
pub(crate) enum Far<'p> {
    /// Metres along the map; infinite for the sky, NaN where a tile is missing. The way of
    /// a ray that is steeper than one in a million counts as if it were that.
    Map(&'p [f32]),
    /// One over the depth, as [`crate::seen::Seen`] has it.
    Inverse(&'p [f32]),
}

impl Far<'_> {
    pub(super) fn values(&self) -> &[f32] {
        let (Far::Map(values) | Far::Inverse(values)) = self;
        values
    }
}

/// Places that are shaded at once; a multiple of all numbers of lanes.
pub(super) const AT_ONCE: usize = 128;
/// Vectors of them, at most.
pub(super) const VECTORS: usize = AT_ONCE;

/// One value a place. No vector of them crosses a line of the cache.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub(super) struct Each<T>([T; AT_ONCE]);

impl<T: Copy> Each<T> {
    pub(super) fn new(value: T) -> Self {
        Each([value; AT_ONCE])
    }
}

impl<T> Deref for Each<T> {
    type Target = [T; AT_ONCE];
    #[inline(always)]
    fn deref(&self) -> &[T; AT_ONCE] {
        &self.0
    }
}

impl<T> DerefMut for Each<T> {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [T; AT_ONCE] {
        &mut self.0
    }
}

/// Some places on their way from step to step. Masks are bits, one word a vector.
pub(super) struct Batch {
    pub(super) count: usize,
    pub(super) x: Each<f32>,
    pub(super) y: Each<f32>,
    pub(super) far: Each<f32>,
    /// It is one over the depth.
    pub(super) inverse: bool,
    pub(super) ground: [u32; VECTORS],
    pub(super) sky: [u32; VECTORS],
    pub(super) unsure: [u32; VECTORS],
    pub(super) view: [Each<f32>; 3],
    pub(super) along: [Each<f32>; 2],
    pub(super) over: Each<f32>,
    pub(super) distance: Each<f32>,
    pub(super) falls: Each<f32>,
    pub(super) size: Each<f32>,
    pub(super) slopes: [Each<f32>; 2],
    pub(super) steepness: Each<f32>,
    pub(super) light: [Each<f32>; 3],
    pub(super) covered: Each<f32>,
    pub(super) cells: Cells,
    pub(super) rows: Rows,
}

impl Batch {
    pub(super) fn new() -> Self {
        let none = Each::new(0.0);
        Batch {
            count: 0,
            x: none,
            y: none,
            far: none,
            inverse: false,
            ground: [0; VECTORS],
            sky: [0; VECTORS],
            unsure: [0; VECTORS],
            view: [none; 3],
            along: [none; 2],
            over: none,
            distance: none,
            falls: none,
            size: none,
            slopes: [none; 2],
            steepness: none,
            light: [none; 3],
            covered: none,
            cells: Cells::new(),
            rows: Rows::new(),
        }
    }

    /// Takes the places from `at` on, as many as fit. Those that fill the last vector up
    /// need nothing.
    #[inline(always)]
    pub(super) fn fill(&mut self, places: Places, at: usize) {
        let far = places.far.values();
        self.count = AT_ONCE.min(far.len() - at);
        self.inverse = matches!(places.far, Far::Inverse(_));
        let end = at + self.count;
        self.far[..self.count].copy_from_slice(&far[at..end]);
        let last = (self.count + MOST).min(AT_ONCE);
        self.far[self.count..last].fill(f32::NAN);
        match places.at {
            At::Each(x, y) => {
                self.x[..self.count].copy_from_slice(&x[at..end]);
                self.y[..self.count].copy_from_slice(&y[at..end]);
            }
            At::Net(x, y) => {
                let mut filled = 0;
                while filled < self.count {
                    let (row, column) = ((at + filled) / x.len(), (at + filled) % x.len());
                    let run = (x.len() - column).min(self.count - filled);
                    self.x[filled..][..run].copy_from_slice(&x[column..][..run]);
                    self.y[filled..][..run].fill(y[row]);
                    filled += run;
                }
            }
        }
    }

    /// The places of vector `n` of which it is not known what they show.
    #[inline(always)]
    pub(super) fn unknown<L: Lanes>(&self, n: usize) -> u32 {
        let filled = self.count - n * L::N;
        let all = (1 << filled.min(L::N)) - 1;
        all & !(self.sky[n] | (self.ground[n] & !self.unsure[n]))
    }

    #[inline(always)]
    pub(super) fn light<L: Lanes>(&self, at: usize) -> [L::F; 3] {
        let [red, green, blue] = &self.light;
        [L::F::load(&red[at..]), L::F::load(&green[at..]), L::F::load(&blue[at..])]
    }

    #[inline(always)]
    pub(super) fn view<L: Lanes>(&self, at: usize) -> [L::F; 3] {
        let [x, y, z] = &self.view;
        [L::F::load(&x[at..]), L::F::load(&y[at..]), L::F::load(&z[at..])]
    }

    #[inline(always)]
    pub(super) fn along<L: Lanes>(&self, at: usize) -> [L::F; 2] {
        [L::F::load(&self.along[0][at..]), L::F::load(&self.along[1][at..])]
    }

    #[inline(always)]
    pub(super) fn slopes<L: Lanes>(&self, at: usize) -> [L::F; 2] {
        [L::F::load(&self.slopes[0][at..]), L::F::load(&self.slopes[1][at..])]
    }
}

/// Where the light goes.
pub(super) enum Canvas<'p> {
    /// Red, green and blue.
    Light([&'p mut [f32]; 3]),
    /// Three bytes a place, and the numbers of the places for which a tile is missing.
    Bytes(&'p mut [u8], &'p mut Vec<usize>),
}

impl Canvas<'_> {
    /// Takes the light of a batch, whose first place has the number `at`.
    #[inline(always)]
    pub(super) fn take<L: Lanes>(&mut self, batch: &Batch, at: usize) {
        let count = batch.count;
        match self {
            Canvas::Light(light) => {
                for c in 0..3 {
                    light[c][at..at + count].copy_from_slice(&batch.light[c][..count]);
                }
            }
            Canvas::Bytes(pixels, unknown) => {
                let pixels = &mut pixels[3 * at..3 * (at + count)];
                for (n, pixels) in pixels.chunks_mut(3 * L::N).enumerate() {
                    srgb::store::<L>(batch.light::<L>(n * L::N), pixels);
                    let mut left = batch.unknown::<L>(n);
                    while left != 0 {
                        unknown.push(at + n * L::N + left.trailing_zeros() as usize);
                        left &= left - 1;
                    }
                }
            }
        }
    }
}
