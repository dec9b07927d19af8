//! Two vectors for one: each operation is done on both, so that one can go on while the
//! other waits. A kernel that is a chain of operations, each waiting for the one before,
//! takes little longer for twice the lanes.

use super::{Floats, Ints, Lanes, Mask};
use std::marker::PhantomData;
use std::ops::{Add, BitAnd, BitOr, Mul, Neg, Not, Sub};

/// Twice the lanes of `L`.
#[derive(Clone, Copy)]
pub(crate) struct Two<L>(PhantomData<L>);

#[derive(Clone, Copy)]
pub(crate) struct F<L: Lanes>(L::F, L::F);
#[derive(Clone, Copy)]
pub(crate) struct I<L: Lanes>(L::I, L::I);
#[derive(Clone, Copy)]
pub(crate) struct M<L: Lanes>(L::M, L::M);

impl<L: Lanes> Lanes for Two<L> {
    const N: usize = 2 * L::N;
    type F = F<L>;
    type I = I<L>;
    type M = M<L>;
}

macro_rules! operator {
    ($type:ident, $trait:ident, $name:ident) => {
        impl<L: Lanes> $trait for $type<L> {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                $type($trait::$name(self.0, other.0), $trait::$name(self.1, other.1))
            }
        }
    };
}

operator!(F, Add, add);
operator!(F, Sub, sub);
operator!(F, Mul, mul);
operator!(I, Add, add);
operator!(I, Sub, sub);
operator!(I, BitAnd, bitand);
operator!(M, BitAnd, bitand);
operator!(M, BitOr, bitor);

impl<L: Lanes> Neg for F<L> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        F(-self.0, -self.1)
    }
}

impl<L: Lanes> Not for M<L> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        M(!self.0, !self.1)
    }
}

macro_rules! binary {
    ($trait:ident, $result:ident, $($name:ident),+) => {
        $(
            #[inline(always)]
            fn $name(self, other: Self) -> $result<L> {
                $result($trait::$name(self.0, other.0), $trait::$name(self.1, other.1))
            }
        )+
    };
}

macro_rules! unary {
    ($trait:ident, $result:ident, $($name:ident),+) => {
        $(
            #[inline(always)]
            fn $name(self) -> $result<L> {
                $result($trait::$name(self.0), $trait::$name(self.1))
            }
        )+
    };
}

impl<L: Lanes> Floats for F<L> {
    type I = I<L>;
    type M = M<L>;
    #[inline(always)]
    fn splat(value: f32) -> Self {
        F(L::F::splat(value), L::F::splat(value))
    }
    #[inline(always)]
    fn load(values: &[f32]) -> Self {
        F(L::F::load(values), L::F::load(&values[L::N..]))
    }
    #[inline(always)]
    fn store(self, values: &mut [f32]) {
        self.0.store(values);
        self.1.store(&mut values[L::N..]);
    }
    binary!(Floats, F, div, min, max);
    binary!(Floats, M, lt, le);
    unary!(Floats, F, sqrt, abs);
    unary!(Floats, I, truncate, floor);
    #[inline(always)]
    fn select(mask: M<L>, yes: Self, no: Self) -> Self {
        F(L::F::select(mask.0, yes.0, no.0), L::F::select(mask.1, yes.1, no.1))
    }
    #[inline(always)]
    fn from_bits(bits: I<L>) -> Self {
        F(L::F::from_bits(bits.0), L::F::from_bits(bits.1))
    }
    #[inline(always)]
    fn scatter(self, table: &mut [f32], at: I<L>, mask: M<L>) {
        self.0.scatter(table, at.0, mask.0);
        self.1.scatter(table, at.1, mask.1);
    }
}

impl<L: Lanes> Ints for I<L> {
    type F = F<L>;
    type M = M<L>;
    #[inline(always)]
    fn splat(value: i32) -> Self {
        I(L::I::splat(value), L::I::splat(value))
    }
    #[inline(always)]
    fn load(values: &[i32]) -> Self {
        I(L::I::load(values), L::I::load(&values[L::N..]))
    }
    #[inline(always)]
    fn store(self, values: &mut [i32]) {
        self.0.store(values);
        self.1.store(&mut values[L::N..]);
    }
    unary!(Ints, F, to_floats);
    binary!(Ints, I, shr, shl, times, min, max);
    binary!(Ints, M, eq, lt);
    #[inline(always)]
    fn select(mask: M<L>, yes: Self, no: Self) -> Self {
        I(L::I::select(mask.0, yes.0, no.0), L::I::select(mask.1, yes.1, no.1))
    }
    #[inline(always)]
    fn gather_pairs(table: &[u16], at: Self, mask: M<L>) -> Self {
        I(L::I::gather_pairs(table, at.0, mask.0), L::I::gather_pairs(table, at.1, mask.1))
    }
    #[inline(always)]
    fn gather(table: &[u32], at: Self, mask: M<L>) -> Self {
        I(L::I::gather(table, at.0, mask.0), L::I::gather(table, at.1, mask.1))
    }
}

impl<L: Lanes> Mask for M<L> {
    #[inline(always)]
    fn none() -> Self {
        M(L::M::none(), L::M::none())
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        self.0.bits() | self.1.bits() << L::N
    }
    #[inline(always)]
    fn from_bits(bits: u32) -> Self {
        M(L::M::from_bits(bits), L::M::from_bits(bits >> L::N))
    }
}
