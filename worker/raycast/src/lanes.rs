//! Several rays at once: vectors of f32, f64 and i32, one kernel for every width.
//!
//! A kernel is written once, over [`Lanes`]. [`One`] is its scalar twin; `Eight` needs
//! AVX2 and `Sixteen` AVX-512. All do the same IEEE operations on each lane, none fuses a
//! multiplication with an addition, and no lane looks at another, so a lane's result does
//! not depend on the width. Which width runs is chosen once per render call, by
//! [`widest`].
//!
//! Kernels are `#[inline(always)]` down to a single function per width that carries the
//! target feature: whatever is not inlined into it would be compiled without.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod one;

pub(crate) use one::One;

use std::cell::Cell;
use std::ops::{Add, BitAnd, BitOr, Mul, Neg, Not, Sub};
use std::sync::OnceLock;

/// The most lanes of any width.
pub(crate) const MOST: usize = 16;

/// A width: the types of its vectors.
pub(crate) trait Lanes: Copy + 'static {
    /// Lanes of a vector.
    const N: usize;
    type F: Floats<I = Self::I, M = Self::M>;
    type I: Ints<F = Self::F, M = Self::M>;
    type M: Mask;
    type D: Doubles<F = Self::F, I = Self::I, M = Self::M>;
}

/// One f32 a lane.
pub(crate) trait Floats:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Neg<Output = Self>
{
    type I;
    type M;
    fn splat(value: f32) -> Self;
    /// The first N values of a slice; panics if there are fewer.
    fn load(values: &[f32]) -> Self;
    /// Into the first N places of a slice; panics if there are fewer.
    fn store(self, values: &mut [f32]);
    fn div(self, by: Self) -> Self;
    fn sqrt(self) -> Self;
    /// The lesser; `other` if either is NaN.
    fn min(self, other: Self) -> Self;
    /// The greater; `other` if either is NaN.
    fn max(self, other: Self) -> Self;
    fn abs(self) -> Self;
    fn lt(self, other: Self) -> Self::M;
    fn le(self, other: Self) -> Self::M;
    fn eq(self, other: Self) -> Self::M;
    fn select(mask: Self::M, yes: Self, no: Self) -> Self;
    /// Towards zero; beyond the range of i32 and for NaN, `i32::MIN`.
    fn truncate(self) -> Self::I;
    /// The greatest integer that is not above, for values within the range of i32.
    fn floor(self) -> Self::I;
    /// The same bits.
    fn from_bits(bits: Self::I) -> Self;
    fn to_bits(self) -> Self::I;
    /// For each lane the element `at` of a table: from 0 to below twice the lanes. Panics
    /// if the table has fewer.
    fn lookup(table: &[f32], at: Self::I) -> Self;
    /// For each lane the element `at` of a table, of its low four bits.
    fn pick(table: &[f32; 16], at: Self::I) -> Self;
    /// Each lane in `mask` into its element of a table. An index outside the table writes
    /// to its end.
    fn scatter(self, table: &mut [f32], at: Self::I, mask: Self::M);
    /// The lanes in `mask`, in their order, and behind them any values.
    fn pack(self, mask: Self::M) -> Self;
}

/// One f64 a lane.
pub(crate) trait Doubles:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>
{
    type F;
    type I;
    type M;
    fn splat(value: f64) -> Self;
    /// The first N values of a slice; panics if there are fewer.
    fn load(values: &[f64]) -> Self;
    /// Into the first N places of a slice; panics if there are fewer.
    fn store(self, values: &mut [f64]);
    /// The lanes in `mask` take the first values of a slice, in their order; the others
    /// stay. Panics if the slice has fewer than N.
    fn refill(self, values: &[f64], mask: Self::M) -> Self;
    fn div(self, by: Self) -> Self;
    fn sqrt(self) -> Self;
    /// `self` if it is less, else `other`.
    fn min(self, other: Self) -> Self;
    /// `self` if it is greater, else `other`.
    fn max(self, other: Self) -> Self;
    fn abs(self) -> Self;
    fn lt(self, other: Self) -> Self::M;
    fn le(self, other: Self) -> Self::M;
    fn select(mask: Self::M, yes: Self, no: Self) -> Self;
    /// Towards zero; beyond the range of i32 and for NaN, `i32::MIN`.
    fn truncate(self) -> Self::I;
    /// The same value.
    fn from_ints(ints: Self::I) -> Self;
    /// The same value.
    fn from_floats(floats: Self::F) -> Self;
    /// The nearest f32, as f64.
    fn to_single(self) -> Self;
    /// The nearest f32.
    fn to_floats(self) -> Self::F;
}

/// One i32 a lane; arithmetic wraps.
pub(crate) trait Ints:
    Copy + Add<Output = Self> + Sub<Output = Self> + BitAnd<Output = Self>
{
    type F;
    type M;
    fn splat(value: i32) -> Self;
    fn load(values: &[i32]) -> Self;
    fn store(self, values: &mut [i32]);
    /// As [`Floats::pack`].
    fn pack(self, mask: Self::M) -> Self;
    /// The three low bytes of each lane, one lane's behind the other's, into the first 3 N
    /// places of a slice; panics if there are fewer.
    fn store_threes(self, bytes: &mut [u8]);
    /// The nearest f32.
    fn to_floats(self) -> Self::F;
    /// Each lane shifted by the other's lane, 0 to 31, with its sign.
    fn shr(self, by: Self) -> Self;
    fn shl(self, by: Self) -> Self;
    /// The low half of each product.
    fn times(self, by: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn eq(self, other: Self) -> Self::M;
    fn lt(self, other: Self) -> Self::M;
    fn select(mask: Self::M, yes: Self, no: Self) -> Self;
    /// For each lane in `mask` the 32 bits `at` bytes behind its base, or `last` bytes
    /// behind if `at`, unsigned, is more than that; lanes outside get 0.
    ///
    /// # Safety
    /// For each lane in `mask`, `last + 4` bytes from its base can be read.
    unsafe fn gather_from(bases: &[*const u8; MOST], at: Self, last: Self, mask: Self::M) -> Self;
    /// For each lane in `mask` the elements `at` (low half) and `at + 1` (high half) of a
    /// table of at least two; lanes outside get 0. An index outside the table reads from
    /// its end.
    fn gather_pairs(table: &[u16], at: Self, mask: Self::M) -> Self;
    /// The same for single elements of 32 bits.
    fn gather(table: &[u32], at: Self, mask: Self::M) -> Self;
    /// For each lane in `mask` the elements `at` and `at + 1` of a table of at least two;
    /// lanes outside get 0. An index outside the table reads from its end.
    fn gather_twos(table: &[u32], at: Self, mask: Self::M) -> (Self, Self);
    /// For each lane in `mask` the elements around a cell of a table of rows `stride` long, as
    /// pairs: two of the first of four rows, above these and beside them four of the second
    /// (west, east) and of the third, and two of the last. `at` is the column of the four's
    /// first, and from bit 16 on the first row. Lanes outside get anything, and so does a
    /// lane whose elements are not all in the table. Panics if the table has less than eight
    /// rows and an element, or these less than eight elements or 2^15 and more.
    fn gather_around(table: &[u16], at: Self, stride: usize, mask: Self::M) -> [Self; 6];

    /// Whether lanes pick from vectors: [`Ints::pick_pairs`] then is far quicker than a gather.
    const PICKS: bool = false;

    /// For each lane the elements `at` (low half) and `at + 1` (high half) of a square of eight
    /// by eight; any, if these are not in it.
    #[inline(always)]
    fn pick_pairs(square: &[u16; 64], at: Self) -> Self {
        let mut places = [0; MOST];
        at.store(&mut places);
        for place in &mut places {
            let (low, high) = (*place as usize % 64, (*place as usize).wrapping_add(1) % 64);
            *place = i32::from(square[low]) | i32::from(square[high]) << 16;
        }
        Self::load(&places)
    }

    /// The corner of the square, eight rows of eight elements of a table, that has the places
    /// from `low` to `high` of all lanes in `mask`, at most `limit`; and whether there is one:
    /// never at widths whose lanes do not pick from vectors. Places are columns, and from bit 16
    /// on rows, both unsigned.
    #[inline(always)]
    fn corner(_low: Self, _high: Self, _limit: i32, _mask: Self::M) -> (i32, bool) {
        (0, false)
    }
    /// As [`Ints::gather_around`] with places relative to those of the square's corner; all
    /// lanes' elements are in it. Panics if the square is not in the table.
    #[inline(always)]
    fn around_in(_table: &[u16], _first: usize, _stride: usize, _at: Self) -> [Self; 6] {
        unreachable!("there is no corner")
    }
}

/// The last place of a table of a length from which so many elements can be read. Panics if
/// it has less: no lane may read beside it.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn last_place(length: usize, elements: usize) -> i32 {
    assert!(length >= elements, "a table of {length} is read by {elements}");
    (length.min(i32::MAX as usize) - elements) as i32
}

/// Panics if a table is not what [`Ints::gather_around`] asks for: eight rows of eight, so that
/// a square of [`Ints::around_in`] can be in it, too.
#[inline(always)]
fn check_rows(table: &[u16], stride: usize) {
    assert!((8..1 << 15).contains(&stride) && table.len() > 8 * stride, "eight rows of eight");
}

/// A yes or no a lane.
pub(crate) trait Mask:
    Copy + BitAnd<Output = Self> + BitOr<Output = Self> + Not<Output = Self>
{
    fn none() -> Self;
    fn select(mask: Self, yes: Self, no: Self) -> Self;
    /// Bit n is lane n.
    fn bits(self) -> u32;
    fn from_bits(bits: u32) -> Self;
    #[inline(always)]
    fn any(self) -> bool {
        self.bits() != 0
    }
    #[inline(always)]
    fn count(self) -> u32 {
        self.bits().count_ones()
    }
}

/// The widths that a processor may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Width {
    /// Plain code, everywhere.
    One,
    /// AVX2.
    Eight,
    /// AVX-512 (F, BW, DQ, VL).
    Sixteen,
}

impl Width {
    /// Every width that this processor has, narrowest first.
    pub fn available() -> Vec<Width> {
        let widths = [Width::One, Width::Eight, Width::Sixteen];
        widths.into_iter().filter(|width| width.is_available()).collect()
    }

    #[cfg(target_arch = "x86_64")]
    fn is_available(self) -> bool {
        use std::arch::is_x86_feature_detected as has;
        // What the kernels are compiled for besides; see `avx2::run` and `avx512::run`.
        let common = || has!("popcnt") && has!("bmi1") && has!("bmi2") && has!("lzcnt");
        let eight = || has!("avx2") && common();
        match self {
            Width::One => true,
            Width::Eight => eight(),
            Width::Sixteen => {
                let wide = has!("avx512f") && has!("avx512bw");
                eight() && wide && has!("avx512dq") && has!("avx512vl")
            }
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn is_available(self) -> bool {
        self == Width::One
    }

    /// Runs something as on a processor that has no wider lanes. Only this thread is
    /// concerned, and only until the end.
    pub fn at_most<R>(self, run: impl FnOnce() -> R) -> R {
        struct Restore(Option<Width>);
        impl Drop for Restore {
            fn drop(&mut self) {
                LIMIT.set(self.0);
            }
        }
        let limit = LIMIT.get().map_or(self, |limit| limit.min(self));
        let _restore = Restore(LIMIT.replace(Some(limit)));
        run()
    }

    /// The name that reports use.
    pub fn name(self) -> &'static str {
        match self {
            Width::One => "scalar",
            Width::Eight => "avx2",
            Width::Sixteen => "avx512",
        }
    }
}

thread_local! {
    /// What [`Width::at_most`] allows.
    static LIMIT: Cell<Option<Width>> = const { Cell::new(None) };
}

/// The widest that this processor has and [`Width::at_most`] allows.
pub(crate) fn widest() -> Width {
    let allowed = |width: &&Width| LIMIT.get().is_none_or(|limit| **width <= limit);
    known().iter().rev().find(allowed).copied().unwrap_or(Width::One)
}

/// [`Width::available`], asked once.
fn known() -> &'static [Width] {
    static KNOWN: OnceLock<Vec<Width>> = OnceLock::new();
    KNOWN.get_or_init(Width::available)
}

/// Work that is written for any width.
pub(crate) trait Kernel {
    type Output;
    /// Must be `#[inline(always)]`, as all that it calls in its loops.
    fn run<L: Lanes>(self) -> Self::Output;
}

/// Runs a kernel at a width.
///
/// # Panics
/// If the processor does not have it.
pub(crate) fn run<K: Kernel>(kernel: K, width: Width) -> K::Output {
    assert!(known().contains(&width), "this processor has no {width:?}");
    match width {
        Width::One => kernel.run::<One>(),
        #[cfg(target_arch = "x86_64")]
        // SAFETY: it was seen that the processor has the width.
        Width::Eight => unsafe { avx2::run(kernel) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        Width::Sixteen => unsafe { avx512::run(kernel) },
        #[cfg(not(target_arch = "x86_64"))]
        _ => kernel.run::<One>(),
    }
}

/// Aligns the stack of the function that holds one: without it, vectors that the compiler
/// puts there for want of registers may lie across cache lines.
#[cfg(target_arch = "x86_64")]
#[repr(align(64))]
struct Anchor(u8);

#[cfg(target_arch = "x86_64")]
impl Anchor {
    #[inline(always)]
    fn hold() {
        std::hint::black_box(&mut Anchor(0).0);
    }
}

/// Asks for the memory `at` bytes behind the base of each lane, so that it is there when it is
/// read, if any lane is in `mask`: of all, for it takes longer to tell which. Any address will
/// do.
#[inline(always)]
pub(crate) fn prefetch<L: Lanes>(bases: &[*const u8; MOST], at: L::I, mask: L::M) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let mut places = [0; MOST];
        at.store(&mut places);
        if mask.any() {
            for lane in 0..L::N {
                let place = bases[lane].wrapping_offset(places[lane] as isize);
                // SAFETY: SSE is part of the architecture, and a hint reads nothing.
                unsafe { _mm_prefetch::<_MM_HINT_T0>(place.cast()) };
            }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (bases, at, mask);
}

/// Asks for elements of a table, so that they are there when they are read: those that every
/// fourth place names, and those `stride` behind them. Any place will do.
#[inline(always)]
pub(crate) fn prefetch_rows(table: &[u32], places: &[i32], stride: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let mut n = 0;
        while n < places.len() {
            let place = table.as_ptr().wrapping_offset(places[n] as isize);
            // SAFETY: SSE is part of the architecture, and a hint reads nothing.
            unsafe {
                _mm_prefetch::<_MM_HINT_T0>(place.cast());
                _mm_prefetch::<_MM_HINT_T0>(place.wrapping_add(stride).cast());
            }
            n += 4;
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (table, places, stride);
}

/// Floats as the bits that they are.
pub(crate) fn as_bits(values: &[f32]) -> &[u32] {
    // SAFETY: u32 has the size and alignment of f32, and every bit pattern is a u32.
    unsafe { std::slice::from_raw_parts(values.as_ptr().cast(), values.len()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Packs;

    impl Kernel for Packs {
        type Output = ();

        #[inline(always)]
        fn run<L: Lanes>(self) {
            let numbers: [i32; MOST] = std::array::from_fn(|n| n as i32 - 3);
            let lanes = L::I::load(&numbers);
            for bits in 0..1u32 << L::N {
                let wanted: Vec<i32> =
                    (0..L::N).filter(|n| bits >> n & 1 == 1).map(|n| numbers[n]).collect();
                let (mut ints, mut floats) = ([0; MOST], [0.0; MOST]);
                lanes.pack(L::M::from_bits(bits)).store(&mut ints);
                lanes.to_floats().pack(L::M::from_bits(bits)).store(&mut floats);
                assert_eq!(ints[..wanted.len()], wanted);
                assert_eq!(floats.map(|float| float as i32)[..wanted.len()], wanted);
            }
        }
    }

    /// Reads places close together, out of a square and one by one.
    struct Picks<'t> {
        posts: &'t [u16],
        stride: usize,
        places: [[i32; 2]; MOST],
        bits: u32,
    }

    impl Kernel for Picks<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Lanes>(self) {
            let Picks { posts, stride, places, bits } = self;
            let bits = bits & ((1 << L::N) - 1) | 1;
            let lanes = (0..L::N).filter(|lane| bits >> lane & 1 == 1);
            let mask = L::M::from_bits(bits);
            let rows = (posts.len() / stride) as i32;
            // What lanes outside the mask hold may be anything.
            let stale = [i32::MIN, -1, i32::MAX, 0][self.bits as usize % 4];
            let at = L::I::load(&places.map(|[x, y]| y << 16 | x));
            let at = L::I::select(mask, at, L::I::splat(stale));
            let check = |around: [L::I; 6]| {
                let mut found = [[0; MOST]; 6];
                (0..6).for_each(|n| around[n].store(&mut found[n]));
                for lane in lanes.clone() {
                    let first = places[lane][1] as usize * stride + places[lane][0] as usize;
                    let pairs = [(0, 1), (1, 0), (1, 2), (2, 0), (2, 2), (3, 1)];
                    let expected = pairs.map(|(row, column)| {
                        let at = first + row * stride + column;
                        (u32::from(posts[at]) | u32::from(posts[at + 1]) << 16) as i32
                    });
                    assert_eq!(found.map(|pair| pair[lane]), expected);
                }
            };
            check(L::I::gather_around(posts, at, stride, mask));
            let limit = (rows - 8) << 16 | (stride as i32 - 8);
            let (corner, is_there) = L::I::corner(at, at + L::I::splat(3 << 16 | 3), limit, mask);
            let least = [0, 1].map(|axis| {
                let last = [stride as i32, rows][axis] - 8;
                lanes.clone().map(|lane| places[lane][axis]).min().map_or(0, |at| at.min(last))
            });
            let fits = lanes.clone().all(|lane| (0..2).all(|n| places[lane][n] - least[n] <= 4));
            assert_eq!(is_there, fits && L::N == MOST);
            if is_there {
                assert_eq!(corner, least[1] << 16 | least[0]);
                let first = least[1] as usize * stride + least[0] as usize;
                check(L::I::around_in(posts, first, stride, at - L::I::splat(corner)));
            }
        }
    }

    #[test]
    fn what_is_picked_out_of_a_square_is_what_the_table_has() {
        let (stride, rows) = (19, 23);
        let code = |n: u32| (n.wrapping_mul(2_654_435_761) >> 16) as u16;
        let posts: Vec<u16> = (0..(stride * rows + 1) as u32).map(code).collect();
        let mut random = 1u32;
        let mut next = |most: i32| {
            random = random.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
            (random >> 16) as i32 % (most + 1)
        };
        for _ in 0..20_000 {
            let most = [stride as i32 - 4, rows as i32 - 4];
            let (from, reach) = ([next(most[0]), next(most[1])], next(7));
            let places = std::array::from_fn(|_| {
                [0, 1].map(|axis| (from[axis] + next(reach)).min(most[axis]))
            });
            let bits = next(0xFFFF) as u32;
            for width in Width::available() {
                run(Picks { posts: &posts, stride, places, bits }, width);
            }
        }
    }

    struct Squares([u16; 64], [i32; MOST]);

    impl Kernel for Squares {
        type Output = ();

        #[inline(always)]
        fn run<L: Lanes>(self) {
            let Squares(square, places) = self;
            let mut pairs = [0; MOST];
            L::I::pick_pairs(&square, L::I::load(&places)).store(&mut pairs);
            for lane in 0..L::N {
                let [low, high] = [0, 1].map(|n| u32::from(square[places[lane] as usize + n]));
                assert_eq!(pairs[lane] as u32, high << 16 | low);
            }
        }
    }

    #[test]
    fn pairs_picked_out_of_a_square_are_neighbours_in_it() {
        let square = std::array::from_fn(|n| (n as u16).wrapping_mul(40_503));
        for first in 0..=62 {
            let places = std::array::from_fn(|lane| (first + 13 * lane as i32) % 63);
            for width in Width::available() {
                run(Squares(square, places), width);
            }
        }
    }

    #[test]
    fn packed_lanes_are_those_of_the_mask_in_their_order() {
        for width in Width::available() {
            run(Packs, width);
        }
    }

    #[test]
    fn a_limit_of_the_width_holds_on_its_thread_until_its_end() {
        let whole = widest();
        Width::One.at_most(|| {
            assert_eq!(widest(), Width::One);
            assert_eq!(Width::Sixteen.at_most(widest), Width::One, "a limit within a limit");
            std::thread::spawn(move || assert_eq!(widest(), whole)).join().expect("it is free");
        });
        assert!(std::panic::catch_unwind(|| Width::One.at_most(|| panic!("on purpose"))).is_err());
        assert_eq!((widest(), Width::Sixteen.at_most(widest)), (whole, whole));
    }
}
