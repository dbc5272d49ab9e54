//! Plain arrays of eight lanes, which run anywhere and are the reference for the other lanes.

use std::ops::{Add, Div, Mul, Neg, Sub};

use super::twice::Twice;
use super::{Lanes16, Mask, Real, TO_NEAREST, Vector, Wide, exp2_fraction};

const COUNT: usize = 8;

/// 2²³: added to a smaller positive number it leaves an integer.
const TO_INTEGER: f32 = 8_388_608.0;

pub type Portable = Twice<Eight>;

#[derive(Clone, Copy)]
pub struct Eight([f32; COUNT]);

#[derive(Clone, Copy)]
pub struct EightWide([f64; COUNT]);

macro_rules! operators {
    ($type:ident: $($trait:ident $name:ident $op:tt),*) => {$(
        impl $trait for $type {
            type Output = Self;
            #[inline(always)]
            fn $name(mut self, other: Self) -> Self {
                for l in 0..COUNT {
                    self.0[l] $op other.0[l];
                }
                self
            }
        }
    )*};
}

operators!(Eight: Add add +=, Sub sub -=, Mul mul *=, Div div /=);
operators!(EightWide: Add add +=, Mul mul *=, Div div /=);

impl Neg for Eight {
    type Output = Self;
    per_lane! { l in 0..COUNT; fn neg(mut self) { self[l] = -self.0[l] } }
}

/// Fused where the target has the instruction; elsewhere `f32::mul_add` would be a library call.
#[inline(always)]
fn mul_add(a: f32, b: f32, c: f32) -> f32 {
    if cfg!(any(target_feature = "fma", target_arch = "aarch64")) {
        a.mul_add(b, c)
    } else {
        a * b + c
    }
}

/// All-ones or all-zeros words, so that comparisons and selections vectorise.
#[derive(Clone, Copy)]
pub struct EightMask([u32; COUNT]);

impl Mask for EightMask {
    per_lane! {
        l in 0..COUNT;
        fn and(mut self, other: Self) { self[l] = self.0[l] & other.0[l] }
        fn or(mut self, other: Self) { self[l] = self.0[l] | other.0[l] }
        fn and_not(mut self, other: Self) { self[l] = self.0[l] & !other.0[l] }
    }
    #[inline(always)]
    fn bits(self) -> u16 {
        let mut bits = 0;
        for l in 0..COUNT {
            bits |= ((self.0[l] & 1) << l) as u16;
        }
        bits
    }
    #[inline(always)]
    fn from_bits(bits: u16) -> Self {
        let mut mask = [0; COUNT];
        for l in 0..COUNT {
            mask[l] = 0u32.wrapping_sub(u32::from(bits >> l) & 1);
        }
        Self(mask)
    }
    #[inline(always)]
    fn any(self) -> bool {
        let mut seen = 0;
        for l in 0..COUNT {
            seen |= self.0[l];
        }
        seen != 0
    }
}

impl Wide for EightWide {
    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self([value; COUNT])
    }
    #[inline(always)]
    fn fma(self, factor: Self, addend: Self) -> Self {
        self * factor + addend
    }
    #[inline(always)]
    fn store(self, out: &mut [f64]) {
        out.copy_from_slice(&self.0);
    }
}

impl Real for Eight {
    type Mask = EightMask;

    per_lane! {
        l in 0..COUNT;
        fn min(mut self, other: Self) { self[l] = if self.0[l] < other.0[l] { self.0[l] } else { other.0[l] } }
        fn max(mut self, other: Self) { self[l] = if self.0[l] > other.0[l] { self.0[l] } else { other.0[l] } }
        fn sqrt(mut self) { self[l] = self.0[l].sqrt() }
    }
    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([value; COUNT])
    }
    #[inline(always)]
    fn ldexp(mut self, n: Self) -> Self {
        for l in 0..COUNT {
            // n is integral and in range, so the exponent field stays valid. Not `n as i32`, which saturates and so
            // does not vectorise.
            let exponent = ((n.0[l] + TO_NEAREST).to_bits() << 23).wrapping_add(127 << 23);
            self.0[l] *= f32::from_bits(exponent);
        }
        self
    }
    #[inline(always)]
    fn ge(self, other: Self) -> EightMask {
        let mut mask = [0; COUNT];
        for l in 0..COUNT {
            mask[l] = if self.0[l] >= other.0[l] { u32::MAX } else { 0 };
        }
        EightMask(mask)
    }
    #[inline(always)]
    fn gt(self, other: Self) -> EightMask {
        let mut mask = [0; COUNT];
        for l in 0..COUNT {
            mask[l] = if self.0[l] > other.0[l] { u32::MAX } else { 0 };
        }
        EightMask(mask)
    }
    #[inline(always)]
    fn select(mask: EightMask, yes: Self, mut no: Self) -> Self {
        for l in 0..COUNT {
            let m = mask.0[l];
            no.0[l] = f32::from_bits((yes.0[l].to_bits() & m) | (no.0[l].to_bits() & !m));
        }
        no
    }
}

impl Vector for Eight {
    type Wide = EightWide;

    const COUNT: usize = COUNT;

    per_lane! {
        l in 0..COUNT;
        fn fma(mut self, factor: Self, addend: Self) { self[l] = mul_add(self.0[l], factor.0[l], addend.0[l]) }
        fn fnma(mut self, factor: Self, addend: Self) { self[l] = mul_add(-self.0[l], factor.0[l], addend.0[l]) }
    }
    #[inline(always)]
    unsafe fn load_at(at: *const f32) -> Self {
        // SAFETY: the caller vouches for 8 readable values.
        Self(unsafe { at.cast::<[f32; COUNT]>().read_unaligned() })
    }
    #[inline(always)]
    unsafe fn store_at(self, at: *mut f32) {
        // SAFETY: the caller vouches for 8 writable values.
        unsafe { at.cast::<[f32; COUNT]>().write_unaligned(self.0) }
    }
    #[inline(always)]
    fn floor(mut self) -> Self {
        for l in 0..COUNT {
            // Round by adding 2²³, and correct: `f32::floor` is a library call without SSE4.1.
            let (x, size) = (self.0[l], self.0[l].abs());
            let rounded = ((size + TO_INTEGER) - TO_INTEGER).copysign(x);
            let t = if size < TO_INTEGER { rounded } else { x };
            self.0[l] = if t > x { t - 1.0 } else { t };
        }
        self
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        let magic = Self::splat(TO_NEAREST);
        let n = self + magic;
        let mut p = exp2_fraction(self - (n - magic));
        for l in 0..COUNT {
            // The fraction's power is normal: its exponent can be raised as an integer.
            let raise = n.0[l].to_bits() << 23;
            p.0[l] = f32::from_bits(p.0[l].to_bits().wrapping_add(raise));
        }
        p
    }
    #[inline(always)]
    fn widen(self) -> EightWide {
        let mut wide = [0.0; COUNT];
        for l in 0..COUNT {
            wide[l] = f64::from(self.0[l]);
        }
        EightWide(wide)
    }
    #[inline(always)]
    fn narrow(wide: EightWide) -> Self {
        let mut out = [0.0; COUNT];
        for l in 0..COUNT {
            out[l] = wide.0[l] as f32;
        }
        Self(out)
    }
    #[inline(always)]
    fn sums(rows: &[Self; 10]) -> Lanes16 {
        let mut out = Lanes16::default();
        for k in 0..10 {
            let mut half = rows[k].0;
            for width in [4, 2, 1] {
                for l in 0..width {
                    half[l] += half[l + width];
                }
            }
            out.0[k] = half[0];
        }
        out
    }
}
