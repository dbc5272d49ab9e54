//! Plain arrays: runs anywhere, and is what the other lanes are tested against.

use std::ops::{Add, Div, Mul, Neg, Sub};

use super::{LANES, Lanes, Lanes16, Mask, Real, Wide};

#[derive(Clone, Copy)]
pub struct Portable([f32; LANES]);

#[derive(Clone, Copy)]
pub struct PortableWide([f64; LANES]);

macro_rules! operators {
    ($type:ident: $($trait:ident $name:ident $op:tt),*) => {$(
        impl $trait for $type {
            type Output = Self;
            #[inline(always)]
            fn $name(mut self, other: Self) -> Self {
                for l in 0..LANES {
                    self.0[l] $op other.0[l];
                }
                self
            }
        }
    )*};
}

operators!(Portable: Add add +=, Sub sub -=, Mul mul *=, Div div /=);
operators!(PortableWide: Add add +=, Mul mul *=, Div div /=);

impl Neg for Portable {
    type Output = Self;
    #[inline(always)]
    fn neg(mut self) -> Self {
        for l in 0..LANES {
            self.0[l] = -self.0[l];
        }
        self
    }
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
pub struct PortableMask([u32; LANES]);

impl Mask for PortableMask {
    #[inline(always)]
    fn and(mut self, other: Self) -> Self {
        for l in 0..LANES {
            self.0[l] &= other.0[l];
        }
        self
    }
    #[inline(always)]
    fn or(mut self, other: Self) -> Self {
        for l in 0..LANES {
            self.0[l] |= other.0[l];
        }
        self
    }
    #[inline(always)]
    fn and_not(mut self, other: Self) -> Self {
        for l in 0..LANES {
            self.0[l] &= !other.0[l];
        }
        self
    }
    #[inline(always)]
    fn bits(self) -> u16 {
        let mut bits = 0;
        for l in 0..LANES {
            bits |= ((self.0[l] & 1) << l) as u16;
        }
        bits
    }
    #[inline(always)]
    fn from_bits(bits: u16) -> Self {
        let mut mask = [0; LANES];
        for l in 0..LANES {
            mask[l] = 0u32.wrapping_sub(u32::from(bits >> l) & 1);
        }
        Self(mask)
    }
    #[inline(always)]
    fn any(self) -> bool {
        let mut seen = 0;
        for l in 0..LANES {
            seen |= self.0[l];
        }
        seen != 0
    }
}

impl Wide for PortableWide {
    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self([value; LANES])
    }
    #[inline(always)]
    fn fma(self, factor: Self, addend: Self) -> Self {
        self * factor + addend
    }
    #[inline(always)]
    fn store(self, out: &mut [f64; LANES]) {
        *out = self.0;
    }
}

impl Real for Portable {
    type Mask = PortableMask;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([value; LANES])
    }
    #[inline(always)]
    fn min(mut self, other: Self) -> Self {
        for l in 0..LANES {
            self.0[l] = if self.0[l] < other.0[l] {
                self.0[l]
            } else {
                other.0[l]
            };
        }
        self
    }
    #[inline(always)]
    fn max(mut self, other: Self) -> Self {
        for l in 0..LANES {
            self.0[l] = if self.0[l] > other.0[l] {
                self.0[l]
            } else {
                other.0[l]
            };
        }
        self
    }
    #[inline(always)]
    fn sqrt(mut self) -> Self {
        for l in 0..LANES {
            self.0[l] = self.0[l].sqrt();
        }
        self
    }
    #[inline(always)]
    fn ldexp(mut self, n: Self) -> Self {
        for l in 0..LANES {
            // n is integral and in range, so the exponent field stays valid.
            let power = f32::from_bits(((n.0[l] as i32 + 127) as u32) << 23);
            self.0[l] *= power;
        }
        self
    }
    #[inline(always)]
    fn ge(self, other: Self) -> PortableMask {
        let mut mask = [0; LANES];
        for l in 0..LANES {
            mask[l] = if self.0[l] >= other.0[l] { u32::MAX } else { 0 };
        }
        PortableMask(mask)
    }
    #[inline(always)]
    fn gt(self, other: Self) -> PortableMask {
        let mut mask = [0; LANES];
        for l in 0..LANES {
            mask[l] = if self.0[l] > other.0[l] { u32::MAX } else { 0 };
        }
        PortableMask(mask)
    }
    #[inline(always)]
    fn select(mask: PortableMask, yes: Self, mut no: Self) -> Self {
        for l in 0..LANES {
            let m = mask.0[l];
            no.0[l] = f32::from_bits((yes.0[l].to_bits() & m) | (no.0[l].to_bits() & !m));
        }
        no
    }
}

impl Lanes for Portable {
    type Wide = PortableWide;

    #[inline(always)]
    fn load(row: &Lanes16) -> Self {
        Self(row.0)
    }
    #[inline(always)]
    unsafe fn load_at(at: *const f32) -> Self {
        // SAFETY: the caller vouches for 16 readable values.
        Self(unsafe { at.cast::<[f32; LANES]>().read_unaligned() })
    }
    #[inline(always)]
    fn store(self, row: &mut Lanes16) {
        row.0 = self.0;
    }
    #[inline(always)]
    unsafe fn store_at(self, at: *mut f32) {
        // SAFETY: the caller vouches for 16 writable values.
        unsafe { at.cast::<[f32; LANES]>().write_unaligned(self.0) }
    }
    #[inline(always)]
    fn fma(mut self, factor: Self, addend: Self) -> Self {
        for l in 0..LANES {
            self.0[l] = mul_add(self.0[l], factor.0[l], addend.0[l]);
        }
        self
    }
    #[inline(always)]
    fn fnma(mut self, factor: Self, addend: Self) -> Self {
        for l in 0..LANES {
            self.0[l] = mul_add(-self.0[l], factor.0[l], addend.0[l]);
        }
        self
    }
    #[inline(always)]
    fn floor(mut self) -> Self {
        for l in 0..LANES {
            // Truncate and correct: `f32::floor` is a library call without SSE4.1.
            let t = self.0[l] as i32 as f32;
            self.0[l] = if t > self.0[l] { t - 1.0 } else { t };
        }
        self
    }
    #[inline(always)]
    fn widen(self) -> PortableWide {
        let mut wide = [0.0; LANES];
        for l in 0..LANES {
            wide[l] = f64::from(self.0[l]);
        }
        PortableWide(wide)
    }
    #[inline(always)]
    fn narrow(wide: PortableWide) -> Self {
        let mut out = [0.0; LANES];
        for l in 0..LANES {
            out[l] = wide.0[l] as f32;
        }
        Self(out)
    }
    #[inline(always)]
    fn sums(rows: &[Self; 10]) -> Lanes16 {
        let mut out = Lanes16::default();
        for k in 0..10 {
            let mut half = rows[k].0;
            for width in [8, 4, 2, 1] {
                for l in 0..width {
                    half[l] += half[l + width];
                }
            }
            out.0[k] = half[0];
        }
        out
    }
}
