//! A single lane of f64.

use super::{F, I, M};
use crate::lanes::Doubles;
use std::ops::{Add, Mul, Sub};

#[derive(Clone, Copy)]
pub(crate) struct D(f64);

impl Add for D {
    type Output = D;
    #[inline(always)]
    fn add(self, other: D) -> D {
        D(self.0 + other.0)
    }
}

impl Sub for D {
    type Output = D;
    #[inline(always)]
    fn sub(self, other: D) -> D {
        D(self.0 - other.0)
    }
}

impl Mul for D {
    type Output = D;
    #[inline(always)]
    fn mul(self, other: D) -> D {
        D(self.0 * other.0)
    }
}

impl Doubles for D {
    type F = F;
    type I = I;
    type M = M;
    #[inline(always)]
    fn splat(value: f64) -> D {
        D(value)
    }
    #[inline(always)]
    fn load(values: &[f64]) -> D {
        D(values[0])
    }
    #[inline(always)]
    fn store(self, values: &mut [f64]) {
        values[0] = self.0;
    }
    #[inline(always)]
    fn refill(self, values: &[f64], mask: M) -> D {
        if mask.0 { D(values[0]) } else { self }
    }
    #[inline(always)]
    fn div(self, by: D) -> D {
        D(self.0 / by.0)
    }
    #[inline(always)]
    fn sqrt(self) -> D {
        D(self.0.sqrt())
    }
    #[inline(always)]
    fn min(self, other: D) -> D {
        D(if self.0 < other.0 { self.0 } else { other.0 })
    }
    #[inline(always)]
    fn max(self, other: D) -> D {
        D(if self.0 > other.0 { self.0 } else { other.0 })
    }
    #[inline(always)]
    fn abs(self) -> D {
        D(self.0.abs())
    }
    #[inline(always)]
    fn lt(self, other: D) -> M {
        M(self.0 < other.0)
    }
    #[inline(always)]
    fn le(self, other: D) -> M {
        M(self.0 <= other.0)
    }
    #[inline(always)]
    fn select(mask: M, yes: D, no: D) -> D {
        if mask.0 { yes } else { no }
    }
    #[inline(always)]
    fn truncate(self) -> I {
        let inside = self.0 > -2_147_483_649.0 && self.0 < 2_147_483_648.0;
        I(if inside { self.0 as i32 } else { i32::MIN })
    }
    #[inline(always)]
    fn from_ints(ints: I) -> D {
        D(f64::from(ints.0))
    }
    #[inline(always)]
    fn from_floats(floats: F) -> D {
        D(f64::from(floats.0))
    }
    #[inline(always)]
    fn to_single(self) -> D {
        D(f64::from(self.0 as f32))
    }
    #[inline(always)]
    fn to_floats(self) -> F {
        F(self.0 as f32)
    }
}
