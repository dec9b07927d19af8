//! Eight lanes of f64, in two vectors: while one waits the other goes on.
//!
//! SAFETY of every block: as in `avx2`.

use super::{F, I, M};
use crate::lanes::{Doubles, Mask};
use std::arch::x86_64::*;
use std::ops::{Add, Mul, Sub};

/// Lanes 0 to 3, and 4 to 7.
#[derive(Clone, Copy)]
pub(crate) struct D(__m256d, __m256d);

/// For each set of lanes of four which of the values in order goes to which lane, as
/// places of halves of 32 bits.
const RANKS: [[i32; 8]; 16] = {
    let mut table = [[0; 8]; 16];
    let mut set = 0;
    while set < 16 {
        let (mut lane, mut rank) = (0, 0);
        while lane < 4 {
            if set >> lane & 1 == 1 {
                table[set][2 * lane] = 2 * rank;
                table[set][2 * lane + 1] = 2 * rank + 1;
                rank += 1;
            }
            lane += 1;
        }
        set += 1;
    }
    table
};

impl M {
    #[inline(always)]
    fn halves(self) -> (__m256d, __m256d) {
        // SAFETY: see the page of this module.
        unsafe {
            let bits = _mm256_castps_si256(self.0);
            (
                _mm256_castsi256_pd(_mm256_cvtepi32_epi64(_mm256_castsi256_si128(bits))),
                _mm256_castsi256_pd(_mm256_cvtepi32_epi64(_mm256_extracti128_si256::<1>(bits))),
            )
        }
    }

    #[inline(always)]
    fn of_halves(low: __m256d, high: __m256d) -> M {
        // SAFETY: see the page of this module.
        unsafe {
            let even =
                _mm256_shuffle_ps::<0b10_00_10_00>(_mm256_castpd_ps(low), _mm256_castpd_ps(high));
            M(_mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(_mm256_castps_pd(even))))
        }
    }
}

/// The lanes in `set` take the first values, in their order.
#[inline(always)]
fn refill_four(old: __m256d, values: &[f64], set: u32, mask: __m256d) -> __m256d {
    // SAFETY: see the page of this module.
    unsafe {
        let ranks = _mm256_loadu_si256(RANKS[(set & 15) as usize].as_ptr().cast());
        let values = _mm256_castpd_ps(_mm256_loadu_pd(values[..4].as_ptr()));
        let values = _mm256_castps_pd(_mm256_permutevar8x32_ps(values, ranks));
        _mm256_blendv_pd(old, values, mask)
    }
}

macro_rules! operator {
    ($trait:ident, $name:ident, $intrinsic:ident) => {
        impl $trait for D {
            type Output = D;
            #[inline(always)]
            fn $name(self, other: D) -> D {
                // SAFETY: see the page of this module.
                unsafe { D($intrinsic(self.0, other.0), $intrinsic(self.1, other.1)) }
            }
        }
    };
}

operator!(Add, add, _mm256_add_pd);
operator!(Sub, sub, _mm256_sub_pd);
operator!(Mul, mul, _mm256_mul_pd);

macro_rules! binary {
    ($name:ident, $intrinsic:ident) => {
        #[inline(always)]
        fn $name(self, other: D) -> D {
            // SAFETY: see the page of this module.
            unsafe { D($intrinsic(self.0, other.0), $intrinsic(self.1, other.1)) }
        }
    };
}

macro_rules! compare {
    ($name:ident, $constant:ident) => {
        #[inline(always)]
        fn $name(self, other: D) -> M {
            // SAFETY: see the page of this module.
            unsafe {
                M::of_halves(
                    _mm256_cmp_pd::<$constant>(self.0, other.0),
                    _mm256_cmp_pd::<$constant>(self.1, other.1),
                )
            }
        }
    };
}

impl Doubles for D {
    type F = F;
    type I = I;
    type M = M;
    #[inline(always)]
    fn splat(value: f64) -> D {
        // SAFETY: see the page of this module.
        unsafe { D(_mm256_set1_pd(value), _mm256_set1_pd(value)) }
    }
    #[inline(always)]
    fn load(values: &[f64]) -> D {
        let values = &values[..8];
        // SAFETY: see the page of this module.
        unsafe { D(_mm256_loadu_pd(values.as_ptr()), _mm256_loadu_pd(values[4..].as_ptr())) }
    }
    #[inline(always)]
    fn store(self, values: &mut [f64]) {
        let values = &mut values[..8];
        // SAFETY: see the page of this module.
        unsafe {
            _mm256_storeu_pd(values.as_mut_ptr(), self.0);
            _mm256_storeu_pd(values[4..].as_mut_ptr(), self.1);
        }
    }
    #[inline(always)]
    fn refill(self, values: &[f64], mask: M) -> D {
        let values = &values[..8];
        let bits = mask.bits();
        let (low, high) = mask.halves();
        let rest = &values[(bits & 15).count_ones() as usize..][..4];
        D(refill_four(self.0, values, bits, low), refill_four(self.1, rest, bits >> 4, high))
    }
    binary!(div, _mm256_div_pd);
    #[inline(always)]
    fn sqrt(self) -> D {
        // SAFETY: see the page of this module.
        unsafe { D(_mm256_sqrt_pd(self.0), _mm256_sqrt_pd(self.1)) }
    }
    binary!(min, _mm256_min_pd);
    binary!(max, _mm256_max_pd);
    #[inline(always)]
    fn abs(self) -> D {
        // SAFETY: see the page of this module.
        unsafe {
            let sign = _mm256_set1_pd(-0.0);
            D(_mm256_andnot_pd(sign, self.0), _mm256_andnot_pd(sign, self.1))
        }
    }
    compare!(lt, _CMP_LT_OQ);
    compare!(le, _CMP_LE_OQ);
    #[inline(always)]
    fn select(mask: M, yes: D, no: D) -> D {
        let (low, high) = mask.halves();
        // SAFETY: see the page of this module.
        unsafe { D(_mm256_blendv_pd(no.0, yes.0, low), _mm256_blendv_pd(no.1, yes.1, high)) }
    }
    #[inline(always)]
    fn truncate(self) -> I {
        // SAFETY: see the page of this module.
        unsafe {
            let low = _mm256_castsi128_si256(_mm256_cvttpd_epi32(self.0));
            I(_mm256_inserti128_si256::<1>(low, _mm256_cvttpd_epi32(self.1)))
        }
    }
    #[inline(always)]
    fn from_ints(ints: I) -> D {
        // SAFETY: see the page of this module.
        unsafe {
            D(
                _mm256_cvtepi32_pd(_mm256_castsi256_si128(ints.0)),
                _mm256_cvtepi32_pd(_mm256_extracti128_si256::<1>(ints.0)),
            )
        }
    }
    #[inline(always)]
    fn from_floats(floats: F) -> D {
        // SAFETY: see the page of this module.
        unsafe {
            D(
                _mm256_cvtps_pd(_mm256_castps256_ps128(floats.0)),
                _mm256_cvtps_pd(_mm256_extractf128_ps::<1>(floats.0)),
            )
        }
    }
    #[inline(always)]
    fn to_single(self) -> D {
        // SAFETY: see the page of this module.
        unsafe {
            D(_mm256_cvtps_pd(_mm256_cvtpd_ps(self.0)), _mm256_cvtps_pd(_mm256_cvtpd_ps(self.1)))
        }
    }
    #[inline(always)]
    fn to_floats(self) -> F {
        // SAFETY: see the page of this module.
        unsafe {
            let low = _mm256_castps128_ps256(_mm256_cvtpd_ps(self.0));
            F(_mm256_insertf128_ps::<1>(low, _mm256_cvtpd_ps(self.1)))
        }
    }
}
