//! The exponential over lanes.

use crate::lanes::{Floats, Ints, Lanes};

/// e to the power of `x`, for x from -87 to 0; what lies outside counts as the nearest of
/// these. Off by a share of at most 5e-7 above -1, and of 6e-6 at -87 (the rounding of x
/// in binary digits).
#[inline(always)]
pub(crate) fn exp<L: Lanes>(x: L::F) -> L::F {
    // 2^y with y = n + f, f from -1/2 to 1/2: Taylor's series of 2^f, whose first term left
    // out is (f ln 2)^7 / 7! < 1.2e-7.
    const TERMS: [f32; 7] = [
        1.0,
        std::f32::consts::LN_2,
        0.240_226_5,
        0.055_504_11,
        0.009_618_129,
        0.001_333_355_8,
        0.000_154_035_3,
    ];
    let x = x.max(L::F::splat(-87.0)).min(L::F::splat(0.0));
    let y = x * L::F::splat(std::f32::consts::LOG2_E);
    let n = (y + L::F::splat(0.5)).floor();
    let f = y - n.to_floats();
    // In pairs (Estrin): as a chain each term would wait for the one before.
    let [t0, t1, t2, t3, t4, t5, t6] = TERMS;
    let square = f * f;
    let low =
        (L::F::splat(t0) + L::F::splat(t1) * f) + (L::F::splat(t2) + L::F::splat(t3) * f) * square;
    let high = (L::F::splat(t4) + L::F::splat(t5) * f) + L::F::splat(t6) * square;
    let sum = low + high * (square * square);
    sum * L::F::from_bits((n + L::I::splat(127)).shl(L::I::splat(23)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::One;

    fn at(x: f32) -> f64 {
        let mut out = [0.0];
        exp::<One>(Floats::splat(x)).store(&mut out);
        f64::from(out[0])
    }

    #[test]
    fn the_error_is_as_stated() {
        let mut worst = [0.0f64; 2];
        for step in 0..=870_000u32 {
            let x = step as f32 * -1e-4;
            let share = (at(x) / libm::exp(f64::from(x)) - 1.0).abs();
            let far = usize::from(x < -1.0);
            worst[far] = worst[far].max(share);
        }
        println!("{worst:?}");
        assert!(worst[0] < 5e-7 && worst[1] < 6e-6, "{worst:?}");
        assert_eq!(at(0.0), 1.0);
        assert_eq!(at(5.0), 1.0);
        assert_eq!(at(-1e9), at(-87.0));
    }
}
