//! Eight lanes, with AVX2.
//!
//! SAFETY of every block: the intrinsics need AVX2, and vectors of this width are made
//! only below [`run`], whose caller has seen that the processor has it. Loads and stores
//! take slices that were checked to be long enough, gathers indices that were brought
//! inside their table.

mod doubles;

use super::{Anchor, Floats, Ints, Kernel, Lanes, MOST, Mask, check_rows, last_place};
use std::arch::x86_64::*;
use std::ops::{Add, BitAnd, BitOr, Mul, Neg, Not, Sub};

#[derive(Clone, Copy)]
pub(crate) struct Eight;

#[derive(Clone, Copy)]
pub(crate) struct F(__m256);
#[derive(Clone, Copy)]
pub(crate) struct I(__m256i);
/// All bits of a lane, or none.
#[derive(Clone, Copy)]
pub(crate) struct M(__m256);

impl Lanes for Eight {
    const N: usize = 8;
    type F = F;
    type I = I;
    type M = M;
    type D = doubles::D;
}

/// # Safety
/// The processor must have AVX2, POPCNT, BMI1, BMI2 and LZCNT.
#[target_feature(enable = "avx2,popcnt,bmi1,bmi2,lzcnt")]
pub(super) unsafe fn run<K: Kernel>(kernel: K) -> K::Output {
    Anchor::hold();
    kernel.run::<Eight>()
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

operator!(F, Add, add, _mm256_add_ps);
operator!(F, Sub, sub, _mm256_sub_ps);
operator!(F, Mul, mul, _mm256_mul_ps);
operator!(I, Add, add, _mm256_add_epi32);
operator!(I, Sub, sub, _mm256_sub_epi32);
operator!(I, BitAnd, bitand, _mm256_and_si256);
operator!(M, BitAnd, bitand, _mm256_and_ps);
operator!(M, BitOr, bitor, _mm256_or_ps);

impl Neg for F {
    type Output = F;
    #[inline(always)]
    fn neg(self) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm256_xor_ps(self.0, _mm256_set1_ps(-0.0))) }
    }
}

impl Not for M {
    type Output = M;
    #[inline(always)]
    fn not(self) -> M {
        // SAFETY: see the page of this module.
        unsafe { M(_mm256_xor_ps(self.0, _mm256_castsi256_ps(_mm256_set1_epi32(-1)))) }
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

/// The numbers of the lanes in a mask, in their order, and then any.
#[inline(always)]
fn packed(mask: M) -> __m256i {
    // SAFETY: see the page of this module.
    unsafe {
        let bytes = _pdep_u64(u64::from(mask.bits()), 0x0101_0101_0101_0101) * 0xFF;
        let numbers = _pext_u64(0x0706_0504_0302_0100, bytes);
        _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(numbers as i64))
    }
}

impl Floats for F {
    type I = I;
    type M = M;
    #[inline(always)]
    fn splat(value: f32) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm256_set1_ps(value)) }
    }
    #[inline(always)]
    fn load(values: &[f32]) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm256_loadu_ps(values[..8].as_ptr())) }
    }
    #[inline(always)]
    fn store(self, values: &mut [f32]) {
        // SAFETY: see the page of this module.
        unsafe { _mm256_storeu_ps(values[..8].as_mut_ptr(), self.0) }
    }
    binary!(div, F, _mm256_div_ps);
    #[inline(always)]
    fn sqrt(self) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm256_sqrt_ps(self.0)) }
    }
    binary!(min, F, _mm256_min_ps);
    binary!(max, F, _mm256_max_ps);
    #[inline(always)]
    fn abs(self) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0)) }
    }
    binary!(lt, M, _mm256_cmp_ps, _CMP_LT_OQ);
    binary!(le, M, _mm256_cmp_ps, _CMP_LE_OQ);
    binary!(eq, M, _mm256_cmp_ps, _CMP_EQ_OQ);
    #[inline(always)]
    fn select(mask: M, yes: F, no: F) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm256_blendv_ps(no.0, yes.0, mask.0)) }
    }
    #[inline(always)]
    fn truncate(self) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm256_cvttps_epi32(self.0)) }
    }
    #[inline(always)]
    fn floor(self) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm256_cvttps_epi32(_mm256_floor_ps(self.0))) }
    }
    #[inline(always)]
    fn from_bits(bits: I) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm256_castsi256_ps(bits.0)) }
    }
    #[inline(always)]
    fn to_bits(self) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm256_castps_si256(self.0)) }
    }
    #[inline(always)]
    fn lookup(table: &[f32], at: I) -> F {
        let table = &table[..16];
        // SAFETY: see the page of this module.
        unsafe {
            let low = _mm256_permutevar8x32_ps(_mm256_loadu_ps(table.as_ptr()), at.0);
            let high = _mm256_permutevar8x32_ps(_mm256_loadu_ps(table[8..].as_ptr()), at.0);
            // The bit that tells 8 and above from below, where a blend looks for it.
            let upper = _mm256_castsi256_ps(_mm256_slli_epi32::<28>(at.0));
            F(_mm256_blendv_ps(low, high, upper))
        }
    }
    #[inline(always)]
    fn pick(table: &[f32; 16], at: I) -> F {
        F::lookup(table, at)
    }
    #[inline(always)]
    fn scatter(self, table: &mut [f32], at: I, mask: M) {
        let (mut values, mut places) = ([0.0; 8], [0; 8]);
        self.store(&mut values);
        at.store(&mut places);
        let (mut bits, last) = (mask.bits(), table.len() - 1);
        while bits != 0 {
            let lane = (bits.trailing_zeros() & 7) as usize;
            table[(places[lane] as u32 as usize).min(last)] = values[lane];
            bits &= bits - 1;
        }
    }
    #[inline(always)]
    fn pack(self, mask: M) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm256_permutevar8x32_ps(self.0, packed(mask))) }
    }
}

impl Ints for I {
    type F = F;
    type M = M;
    #[inline(always)]
    fn splat(value: i32) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm256_set1_epi32(value)) }
    }
    #[inline(always)]
    fn load(values: &[i32]) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm256_loadu_si256(values[..8].as_ptr().cast())) }
    }
    #[inline(always)]
    fn store(self, values: &mut [i32]) {
        // SAFETY: see the page of this module.
        unsafe { _mm256_storeu_si256(values[..8].as_mut_ptr().cast(), self.0) }
    }
    #[inline(always)]
    fn pack(self, mask: M) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm256_permutevar8x32_epi32(self.0, packed(mask))) }
    }
    #[inline(always)]
    fn store_threes(self, bytes: &mut [u8]) {
        let bytes = &mut bytes[..24];
        // SAFETY: see the page of this module; sixteen bytes and eight.
        unsafe {
            let order = _mm_setr_epi8(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -1, -1, -1, -1);
            let dense = _mm256_shuffle_epi8(self.0, _mm256_broadcastsi128_si256(order));
            let places = _mm256_setr_epi32(0, 1, 2, 4, 5, 6, 3, 7);
            let dense = _mm256_permutevar8x32_epi32(dense, places);
            _mm_storeu_si128(bytes.as_mut_ptr().cast(), _mm256_castsi256_si128(dense));
            let rest = _mm256_extracti128_si256::<1>(dense);
            _mm_storel_epi64(bytes[16..].as_mut_ptr().cast(), rest);
        }
    }
    #[inline(always)]
    fn to_floats(self) -> F {
        // SAFETY: see the page of this module.
        unsafe { F(_mm256_cvtepi32_ps(self.0)) }
    }
    binary!(shr, I, _mm256_srav_epi32);
    binary!(shl, I, _mm256_sllv_epi32);
    binary!(times, I, _mm256_mullo_epi32);
    binary!(min, I, _mm256_min_epi32);
    binary!(max, I, _mm256_max_epi32);
    #[inline(always)]
    fn eq(self, other: I) -> M {
        // SAFETY: see the page of this module.
        unsafe { M(_mm256_castsi256_ps(_mm256_cmpeq_epi32(self.0, other.0))) }
    }
    #[inline(always)]
    fn lt(self, other: I) -> M {
        // SAFETY: see the page of this module.
        unsafe { M(_mm256_castsi256_ps(_mm256_cmpgt_epi32(other.0, self.0))) }
    }
    #[inline(always)]
    fn select(mask: M, yes: I, no: I) -> I {
        // SAFETY: see the page of this module.
        unsafe { I(_mm256_blendv_epi8(no.0, yes.0, _mm256_castps_si256(mask.0))) }
    }
    #[inline(always)]
    unsafe fn gather_from(bases: &[*const u8; MOST], at: I, last: I, mask: M) -> I {
        // SAFETY: see the page of this module; the caller has seen that so much can be read.
        unsafe {
            let at = _mm256_min_epu32(at.0, last.0);
            let mask = _mm256_castps_si256(mask.0);
            let low = _mm256_cvtepu32_epi64(_mm256_castsi256_si128(at));
            let high = _mm256_cvtepu32_epi64(_mm256_extracti128_si256::<1>(at));
            let low = _mm256_add_epi64(low, _mm256_loadu_si256(bases.as_ptr().cast()));
            let high = _mm256_add_epi64(high, _mm256_loadu_si256(bases[4..].as_ptr().cast()));
            let none = _mm_setzero_si128();
            let of_low = _mm256_castsi256_si128(mask);
            let of_high = _mm256_extracti128_si256::<1>(mask);
            let nowhere = std::ptr::null();
            let low = _mm256_mask_i64gather_epi32::<1>(none, nowhere, low, of_low);
            let high = _mm256_mask_i64gather_epi32::<1>(none, nowhere, high, of_high);
            I(_mm256_set_m128i(high, low))
        }
    }
    #[inline(always)]
    fn gather_pairs(table: &[u16], at: I, mask: M) -> I {
        let last = last_place(table.len(), 2);
        // SAFETY: see the page of this module; element `last + 1` is inside the table.
        unsafe {
            let at = _mm256_min_epu32(at.0, _mm256_set1_epi32(last));
            let none = _mm256_setzero_si256();
            let mask = _mm256_castps_si256(mask.0);
            I(_mm256_mask_i32gather_epi32::<2>(none, table.as_ptr().cast(), at, mask))
        }
    }
    #[inline(always)]
    fn gather(table: &[u32], at: I, mask: M) -> I {
        let last = last_place(table.len(), 1);
        // SAFETY: see the page of this module.
        unsafe {
            let at = _mm256_min_epu32(at.0, _mm256_set1_epi32(last));
            let none = _mm256_setzero_si256();
            let mask = _mm256_castps_si256(mask.0);
            I(_mm256_mask_i32gather_epi32::<4>(none, table.as_ptr().cast(), at, mask))
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
        let factors = (stride << 16 | 1) as i32;
        // SAFETY: see the page of this module; element `last + 3 * stride + 4` is inside the
        // table.
        unsafe {
            let at = I(_mm256_madd_epi16(at.0, _mm256_set1_epi32(factors)));
            let first = table.as_ptr();
            let (south, _) = gather_eights::<2>(first.add(1).cast(), at, last, mask);
            let (a01, a23) = gather_eights::<2>(first.add(stride).cast(), at, last, mask);
            let (b01, b23) = gather_eights::<2>(first.add(2 * stride).cast(), at, last, mask);
            let (north, _) = gather_eights::<2>(first.add(3 * stride + 1).cast(), at, last, mask);
            [south, a01, a23, b01, b23, north]
        }
    }
}

/// Eight bytes a lane from a table of elements of `SIZE` bytes; their low and high halves.
///
/// # Safety
/// As every block here; and eight bytes from element `last` on must be readable.
#[inline(always)]
unsafe fn gather_eights<const SIZE: i32>(table: *const i64, at: I, last: i32, mask: M) -> (I, I) {
    // SAFETY: by this function's own condition.
    unsafe {
        let at = _mm256_min_epu32(at.0, _mm256_set1_epi32(last));
        let mask = _mm256_castps_si256(mask.0);
        let none = _mm256_setzero_si256();
        let few = _mm256_cvtepi32_epi64(_mm256_castsi256_si128(mask));
        let rest = _mm256_cvtepi32_epi64(_mm256_extracti128_si256::<1>(mask));
        let (start, end) = (_mm256_castsi256_si128(at), _mm256_extracti128_si256::<1>(at));
        let first = _mm256_mask_i32gather_epi64::<SIZE>(none, table, start, few);
        let second = _mm256_mask_i32gather_epi64::<SIZE>(none, table, end, rest);
        let (first, second) = (_mm256_castsi256_ps(first), _mm256_castsi256_ps(second));
        // Halves of four bytes next to each other, then in the order of the lanes.
        let low = _mm256_castps_si256(_mm256_shuffle_ps::<0b10_00_10_00>(first, second));
        let high = _mm256_castps_si256(_mm256_shuffle_ps::<0b11_01_11_01>(first, second));
        (
            I(_mm256_permute4x64_epi64::<0b11_01_10_00>(low)),
            I(_mm256_permute4x64_epi64::<0b11_01_10_00>(high)),
        )
    }
}

impl Mask for M {
    #[inline(always)]
    fn none() -> M {
        // SAFETY: see the page of this module.
        unsafe { M(_mm256_setzero_ps()) }
    }
    #[inline(always)]
    fn select(mask: M, yes: M, no: M) -> M {
        // SAFETY: see the page of this module.
        unsafe { M(_mm256_blendv_ps(no.0, yes.0, mask.0)) }
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        // SAFETY: see the page of this module.
        unsafe { _mm256_movemask_ps(self.0) as u32 }
    }
    #[inline(always)]
    fn from_bits(bits: u32) -> M {
        // SAFETY: see the page of this module.
        unsafe {
            let places = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            let bits = _mm256_and_si256(_mm256_set1_epi32(bits as i32), places);
            M(_mm256_castsi256_ps(_mm256_cmpeq_epi32(bits, places)))
        }
    }
}
