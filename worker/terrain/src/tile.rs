//! One tile: as bytes in a store, and decoded for use.

use crate::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};

mod codes;
mod maxima;
mod photo;

pub use maxima::{MAXIMA_LEVELS, MAXIMA_START};
pub use photo::{FIELDS, PHOTO_TILE_BYTES, PhotoTile, TURNED, Texels};

use maxima::{MAXIMA_COUNT, Sample, maxima_of};

/// Heights of one tile with the maxima that let a ray skip ground it cannot touch.
///
/// Posts are addressed relative to the tile's south-west post, −1 ..= 257 along each
/// axis (see [`TILE_RING`]). A void post is NaN.
///
/// Kept in two bytes a post where all heights are multiples of one step, which those of
/// nearly all terrain are; else in four. Either way every post is what was given, to the
/// bit.
pub struct HeightTile {
    kept: Kept,
    has_voids: bool,
}

enum Kept {
    Codes { posts: Box<[u16]>, maxima: Box<[u16]>, base: i32, step: f64 },
    Floats { posts: Box<[f32]>, maxima: Box<[f32]> },
}

/// The code of a void post.
pub const VOID: u16 = u16::MAX;

/// The arrays of a tile as the kernels read them.
///
/// In both forms the posts are row-major from the south-west, ring included,
/// [`TILE_POSTS`] a row; the maxima of all levels follow one another from
/// [`MAXIMA_START`]. Each array has one element more at its end, so that a load of two
/// elements at the last one stays inside.
#[derive(Debug, Clone, Copy)]
pub enum Heights<'a> {
    /// Two bytes a post.
    Codes(Codes<'a>),
    /// Four bytes a post.
    Floats(Floats<'a>),
}

/// Heights as multiples of a step: a post is
/// `(f64::from(base + i32::from(code)) * step) as f32` metres, a code of 1 to 65534 the
/// higher, the higher it is.
#[derive(Debug, Clone, Copy)]
pub struct Codes<'a> {
    /// Codes of the posts; [`VOID`] for a void.
    pub posts: &'a [u16],
    /// Codes of the maxima; 0, which is below every post, where no cell is valid.
    pub maxima: &'a [u16],
    /// Steps to code 0. Base plus any code is an i32.
    pub base: i32,
    /// The step, metres.
    pub step: f64,
}

/// Heights as they are, metres.
#[derive(Debug, Clone, Copy)]
pub struct Floats<'a> {
    /// The posts; NaN for a void.
    pub posts: &'a [f32],
    /// The maxima; −infinity where no cell is valid.
    pub maxima: &'a [f32],
}

impl Codes<'_> {
    /// Height of a code, metres; NaN for [`VOID`].
    #[inline(always)]
    pub fn height(&self, code: u16) -> f32 {
        if code == VOID { f32::NAN } else { codes::height(self.base, self.step, code) }
    }
}

/// Bytes of the largest [`HeightTile`] in memory: one with four bytes a post, and a third
/// of the posts for the maxima.
pub const HEIGHT_TILE_BYTES: usize =
    size_of::<HeightTile>() + size_of::<f32>() * (TILE_POSTS * TILE_POSTS + MAXIMA_COUNT + 2);
impl Sample for u16 {
    const NOTHING: u16 = 0;

    fn is_void(self) -> bool {
        self == VOID
    }
}

impl Sample for f32 {
    const NOTHING: f32 = f32::NEG_INFINITY;

    fn is_void(self) -> bool {
        self.is_nan()
    }
}

impl HeightTile {
    /// A tile from its posts, row by row from the south-west, ring included.
    /// `None` if their number is not [`TILE_POSTS`] squared.
    pub fn new(posts: Box<[f32]>) -> Option<Self> {
        if posts.len() != TILE_POSTS * TILE_POSTS {
            return None;
        }
        let has_voids = posts.iter().any(|height| height.is_nan());
        let kept = match codes::coded(&posts) {
            Some(coded) => Kept::Codes {
                maxima: maxima_of(&coded.posts, has_voids),
                posts: coded.posts,
                base: coded.base,
                step: coded.step,
            },
            None => {
                let mut padded = Vec::with_capacity(posts.len() + 1);
                padded.extend_from_slice(&posts);
                padded.push(f32::NAN);
                let maxima = maxima_of(&posts, has_voids);
                Kept::Floats { maxima, posts: padded.into_boxed_slice() }
            }
        };
        Some(HeightTile { kept, has_voids })
    }

    /// The arrays of the tile.
    #[inline(always)]
    pub fn heights(&self) -> Heights<'_> {
        match &self.kept {
            Kept::Codes { posts, maxima, base, step } => {
                Heights::Codes(Codes { posts, maxima, base: *base, step: *step })
            }
            Kept::Floats { posts, maxima } => Heights::Floats(Floats { posts, maxima }),
        }
    }

    /// Height of a post, metres; NaN for a void. `i` and `j` from −1 to 257.
    #[inline]
    pub fn post(&self, i: isize, j: isize) -> f32 {
        let column = (i + TILE_RING as isize) as usize;
        let row = (j + TILE_RING as isize) as usize;
        let at = row * TILE_POSTS + column;
        match self.heights() {
            Heights::Codes(codes) => codes.height(codes.posts[at]),
            Heights::Floats(floats) => floats.posts[at],
        }
    }

    /// The corners of a cell: south-west, south-east, north-west, north-east.
    /// `i` and `j` from 0 to 255.
    #[inline]
    pub fn corners(&self, i: usize, j: usize) -> [f32; 4] {
        let at = (j + TILE_RING) * TILE_POSTS + i + TILE_RING;
        match self.heights() {
            Heights::Codes(codes) => {
                let posts = &codes.posts[at..at + TILE_POSTS + 2];
                [posts[0], posts[1], posts[TILE_POSTS], posts[TILE_POSTS + 1]]
                    .map(|code| codes.height(code))
            }
            Heights::Floats(floats) => {
                let posts = &floats.posts[at..at + TILE_POSTS + 2];
                [posts[0], posts[1], posts[TILE_POSTS], posts[TILE_POSTS + 1]]
            }
        }
    }

    /// Highest corner of the valid cells in a block of `1 << level` cells a side, level 1
    /// to 8; block (0, 0) is the south-west one. −infinity where no cell is valid.
    #[inline]
    pub fn block_max(&self, level: usize, bi: usize, bj: usize) -> f32 {
        let at = MAXIMA_START[level] + bj * (TILE_CELLS >> level) + bi;
        match self.heights() {
            Heights::Codes(codes) => match codes.maxima[at] {
                u16::NOTHING => f32::NEG_INFINITY,
                code => codes.height(code),
            },
            Heights::Floats(floats) => floats.maxima[at],
        }
    }

    /// Whether any post of the tile, ring included, is void.
    pub fn has_voids(&self) -> bool {
        self.has_voids
    }

    /// All posts, row by row from the south-west, ring included.
    pub fn to_posts(&self) -> Box<[f32]> {
        let count = TILE_POSTS * TILE_POSTS;
        match self.heights() {
            Heights::Codes(codes) => {
                codes.posts[..count].iter().map(|&code| codes.height(code)).collect()
            }
            Heights::Floats(floats) => floats.posts[..count].into(),
        }
    }

    /// Bytes this tile takes in memory.
    pub fn memory_bytes(&self) -> usize {
        let arrays = match self.heights() {
            Heights::Codes(codes) => size_of_val(codes.posts) + size_of_val(codes.maxima),
            Heights::Floats(floats) => size_of_val(floats.posts) + size_of_val(floats.maxima),
        };
        arrays + size_of::<Self>()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    fn tile(rule: impl Fn(isize, isize) -> f32) -> HeightTile {
        let side = TILE_POSTS as isize;
        let posts = (0..side * side).map(|at| rule(at % side - 1, at / side - 1)).collect();
        HeightTile::new(posts).unwrap()
    }

    #[test]
    fn posts_are_addressed_from_the_south_west_with_a_ring() {
        let tile = tile(|i, j| (1000 * j + i) as f32);
        assert_eq!(tile.post(-1, -1), -1001.0);
        assert_eq!(tile.post(257, 257), 257_257.0);
        assert_eq!(tile.corners(255, 0), [255.0, 256.0, 1255.0, 1256.0]);
    }

    #[test]
    fn maxima_bound_valid_cells_and_no_others() {
        let rough = |i: isize, j: isize| ((i * 7919 + j * 104_729) % 1009) as f32 - 300.0;
        let holed = |i: isize, j: isize| if (i * j) % 97 == 5 { f32::NAN } else { rough(i, j) };
        assert!(!tile(rough).has_voids() && tile(holed).has_voids());
        for scale in [1.0, 0.1, 0.123_456_7] {
            check_maxima(&tile(|i, j| rough(i, j) * scale));
            check_maxima(&tile(|i, j| holed(i, j) * scale));
        }
        check_maxima(&tile(|_, _| f32::NAN));
    }

    #[track_caller]
    fn check_maxima(tile: &HeightTile) {
        for level in 1..=MAXIMA_LEVELS {
            let side = 1 << level;
            for bj in 0..TILE_CELLS / side {
                for bi in 0..TILE_CELLS / side {
                    let cells = (bj * side..(bj + 1) * side)
                        .flat_map(|j| (bi * side..(bi + 1) * side).map(move |i| (i, j)));
                    let expected = cells
                        .map(|(i, j)| tile.corners(i, j))
                        .filter(|corners| corners.iter().all(|height| !height.is_nan()))
                        .flatten()
                        .fold(f32::NEG_INFINITY, f32::max);
                    assert_eq!(tile.block_max(level, bi, bj), expected);
                }
            }
        }
    }

    #[test]
    fn a_wrong_number_of_posts_is_no_tile() {
        assert!(HeightTile::new(vec![0.0; 10].into()).is_none());
    }

    #[test]
    fn levels_of_maxima_follow_one_another() {
        assert_eq!(MAXIMA_START[1..4], [0, 128 * 128, 128 * 128 + 64 * 64]);
        assert_eq!(MAXIMA_START[MAXIMA_LEVELS] + 1, (TILE_CELLS * TILE_CELLS - 1) / 3);
    }

    #[test]
    fn whole_metres_take_two_bytes_a_post_and_rough_floats_four() {
        let elements = TILE_POSTS * TILE_POSTS + 1 + (TILE_CELLS * TILE_CELLS - 1) / 3 + 1;
        let codes = tile(|i, j| (i * j % 5000) as f32);
        let own = size_of::<HeightTile>();
        assert_eq!(codes.memory_bytes(), 2 * elements + own);
        let floats = tile(|i, j| libm::sqrtf((i + j + 2) as f32));
        assert_eq!(floats.memory_bytes(), 4 * elements + own);
        assert_eq!(floats.memory_bytes(), HEIGHT_TILE_BYTES);
        let per_cell = codes.memory_bytes() as f64 / (TILE_CELLS * TILE_CELLS) as f64;
        assert!(per_cell * 4.0 / 3.0 < 3.7, "with all coarser levels: {per_cell}");
    }

    /// What kernels rely on: lengths, pads, and that codes say what `post` says.
    #[track_caller]
    fn check_arrays(tile: &HeightTile) {
        let (posts, maxima) = match tile.heights() {
            Heights::Codes(codes) => {
                assert!(codes.base.checked_add(i32::from(VOID)).is_some());
                assert!(codes.posts.iter().all(|&code| code > 0), "0 is no post");
                assert!(codes.maxima.iter().all(|&code| code < VOID), "no maximum is void");
                assert_eq!(codes.posts.last(), Some(&VOID));
                (codes.posts.len(), codes.maxima.len())
            }
            Heights::Floats(floats) => {
                assert!(floats.maxima.iter().all(|max| !max.is_nan()));
                assert!(floats.posts.last().unwrap().is_nan());
                (floats.posts.len(), floats.maxima.len())
            }
        };
        assert_eq!(posts, TILE_POSTS * TILE_POSTS + 1);
        assert_eq!(maxima, MAXIMA_START[MAXIMA_LEVELS] + 2);
    }

    /// The bits of a post; all voids are the same.
    fn bits(post: f32) -> u32 {
        if post.is_nan() { f32::NAN.to_bits() } else { post.to_bits() }
    }

    /// Rules that make a height of a random number.
    fn rules() -> impl Strategy<Value = (&'static str, fn(u32) -> f32)> {
        prop::sample::select(vec![
            ("whole", (|n| (n % 9000) as f32 - 400.0) as fn(u32) -> f32),
            ("tenths", |n| (f64::from(n % 60_000) * 0.1 - 500.0) as f32),
            ("hundredths", |n| (f64::from(n % 60_000) * 0.01) as f32),
            ("feet", |n| (f64::from(n % 30_000) * 0.3048) as f32),
            ("sixty-fourths", |n| (n % 65_000) as f32 / 64.0 - 800.0),
            ("a fine step over more than its codes", |n| (n % 70_000) as f32 / 1024.0),
            ("any number", f32::from_bits),
            ("near a million", |n| 1e6 + (n % 1000) as f32 * 0.0625),
            ("all equal", |_| 1234.567),
            ("zeros of both signs", |n| if n % 1000 == 0 { -0.0 } else { 0.0 }),
            ("all void", |_| f32::NAN),
        ])
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]

        #[test]
        fn every_post_comes_back_bit_for_bit((name, rule) in rules(), seed: u32, holes in 0u32..4) {
            let noise = |i: isize, j: isize| {
                let mixed = (i as u32).wrapping_mul(0x9e37_79b9) ^ (j as u32).wrapping_mul(0x85eb_ca6b);
                (mixed ^ seed).wrapping_mul(0xc2b2_ae35) ^ mixed >> 15
            };
            let height = |i: isize, j: isize| {
                let n = noise(i, j);
                if n >> 8 & 15 < holes { f32::NAN } else { rule(n) }
            };
            let tile = tile(height);
            check_arrays(&tile);
            let posts = tile.to_posts();
            prop_assert_eq!(posts.len(), TILE_POSTS * TILE_POSTS);
            for (at, &post) in posts.iter().enumerate() {
                let (i, j) = ((at % TILE_POSTS) as isize - 1, (at / TILE_POSTS) as isize - 1);
                prop_assert_eq!(bits(post), bits(height(i, j)), "{}", name);
                prop_assert_eq!(bits(post), bits(tile.post(i, j)));
            }
            for (i, j) in [(0, 0), (255, 255), (17, 200)] {
                let corners = [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)];
                let expected = corners.map(|(i, j)| bits(height(i, j)));
                prop_assert_eq!(tile.corners(i as usize, j as usize).map(bits), expected);
            }
        }
    }

    #[test]
    fn common_heights_have_codes() {
        let has_codes = |rule: fn(isize) -> f32| {
            matches!(tile(|i, j| rule(i * 7 + j)).heights(), Heights::Codes(_))
        };
        assert!(has_codes(|n| n as f32));
        assert!(has_codes(|n| (n as f64 * 0.1) as f32));
        assert!(has_codes(|n| (n as f64 * 0.3048) as f32));
        assert!(has_codes(|n| n as f32 / 64.0));
        assert!(has_codes(|_| f32::NAN));
        assert!(!has_codes(|n| n as f32 * 0.123_456_7));
    }
}
