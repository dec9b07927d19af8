//! Elements of a table for all lanes at once, out of a few rows held in vectors.
//!
//! Neighbouring pixels mostly read posts that are close together. Then a handful of whole
//! loads have what all lanes need, and picking it out of vectors takes a fraction of the time
//! of loading it lane by lane.

use super::{I, M};
use std::arch::x86_64::*;

/// See [`super::Ints::pick_pairs`].
///
/// # Safety
/// As every block of the parent.
#[inline(always)]
pub(super) unsafe fn pairs(square: &[u16; 64], at: I) -> I {
    // SAFETY: by this function's own condition; the halves of the square are in it.
    unsafe {
        let south = _mm512_loadu_si512(square.as_ptr().cast());
        let north = _mm512_loadu_si512(square[32..].as_ptr().cast());
        let both = _mm512_or_si512(at.0, _mm512_slli_epi32::<16>(at.0));
        let at = _mm512_add_epi16(both, _mm512_set1_epi32(1 << 16));
        I(_mm512_permutex2var_epi16(south, at, north))
    }
}

/// See [`super::Ints::corner`].
///
/// # Safety
/// As every block of the parent.
#[inline(always)]
pub(super) unsafe fn corner(low: I, high: I, limit: i32, mask: M) -> (i32, bool) {
    // SAFETY: by this function's own condition.
    unsafe {
        let low = _mm512_mask_blend_epi32(mask.0, _mm512_set1_epi32(-1), low.0);
        let half = _mm512_extracti64x4_epi64::<1>(low);
        let least = _mm256_min_epu16(_mm512_castsi512_si256(low), half);
        let half = _mm256_extracti128_si256::<1>(least);
        let least = _mm_min_epu16(_mm256_castsi256_si128(least), half);
        let least = _mm_min_epu16(least, _mm_shuffle_epi32::<0b01_00_11_10>(least));
        let least = _mm_min_epu16(least, _mm_shuffle_epi32::<0b10_11_00_01>(least));
        let corner = _mm_min_epu16(least, _mm_set1_epi32(limit));
        let reach = _mm512_sub_epi16(high.0, _mm512_broadcastd_epi32(corner));
        let beyond = _mm512_mask_test_epi32_mask(mask.0, reach, _mm512_set1_epi16(!7));
        (_mm_cvtsi128_si32(corner), beyond == 0)
    }
}

/// See [`super::Ints::around_in`].
///
/// # Safety
/// As every block of the parent; the square from `first` on must be readable.
#[inline(always)]
pub(super) unsafe fn around(first: *const u16, stride: usize, at: I) -> [I; 6] {
    // SAFETY: by this function's own condition.
    unsafe {
        let row = |n: usize| _mm_loadu_si128(first.add(n * stride).cast());
        let four = |n: usize| {
            let rows = _mm512_castsi128_si512(row(n));
            let rows = _mm512_inserti32x4::<1>(rows, row(n + 1));
            let rows = _mm512_inserti32x4::<2>(rows, row(n + 2));
            _mm512_inserti32x4::<3>(rows, row(n + 3))
        };
        let (south, north) = (four(0), four(4));
        let at = _mm512_madd_epi16(at.0, _mm512_set1_epi32(8 << 16 | 1));
        let both = _mm512_or_si512(at, _mm512_slli_epi32::<16>(at));
        let pair = |row: i32, column: i32| {
            let low = 8 * row + column;
            let at = _mm512_add_epi16(both, _mm512_set1_epi32((low + 1) << 16 | low));
            I(_mm512_permutex2var_epi16(south, at, north))
        };
        [pair(0, 1), pair(1, 0), pair(1, 2), pair(2, 0), pair(2, 2), pair(3, 1)]
    }
}
