//! Sixteen lanes of f64, in two vectors: while one waits the other goes on.
//!
//! SAFETY of every block: as in `avx512`.

use super::{F, I, M};
use crate::lanes::Doubles;
use std::arch::x86_64::*;
use std::ops::{Add, Mul, Sub};

/// Lanes 0 to 7, and 8 to 15.
#[derive(Clone, Copy)]
pub(crate) struct D(__m512d, __m512d);

impl M {
    #[inline(always)]
    fn halves(self) -> (__mmask8, __mmask8) {
        (self.0 as u8, (self.0 >> 8) as u8)
    }

    #[inline(always)]
    fn of_halves(low: __mmask8, high: __mmask8) -> M {
        M(u16::from(low) | u16::from(high) << 8)
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

operator!(Add, add, _mm512_add_pd);
operator!(Sub, sub, _mm512_sub_pd);
operator!(Mul, mul, _mm512_mul_pd);

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
                    _mm512_cmp_pd_mask::<$constant>(self.0, other.0),
                    _mm512_cmp_pd_mask::<$constant>(self.1, other.1),
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
        unsafe { D(_mm512_set1_pd(value), _mm512_set1_pd(value)) }
    }
    #[inline(always)]
    fn load(values: &[f64]) -> D {
        let values = &values[..16];
        // SAFETY: see the page of this module.
        unsafe { D(_mm512_loadu_pd(values.as_ptr()), _mm512_loadu_pd(values[8..].as_ptr())) }
    }
    #[inline(always)]
    fn store(self, values: &mut [f64]) {
        let values = &mut values[..16];
        // SAFETY: see the page of this module.
        unsafe {
            _mm512_storeu_pd(values.as_mut_ptr(), self.0);
            _mm512_storeu_pd(values[8..].as_mut_ptr(), self.1);
        }
    }
    #[inline(always)]
    fn refill(self, values: &[f64], mask: M) -> D {
        let values = &values[..16];
        let (low, high) = mask.halves();
        let rest = &values[low.count_ones() as usize..][..8];
        // SAFETY: see the page of this module.
        unsafe {
            D(
                _mm512_mask_expand_pd(self.0, low, _mm512_loadu_pd(values.as_ptr())),
                _mm512_mask_expand_pd(self.1, high, _mm512_loadu_pd(rest.as_ptr())),
            )
        }
    }
    binary!(div, _mm512_div_pd);
    #[inline(always)]
    fn sqrt(self) -> D {
        // SAFETY: see the page of this module.
        unsafe { D(_mm512_sqrt_pd(self.0), _mm512_sqrt_pd(self.1)) }
    }
    binary!(min, _mm512_min_pd);
    binary!(max, _mm512_max_pd);
    #[inline(always)]
    fn abs(self) -> D {
        // SAFETY: see the page of this module.
        unsafe { D(_mm512_abs_pd(self.0), _mm512_abs_pd(self.1)) }
    }
    compare!(lt, _CMP_LT_OQ);
    compare!(le, _CMP_LE_OQ);
    #[inline(always)]
    fn select(mask: M, yes: D, no: D) -> D {
        let (low, high) = mask.halves();
        // SAFETY: see the page of this module.
        unsafe {
            D(_mm512_mask_blend_pd(low, no.0, yes.0), _mm512_mask_blend_pd(high, no.1, yes.1))
        }
    }
    #[inline(always)]
    fn truncate(self) -> I {
        // SAFETY: see the page of this module.
        unsafe {
            let low = _mm512_castsi256_si512(_mm512_cvttpd_epi32(self.0));
            I(_mm512_inserti64x4::<1>(low, _mm512_cvttpd_epi32(self.1)))
        }
    }
    #[inline(always)]
    fn from_ints(ints: I) -> D {
        // SAFETY: see the page of this module.
        unsafe {
            D(
                _mm512_cvtepi32_pd(_mm512_castsi512_si256(ints.0)),
                _mm512_cvtepi32_pd(_mm512_extracti64x4_epi64::<1>(ints.0)),
            )
        }
    }
    #[inline(always)]
    fn from_floats(floats: F) -> D {
        // SAFETY: see the page of this module.
        unsafe {
            D(
                _mm512_cvtps_pd(_mm512_castps512_ps256(floats.0)),
                _mm512_cvtps_pd(_mm512_extractf32x8_ps::<1>(floats.0)),
            )
        }
    }
    #[inline(always)]
    fn to_single(self) -> D {
        // SAFETY: see the page of this module.
        unsafe {
            D(_mm512_cvtps_pd(_mm512_cvtpd_ps(self.0)), _mm512_cvtps_pd(_mm512_cvtpd_ps(self.1)))
        }
    }
    #[inline(always)]
    fn to_floats(self) -> F {
        // SAFETY: see the page of this module.
        unsafe {
            let low = _mm512_castps256_ps512(_mm512_cvtpd_ps(self.0));
            F(_mm512_insertf32x8::<1>(low, _mm512_cvtpd_ps(self.1)))
        }
    }
}
