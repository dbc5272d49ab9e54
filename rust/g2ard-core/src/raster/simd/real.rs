//! Formulae written once for one value and for sixteen at a time: no operation is fused, so the bits are the same.

use std::f32::consts::{LN_2, LOG2_E};
use std::ops::{Add, Div, Mul, Neg, Sub};

use super::TO_NEAREST;

/// An f32, or lanes of them ([`super::Lanes`]). Generic functions over it must be `#[inline(always)]` and free of
/// closures (see [`super`]).
pub trait Real:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// One truth value for each f32.
    type Mask: Copy;

    fn splat(value: f32) -> Self;
    /// NaN in `self` gives `other`.
    fn max(self, other: Self) -> Self;
    /// NaN in `self` gives `other`.
    fn min(self, other: Self) -> Self;
    fn sqrt(self) -> Self;
    /// `self · 2^n` for integral n in −126…127.
    fn ldexp(self, n: Self) -> Self;
    fn ge(self, other: Self) -> Self::Mask;
    fn gt(self, other: Self) -> Self::Mask;
    /// `yes` where the mask holds, else `no`.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
}

impl Real for f32 {
    type Mask = bool;

    lanes! {
        fn splat(value: f32) -> Self = value;
        fn max(self, other: Self) -> Self = self.max(other);
        fn min(self, other: Self) -> Self = self.min(other);
        fn sqrt(self) -> Self = self.sqrt();
        fn ldexp(self, n: Self) -> Self = self * f32::from_bits(((n as i32 + 127) << 23) as u32);
        fn ge(self, other: Self) -> bool = self >= other;
        fn gt(self, other: Self) -> bool = self > other;
        fn select(mask: bool, yes: Self, no: Self) -> Self = if mask { yes } else { no };
    }
}

/// exp(x) for x ≤ 0, relative error 4e-7; 0 below −87. Rounding may leave x above 0: it is cut at 88.
#[inline(always)]
pub fn exp_negative<T: Real>(x: T) -> T {
    let t = x.max(T::splat(-87.0)).min(T::splat(88.0)) * T::splat(LOG2_E);
    // Adding 1.5·2²³ rounds to the nearest integer in any rounding hardware.
    let n = (t + T::splat(TO_NEAREST)) - T::splat(TO_NEAREST);
    let f = (t - n) * T::splat(LN_2);
    let mut p = T::splat(1.0 / 120.0);
    for c in [1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        p = T::splat(c) + f * p;
    }
    p.ldexp(n)
}
