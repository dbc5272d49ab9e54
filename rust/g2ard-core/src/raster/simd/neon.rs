//! Eight lanes in two NEON registers.
//!
//! All but `exp2`, `floor` of −0 and the fused `Wide::fma` give the very bits of [`super::Portable`] on the same machine.

use std::arch::aarch64::*;
use std::ops::{Add, Div, Mul, Neg, Sub};

use super::twice::Twice;
use super::{Lanes16, Mask, Real, TO_NEAREST, Vector, Wide, exp2_fraction};

/// Intrinsics that touch no memory.
macro_rules! neon {
    ($value:expr) => {
        // SAFETY: NEON is part of every aarch64 target that Rust builds std for, so the instructions exist.
        unsafe { $value }
    };
}

pub type Neon = Twice<Eight>;

#[derive(Clone, Copy)]
pub struct Eight([float32x4_t; 2]);

#[derive(Clone, Copy)]
pub struct EightMask([uint32x4_t; 2]);

#[derive(Clone, Copy)]
pub struct EightWide([float64x2_t; 4]);

macro_rules! operators {
    ($type:ident: $($trait:ident $name:ident $intrinsic:ident),*) => {$(
        impl $trait for $type {
            type Output = Self;
            #[inline(always)]
            fn $name(mut self, other: Self) -> Self {
                for k in 0..self.0.len() {
                    self.0[k] = neon!($intrinsic(self.0[k], other.0[k]));
                }
                self
            }
        }
    )*};
}

operators!(Eight: Add add vaddq_f32, Sub sub vsubq_f32, Mul mul vmulq_f32, Div div vdivq_f32);
operators!(EightWide: Add add vaddq_f64, Mul mul vmulq_f64, Div div vdivq_f64);

impl Neg for Eight {
    type Output = Self;
    per_lane! { k in 0..2; fn neg(mut self) { self[k] = neon!(vnegq_f32(self.0[k])) } }
}

impl Mask for EightMask {
    per_lane! {
        k in 0..2;
        fn and(mut self, other: Self) { self[k] = neon!(vandq_u32(self.0[k], other.0[k])) }
        fn or(mut self, other: Self) { self[k] = neon!(vorrq_u32(self.0[k], other.0[k])) }
        fn and_not(mut self, other: Self) { self[k] = neon!(vbicq_u32(self.0[k], other.0[k])) }
    }
    #[inline(always)]
    fn bits(self) -> u16 {
        // A byte per lane, each keeping the bit of its place.
        let [a, b] = self.0;
        let lanes = neon!(vmovn_u16(vcombine_u16(vmovn_u32(a), vmovn_u32(b))));
        let places = neon!(vcreate_u8(0x8040_2010_0804_0201));
        u16::from(neon!(vaddv_u8(vand_u8(lanes, places))))
    }
    #[inline(always)]
    fn from_bits(bits: u16) -> Self {
        let all = neon!(vdupq_n_u32(u32::from(bits)));
        let first = neon!(vcombine_u32(
            vcreate_u32(1 | 2 << 32),
            vcreate_u32(4 | 8 << 32)
        ));
        Self([
            neon!(vtstq_u32(all, first)),
            neon!(vtstq_u32(all, vshlq_n_u32::<4>(first))),
        ])
    }
    #[inline(always)]
    fn any(self) -> bool {
        let [a, b] = self.0;
        neon!(vmaxvq_u32(vorrq_u32(a, b))) != 0
    }
}

impl Wide for EightWide {
    per_lane! {
        k in 0..4;
        fn fma(mut self, factor: Self, addend: Self) { self[k] = neon!(vfmaq_f64(addend.0[k], self.0[k], factor.0[k])) }
    }
    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self([neon!(vdupq_n_f64(value)); 4])
    }
    #[inline(always)]
    fn store(self, out: &mut [f64]) {
        let out = &mut out[..8];
        for k in 0..4 {
            // SAFETY: 2k + 1 < 8, the length of `out`.
            unsafe { vst1q_f64(out.as_mut_ptr().add(2 * k), self.0[k]) };
        }
    }
}

impl Real for Eight {
    type Mask = EightMask;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([neon!(vdupq_n_f32(value)); 2])
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        // Not `vminq_f32`, which keeps a NaN of `self`.
        Self::select(other.gt(self), self, other)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::select(self.gt(other), self, other)
    }
    per_lane! {
        k in 0..2;
        fn sqrt(mut self) { self[k] = neon!(vsqrtq_f32(self.0[k])) }
        fn select(mask: EightMask, yes: Self, mut no: Self) { no[k] = neon!(vbslq_f32(mask.0[k], yes.0[k], no.0[k])) }
    }
    #[inline(always)]
    fn ldexp(mut self, n: Self) -> Self {
        for k in 0..2 {
            let exponent = neon!(vaddq_s32(vcvtq_s32_f32(n.0[k]), vdupq_n_s32(127)));
            let power = neon!(vreinterpretq_f32_s32(vshlq_n_s32::<23>(exponent)));
            self.0[k] = neon!(vmulq_f32(self.0[k], power));
        }
        self
    }
    #[inline(always)]
    fn ge(self, other: Self) -> EightMask {
        let mut mask = [neon!(vdupq_n_u32(0)); 2];
        for k in 0..2 {
            mask[k] = neon!(vcgeq_f32(self.0[k], other.0[k]));
        }
        EightMask(mask)
    }
    #[inline(always)]
    fn gt(self, other: Self) -> EightMask {
        let mut mask = [neon!(vdupq_n_u32(0)); 2];
        for k in 0..2 {
            mask[k] = neon!(vcgtq_f32(self.0[k], other.0[k]));
        }
        EightMask(mask)
    }
}

impl Vector for Eight {
    type Wide = EightWide;

    const COUNT: usize = 8;

    per_lane! {
        k in 0..2;
        fn fma(mut self, factor: Self, addend: Self) { self[k] = neon!(vfmaq_f32(addend.0[k], self.0[k], factor.0[k])) }
        fn fnma(mut self, factor: Self, addend: Self) { self[k] = neon!(vfmsq_f32(addend.0[k], self.0[k], factor.0[k])) }
        fn floor(mut self) { self[k] = neon!(vrndmq_f32(self.0[k])) }
    }
    #[inline(always)]
    unsafe fn load_at(at: *const f32) -> Self {
        let mut out = Self::zero();
        for k in 0..2 {
            // SAFETY: the caller vouches for 8 readable values, and 4k + 3 < 8.
            out.0[k] = unsafe { vld1q_f32(at.add(4 * k)) };
        }
        out
    }
    #[inline(always)]
    unsafe fn store_at(self, at: *mut f32) {
        for k in 0..2 {
            // SAFETY: the caller vouches for 8 writable values, and 4k + 3 < 8.
            unsafe { vst1q_f32(at.add(4 * k), self.0[k]) };
        }
    }
    #[inline(always)]
    fn only(mut self, mask: EightMask) -> Self {
        for k in 0..2 {
            let kept = neon!(vandq_u32(vreinterpretq_u32_f32(self.0[k]), mask.0[k]));
            self.0[k] = neon!(vreinterpretq_f32_u32(kept));
        }
        self
    }
    #[inline(always)]
    fn widen(self) -> EightWide {
        let mut wide = EightWide::splat(0.0);
        for k in 0..2 {
            wide.0[2 * k] = neon!(vcvt_f64_f32(vget_low_f32(self.0[k])));
            wide.0[2 * k + 1] = neon!(vcvt_high_f64_f32(self.0[k]));
        }
        wide
    }
    #[inline(always)]
    fn narrow(wide: EightWide) -> Self {
        let mut out = Self::zero();
        for k in 0..2 {
            out.0[k] = neon!(vcvt_high_f32_f64(
                vcvt_f32_f64(wide.0[2 * k]),
                wide.0[2 * k + 1]
            ));
        }
        out
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        let magic = Self::splat(TO_NEAREST);
        let n = self + magic;
        let mut p = exp2_fraction(self - (n - magic));
        // The fraction's power is normal: its exponent can be raised as an integer.
        for k in 0..2 {
            let raise = neon!(vshlq_n_s32::<23>(vreinterpretq_s32_f32(n.0[k])));
            p.0[k] = neon!(vreinterpretq_f32_s32(vaddq_s32(
                vreinterpretq_s32_f32(p.0[k]),
                raise
            )));
        }
        p
    }
    #[inline(always)]
    fn sums(rows: &[Self; 10]) -> Lanes16 {
        // Lanes l and l + 4, then l + 2 and l + 1 are added: the order of the portable lanes.
        let mut quads = [neon!(vdupq_n_f32(0.0)); 12];
        for k in 0..10 {
            let [a, b] = rows[k].0;
            quads[k] = neon!(vaddq_f32(a, b));
        }
        let mut pairs = [neon!(vdupq_n_f32(0.0)); 6]; // two sums of each of two rows
        for k in 0..6 {
            let (a, b) = (quads[2 * k], quads[2 * k + 1]);
            let low = neon!(vcombine_f32(vget_low_f32(a), vget_low_f32(b)));
            let high = neon!(vcombine_f32(vget_high_f32(a), vget_high_f32(b)));
            pairs[k] = neon!(vaddq_f32(low, high));
        }
        let mut out = Lanes16::default();
        for k in 0..3 {
            let four = neon!(vpaddq_f32(pairs[2 * k], pairs[2 * k + 1]));
            // SAFETY: 4k + 3 < 16, the length of a row.
            unsafe { vst1q_f32(out.0.as_mut_ptr().add(4 * k), four) };
        }
        out
    }
}
