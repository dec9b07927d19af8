//! Sixteen lanes, with AVX-512.
//!
//! SAFETY of every block: as in `avx2`, with the features that [`run`] names.

mod doubles;
mod square;

use super::{Anchor, Floats, Ints, Kernel, Lanes, MOST, Mask, check_rows, last_place};
use std::arch::x86_64::*;
use std::ops::{Add, BitAnd, BitOr, Mul, Neg, Not, Sub};

#[derive(Clone, Copy)]
pub(crate) struct Sixteen;

#[derive(Clone, Copy)]
pub(crate) struct F(__m512);
#[derive(Clone, Copy)]
pub(crate) struct I(__m512i);
#[derive(Clone, Copy)]
pub(crate) struct M(__mmask16);

impl Lanes for Sixteen {
    const N: usize = 16;
    type F = F;
    type I = I;
    type M = M;
    type D = doubles::D;
}

/// # Safety
/// The processor must have AVX-512 F, BW, DQ and VL, and what `avx2::run` asks for.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,popcnt,bmi1,bmi2,lzcnt")]
pub(super) unsafe fn run<K: Kernel>(kernel: K) -> K::Output {
    Anchor::hold();
    kernel.run::<Sixteen>()
}

macro_rules! operator {
    ($type:ident, $trait:ident, $name:ident, $intrinsic:ident) => {
        impl $trait for $type {
            type Output = $type;
            #[inline(always)]
            fn $name(self, other: $type) -> $type {
                // SAFETY: see the page of this module.
                unsafe { $type($intrinsic(self.0, other.0)) }
            }
        }
    };
}

operator!(F, Add, add, _mm512_add_ps);
operator!(F, Sub, sub, _mm512_sub_ps);
operator!(F, Mul, mul, _mm512_mul_ps);
operator!(I, Add, add, _mm512_add_epi32);
operator!(I, Sub, sub, _mm512_sub_epi32);
operator!(I, BitAnd, bitand, _mm512_and_si512);

impl BitAnd for M {
    type Output = M;
    #[inline(always)]
    fn bitand(self, other: M) -> M {
        M(self.0 & other.0)
    }
}

impl BitOr for M {
    type Output = M;
    #[inline(always)]
    fn bitor(self, other: M) -> M {
        M(self.0 | other.0)
    }
}

impl Not for M {
    type Output = M;
    #[inline(always)]
    fn not(self) -> M {
        M(!self.0)
    }
}

impl Neg for F {
    type Output = F;
    #[inline(always)]
    fn neg(self) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_xor_ps(self.0, _mm512_set1_ps(-0.0))) }
    }
}

macro_rules! binary {
    ($name:ident, $result:ident, $intrinsic:ident $(, $constant:ident)?) => {
        #[inline(always)]
        fn $name(self, other: Self) -> $result {
            // SAFETY: see the page of this module.
            unsafe { $result($intrinsic $(::<$constant>)? (self.0, other.0)) }
        }
    };
}

impl Floats for F {
    type I = I;
    type M = M;
    #[inline(always)]
    fn splat(value: f32) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_set1_ps(value)) }
    }
    #[inline(always)]
    fn load(values: &[f32]) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_loadu_ps(values[..16].as_ptr())) }
    }
    #[inline(always)]
    fn store(self, values: &mut [f32]) {
        // SAFETY: see the page of this module.
        unsafe { _mm512_storeu_ps(values[..16].as_mut_ptr(), self.0) }
    }
    binary!(div, F, _mm512_div_ps);
    #[inline(always)]
    fn sqrt(self) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_sqrt_ps(self.0)) }
    }
    binary!(min, F, _mm512_min_ps);
    binary!(max, F, _mm512_max_ps);
    #[inline(always)]
    fn abs(self) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_abs_ps(self.0)) }
    }
    binary!(lt, M, _mm512_cmp_ps_mask, _CMP_LT_OQ);
    binary!(le, M, _mm512_cmp_ps_mask, _CMP_LE_OQ);
    binary!(eq, M, _mm512_cmp_ps_mask, _CMP_EQ_OQ);
    #[inline(always)]
    fn select(mask: M, yes: F, no: F) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_mask_blend_ps(mask.0, no.0, yes.0)) }
    }
    #[inline(always)]
    fn truncate(self) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm512_cvttps_epi32(self.0)) }
    }
    #[inline(always)]
    fn floor(self) -> I {
        const DOWN: i32 = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
        // SAFETY: see the page of this module.
        unsafe { I(_mm512_cvttps_epi32(_mm512_roundscale_ps::<DOWN>(self.0))) }
    }
    #[inline(always)]
    fn from_bits(bits: I) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_castsi512_ps(bits.0)) }
    }
    #[inline(always)]
    fn to_bits(self) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm512_castps_si512(self.0)) }
    }
    #[inline(always)]
    fn lookup(table: &[f32], at: I) -> F {
        let table = &table[..32];
        // SAFETY: see the page of this module.
        unsafe {
            let low = _mm512_loadu_ps(table.as_ptr());
            let high = _mm512_loadu_ps(table[16..].as_ptr());
            F(_mm512_permutex2var_ps(low, at.0, high))
        }
    }
    #[inline(always)]
    fn pick(table: &[f32; 16], at: I) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_permutexvar_ps(at.0, _mm512_loadu_ps(table.as_ptr()))) }
    }
    #[inline(always)]
    fn scatter(self, table: &mut [f32], at: I, mask: M) {
        let last = last_place(table.len(), 1);
        // SAFETY: see the page of this module.
        unsafe {
            let at = _mm512_min_epu32(at.0, _mm512_set1_epi32(last));
            _mm512_mask_i32scatter_ps::<4>(table.as_mut_ptr().cast(), mask.0, at, self.0);
        }
    }
    #[inline(always)]
    fn pack(self, mask: M) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_maskz_compress_ps(mask.0, self.0)) }
    }
}

impl Ints for I {
    type F = F;
    type M = M;
    #[inline(always)]
    fn splat(value: i32) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm512_set1_epi32(value)) }
    }
    #[inline(always)]
    fn load(values: &[i32]) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm512_loadu_si512(values[..16].as_ptr().cast())) }
    }
    #[inline(always)]
    fn store(self, values: &mut [i32]) {
        // SAFETY: see the page of this module.
        unsafe { _mm512_storeu_si512(values[..16].as_mut_ptr().cast(), self.0) }
    }
    #[inline(always)]
    fn pack(self, mask: M) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm512_maskz_compress_epi32(mask.0, self.0)) }
    }
    #[inline(always)]
    fn store_threes(self, bytes: &mut [u8]) {
        let bytes = &mut bytes[..48];
        // SAFETY: see the page of this module; thirty-two bytes and sixteen.
        unsafe {
            let order = _mm_setr_epi8(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -1, -1, -1, -1);
            let dense = _mm512_shuffle_epi8(self.0, _mm512_broadcast_i32x4(order));
            let places = _mm512_setr_epi32(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, 3, 7, 11, 15);
            let dense = _mm512_permutexvar_epi32(places, dense);
            _mm256_storeu_si256(bytes.as_mut_ptr().cast(), _mm512_castsi512_si256(dense));
            let rest = _mm512_extracti32x4_epi32::<2>(dense);
            _mm_storeu_si128(bytes[32..].as_mut_ptr().cast(), rest);
        }
    }
    #[inline(always)]
    fn to_floats(self) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm512_cvtepi32_ps(self.0)) }
    }
    binary!(shr, I, _mm512_srav_epi32);
    binary!(shl, I, _mm512_sllv_epi32);
    binary!(times, I, _mm512_mullo_epi32);
    binary!(min, I, _mm512_min_epi32);
    binary!(max, I, _mm512_max_epi32);
    binary!(eq, M, _mm512_cmpeq_epi32_mask);
    binary!(lt, M, _mm512_cmplt_epi32_mask);
    #[inline(always)]
    fn select(mask: M, yes: I, no: I) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm512_mask_blend_epi32(mask.0, no.0, yes.0)) }
    }
    #[inline(always)]
    unsafe fn gather_from(bases: &[*const u8; MOST], at: I, last: I, mask: M) -> I {
        // SAFETY: see the page of this module; the caller has seen that so much can be read.
        unsafe {
            let at = _mm512_min_epu32(at.0, last.0);
            let low = _mm512_cvtepu32_epi64(_mm512_castsi512_si256(at));
            let high = _mm512_cvtepu32_epi64(_mm512_extracti64x4_epi64::<1>(at));
            let low = _mm512_add_epi64(low, _mm512_loadu_si512(bases.as_ptr().cast()));
            let high = _mm512_add_epi64(high, _mm512_loadu_si512(bases[8..].as_ptr().cast()));
            let none = _mm256_setzero_si256();
            let of_high = (mask.0 >> 8) as u8;
            let nowhere = std::ptr::null();
            let low = _mm512_mask_i64gather_epi32::<1>(none, mask.0 as u8, low, nowhere);
            let high = _mm512_mask_i64gather_epi32::<1>(none, of_high, high, nowhere);
            I(_mm512_inserti64x4::<1>(_mm512_castsi256_si512(low), high))
        }
    }
    #[inline(always)]
    fn gather_pairs(table: &[u16], at: I, mask: M) -> I {
        let last = last_place(table.len(), 2);
        // SAFETY: see the page of this module; element `last + 1` is inside the table.
        unsafe {
            let at = _mm512_min_epu32(at.0, _mm512_set1_epi32(last));
            let none = _mm512_setzero_si512();
            I(_mm512_mask_i32gather_epi32::<2>(none, mask.0, at, table.as_ptr().cast()))
        }
    }
    #[inline(always)]
    fn gather(table: &[u32], at: I, mask: M) -> I {
        let last = last_place(table.len(), 1);
        // SAFETY: see the page of this module.
        unsafe {
            let at = _mm512_min_epu32(at.0, _mm512_set1_epi32(last));
            let none = _mm512_setzero_si512();
            I(_mm512_mask_i32gather_epi32::<4>(none, mask.0, at, table.as_ptr().cast()))
        }
    }
    #[inline(always)]
    fn gather_twos(table: &[u32], at: I, mask: M) -> (I, I) {
        let last = last_place(table.len(), 2);
        // SAFETY: see the page of this module; element `last + 1` is inside the table.
        unsafe { gather_eights::<4>(table.as_ptr().cast(), at, last, mask) }
    }
    #[inline(always)]
    fn gather_around(table: &[u16], at: I, stride: usize, mask: M) -> [I; 6] {
        check_rows(table, stride);
        let last = last_place(table.len(), 3 * stride + 5);
        // SAFETY: see the page of this module; element `last + 3 * stride + 4` is inside the
        // table.
        unsafe {
            let at = I(_mm512_madd_epi16(at.0, _mm512_set1_epi32((stride << 16 | 1) as i32)));
            let places = places(at, last);
            let first = table.as_ptr();
            let (south, _) = eights::<2>(first.add(1).cast(), &places, mask);
            let (a01, a23) = eights::<2>(first.add(stride).cast(), &places, mask);
            let (b01, b23) = eights::<2>(first.add(2 * stride).cast(), &places, mask);
            let (north, _) = eights::<2>(first.add(3 * stride + 1).cast(), &places, mask);
            [south, a01, a23, b01, b23, north]
        }
    }

    const PICKS: bool = true;
    #[inline(always)]
    fn pick_pairs(square: &[u16; 64], at: I) -> I {
        // SAFETY: see the page of this module.
        unsafe { square::pairs(square, at) }
    }
    #[inline(always)]
    fn corner(low: I, high: I, limit: i32, mask: M) -> (i32, bool) {
        // SAFETY: see the page of this module.
        unsafe { square::corner(low, high, limit, mask) }
    }
    #[inline(always)]
    fn around_in(table: &[u16], first: usize, stride: usize, at: I) -> [I; 6] {
        assert!(first + 7 * stride + 8 <= table.len(), "the square is in the table");
        // SAFETY: see the page of this module.
        unsafe { square::around(table.as_ptr().add(first), stride, at) }
    }
}

/// Eight bytes a lane from a table of elements of `SIZE` bytes; their low and high halves.
///
/// One by one: half as many loads of this length in one instruction take half as long
/// again (Zen 5).
///
/// # Safety
/// As every block here; and eight bytes from element `last` on must be readable.
#[inline(always)]
unsafe fn gather_eights<const SIZE: usize>(table: *const u8, at: I, last: i32, mask: M) -> (I, I) {
    // SAFETY: by this function's own condition; every index is 0 to `last`.
    unsafe { eights::<SIZE>(table, &places(at, last), mask) }
}

/// Indices in memory, in one line of the cache.
#[repr(align(64))]
struct Indices([u32; 16]);

/// Indices, brought inside a table.
///
/// # Safety
/// As every block here.
#[inline(always)]
unsafe fn places(at: I, last: i32) -> Indices {
    let mut places = Indices([0; 16]);
    // SAFETY: by this function's own condition; they are aligned as a vector is.
    unsafe {
        let at = _mm512_min_epu32(at.0, _mm512_set1_epi32(last));
        // Otherwise the compiler would take the vector apart and store each by itself.
        std::ptr::from_mut(&mut places).cast::<__m512i>().write_volatile(at);
    }
    places
}

/// Eight bytes a lane from places of a table; their low and high halves.
///
/// # Safety
/// As every block here; and eight bytes from each place on must be readable.
#[inline(always)]
unsafe fn eights<const SIZE: usize>(table: *const u8, places: &Indices, mask: M) -> (I, I) {
    // SAFETY: by this function's own condition.
    unsafe {
        let first = _mm512_inserti64x4::<1>(
            _mm512_castsi256_si512(four_eights::<SIZE>(table, places, 0)),
            four_eights::<SIZE>(table, places, 4),
        );
        let second = _mm512_inserti64x4::<1>(
            _mm512_castsi256_si512(four_eights::<SIZE>(table, places, 8)),
            four_eights::<SIZE>(table, places, 12),
        );
        let low = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
        let high = _mm512_add_epi32(low, _mm512_set1_epi32(1));
        (
            I(_mm512_maskz_permutex2var_epi32(mask.0, first, low, second)),
            I(_mm512_maskz_permutex2var_epi32(mask.0, first, high, second)),
        )
    }
}

/// A place, read from memory: taking it out of a vector costs more.
#[inline(always)]
fn place(places: &Indices, n: usize) -> usize {
    // SAFETY: a reference may be read from.
    unsafe { std::ptr::from_ref(&places.0[n]).read_volatile() as usize }
}

/// Eight bytes each from four places of a table, from the `n`th on.
///
/// # Safety
/// As above: eight bytes at each place must be readable.
#[inline(always)]
unsafe fn four_eights<const SIZE: usize>(table: *const u8, places: &Indices, n: usize) -> __m256i {
    // SAFETY: by this function's own condition.
    unsafe {
        let a = table.add(place(places, n) * SIZE).cast::<i64>().read_unaligned();
        let b = table.add(place(places, n + 1) * SIZE).cast::<i64>().read_unaligned();
        let c = table.add(place(places, n + 2) * SIZE).cast::<i64>().read_unaligned();
        let d = table.add(place(places, n + 3) * SIZE).cast::<i64>().read_unaligned();
        let low = _mm_unpacklo_epi64(_mm_cvtsi64_si128(a), _mm_cvtsi64_si128(b));
        let high = _mm_unpacklo_epi64(_mm_cvtsi64_si128(c), _mm_cvtsi64_si128(d));
        _mm256_inserti128_si256::<1>(_mm256_castsi128_si256(low), high)
    }
}

impl Mask for M {
    #[inline(always)]
    fn none() -> M {
        M(0)
    }
    #[inline(always)]
    fn select(mask: M, yes: M, no: M) -> M {
        M((mask.0 & yes.0) | (!mask.0 & no.0))
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        u32::from(self.0)
    }
    #[inline(always)]
    fn from_bits(bits: u32) -> M {
        M(bits as u16)
    }
}
