//! A single lane: the scalar twin of every kernel.

mod doubles;

use super::{Floats, Ints, Lanes, MOST, Mask, check_rows};
use std::ops::{Add, BitAnd, BitOr, Mul, Neg, Not, Sub};

#[derive(Clone, Copy)]
pub(crate) struct One;

#[derive(Clone, Copy)]
pub(crate) struct F(f32);
#[derive(Clone, Copy)]
pub(crate) struct I(i32);
#[derive(Clone, Copy)]
pub(crate) struct M(bool);

impl Lanes for One {
    const N: usize = 1;
    type F = F;
    type I = I;
    type M = M;
    type D = doubles::D;
}

macro_rules! operator {
    ($type:ident, $trait:ident, $name:ident, |$a:ident, $b:ident| $value:expr) => {
        impl $trait for $type {
            type Output = $type;
            #[inline(always)]
            fn $name(self, other: $type) -> $type {
                let ($a, $b) = (self.0, other.0);
                $type($value)
            }
        }
    };
}

operator!(F, Add, add, |a, b| a + b);
operator!(F, Sub, sub, |a, b| a - b);
operator!(F, Mul, mul, |a, b| a * b);
operator!(I, Add, add, |a, b| a.wrapping_add(b));
operator!(I, Sub, sub, |a, b| a.wrapping_sub(b));
operator!(I, BitAnd, bitand, |a, b| a & b);
operator!(M, BitAnd, bitand, |a, b| a & b);
operator!(M, BitOr, bitor, |a, b| a | b);

impl Neg for F {
    type Output = F;
    #[inline(always)]
    fn neg(self) -> F {
        F(-self.0)
    }
}

impl Not for M {
    type Output = M;
    #[inline(always)]
    fn not(self) -> M {
        M(!self.0)
    }
}

impl Floats for F {
    type I = I;
    type M = M;
    #[inline(always)]
    fn splat(value: f32) -> F {
        F(value)
    }
    #[inline(always)]
    fn load(values: &[f32]) -> F {
        F(values[0])
    }
    #[inline(always)]
    fn store(self, values: &mut [f32]) {
        values[0] = self.0;
    }
    #[inline(always)]
    fn div(self, by: F) -> F {
        F(self.0 / by.0)
    }
    #[inline(always)]
    fn sqrt(self) -> F {
        F(self.0.sqrt())
    }
    #[inline(always)]
    fn min(self, other: F) -> F {
        F(if self.0 < other.0 { self.0 } else { other.0 })
    }
    #[inline(always)]
    fn max(self, other: F) -> F {
        F(if self.0 > other.0 { self.0 } else { other.0 })
    }
    #[inline(always)]
    fn abs(self) -> F {
        F(self.0.abs())
    }
    #[inline(always)]
    fn lt(self, other: F) -> M {
        M(self.0 < other.0)
    }
    #[inline(always)]
    fn le(self, other: F) -> M {
        M(self.0 <= other.0)
    }
    #[inline(always)]
    fn eq(self, other: F) -> M {
        M(self.0 == other.0)
    }
    #[inline(always)]
    fn select(mask: M, yes: F, no: F) -> F {
        if mask.0 { yes } else { no }
    }
    #[inline(always)]
    fn truncate(self) -> I {
        let inside = (-2_147_483_648.0..2_147_483_648.0).contains(&self.0);
        I(if inside { self.0 as i32 } else { i32::MIN })
    }
    #[inline(always)]
    fn floor(self) -> I {
        let down = self.truncate();
        I(down.0.wrapping_sub(i32::from(self.0 < down.0 as f32)))
    }
    #[inline(always)]
    fn from_bits(bits: I) -> F {
        F(f32::from_bits(bits.0 as u32))
    }
    #[inline(always)]
    fn to_bits(self) -> I {
        I(self.0.to_bits() as i32)
    }
    #[inline(always)]
    fn lookup(table: &[f32], at: I) -> F {
        F(table[..2][at.0 as usize & 1])
    }
    #[inline(always)]
    fn pick(table: &[f32; 16], at: I) -> F {
        F(table[at.0 as usize & 15])
    }
    #[inline(always)]
    fn scatter(self, table: &mut [f32], at: I, mask: M) {
        if mask.0 {
            let last = table.len() - 1;
            table[(at.0 as u32 as usize).min(last)] = self.0;
        }
    }
    #[inline(always)]
    fn pack(self, _: M) -> F {
        self
    }
}

impl Ints for I {
    type F = F;
    type M = M;
    #[inline(always)]
    fn splat(value: i32) -> I {
        I(value)
    }
    #[inline(always)]
    fn load(values: &[i32]) -> I {
        I(values[0])
    }
    #[inline(always)]
    fn store(self, values: &mut [i32]) {
        values[0] = self.0;
    }
    #[inline(always)]
    fn pack(self, _: M) -> I {
        self
    }
    #[inline(always)]
    fn store_threes(self, bytes: &mut [u8]) {
        bytes[..3].copy_from_slice(&self.0.to_le_bytes()[..3]);
    }
    #[inline(always)]
    fn to_floats(self) -> F {
        F(self.0 as f32)
    }
    #[inline(always)]
    fn shr(self, by: I) -> I {
        I(self.0 >> (by.0 & 31))
    }
    #[inline(always)]
    fn shl(self, by: I) -> I {
        I(self.0 << (by.0 & 31))
    }
    #[inline(always)]
    fn times(self, by: I) -> I {
        I(self.0.wrapping_mul(by.0))
    }
    #[inline(always)]
    fn min(self, other: I) -> I {
        I(Ord::min(self.0, other.0))
    }
    #[inline(always)]
    fn max(self, other: I) -> I {
        I(Ord::max(self.0, other.0))
    }
    #[inline(always)]
    fn eq(self, other: I) -> M {
        M(self.0 == other.0)
    }
    #[inline(always)]
    fn lt(self, other: I) -> M {
        M(self.0 < other.0)
    }
    #[inline(always)]
    fn select(mask: M, yes: I, no: I) -> I {
        if mask.0 { yes } else { no }
    }
    #[inline(always)]
    unsafe fn gather_from(bases: &[*const u8; MOST], at: I, last: I, mask: M) -> I {
        if !mask.0 {
            return I(0);
        }
        let at = (at.0 as u32).min(last.0 as u32) as usize;
        // SAFETY: the caller has seen that so much can be read.
        I(unsafe { bases[0].add(at).cast::<i32>().read_unaligned() })
    }
    #[inline(always)]
    fn gather_pairs(table: &[u16], at: I, mask: M) -> I {
        if !mask.0 {
            return I(0);
        }
        let at = (at.0 as u32 as usize).min(table.len() - 2);
        I((u32::from(table[at]) | u32::from(table[at + 1]) << 16) as i32)
    }
    #[inline(always)]
    fn gather(table: &[u32], at: I, mask: M) -> I {
        if !mask.0 {
            return I(0);
        }
        I(table[(at.0 as u32 as usize).min(table.len() - 1)] as i32)
    }
    #[inline(always)]
    fn gather_twos(table: &[u32], at: I, mask: M) -> (I, I) {
        if !mask.0 {
            return (I(0), I(0));
        }
        let at = (at.0 as u32 as usize).min(table.len() - 2);
        (I(table[at] as i32), I(table[at + 1] as i32))
    }
    #[inline(always)]
    fn gather_around(table: &[u16], at: I, stride: usize, mask: M) -> [I; 6] {
        check_rows(table, stride);
        let at = (at.0 & 0xFFFF) + (at.0 >> 16) * stride as i32;
        let pair = |row: usize, column: i32| {
            Self::gather_pairs(table, I(at + (row * stride) as i32 + column), mask)
        };
        [pair(0, 1), pair(1, 0), pair(1, 2), pair(2, 0), pair(2, 2), pair(3, 1)]
    }
}

impl Mask for M {
    #[inline(always)]
    fn none() -> M {
        M(false)
    }
    #[inline(always)]
    fn select(mask: M, yes: M, no: M) -> M {
        if mask.0 { yes } else { no }
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        u32::from(self.0)
    }
    #[inline(always)]
    fn from_bits(bits: u32) -> M {
        M(bits & 1 == 1)
    }
}
