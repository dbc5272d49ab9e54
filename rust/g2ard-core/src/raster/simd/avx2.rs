//! AVX registers of eight lanes, with FMA.

use std::arch::x86_64::*;
use std::ops::{Add, Div, Mul, Neg, Sub};

use super::twice::Twice;
use super::{Lanes16, Mask, Real, TO_NEAREST, Vector, Wide, exp2_fraction};

/// Intrinsics that touch no memory.
macro_rules! avx2 {
    ($value:expr) => {
        // SAFETY: values of these types are only made inside kernels that `dispatch` runs after it found AVX2 and FMA,
        // so the instructions exist.
        unsafe { $value }
    };
}

pub type Avx2 = Twice<Avx>;

#[derive(Clone, Copy)]
pub struct Avx(__m256);

#[derive(Clone, Copy)]
pub struct AvxMask(__m256);

#[derive(Clone, Copy)]
pub struct AvxWide(__m256d, __m256d);

macro_rules! operators {
    ($($trait:ident $name:ident $single:ident $double:ident),*) => {$(
        impl $trait for Avx {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                avx2!(Self($single(self.0, other.0)))
            }
        }
        impl $trait for AvxWide {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                avx2!(Self($double(self.0, other.0), $double(self.1, other.1)))
            }
        }
    )*};
}

operators!(
    Add add _mm256_add_ps _mm256_add_pd,
    Sub sub _mm256_sub_ps _mm256_sub_pd,
    Mul mul _mm256_mul_ps _mm256_mul_pd,
    Div div _mm256_div_ps _mm256_div_pd
);

impl Neg for Avx {
    type Output = Self;
    lanes! { fn neg(self) -> Self = avx2!(Self(_mm256_xor_ps(self.0, _mm256_set1_ps(-0.0)))); }
}

impl Mask for AvxMask {
    lanes! {
        fn and(self, other: Self) -> Self = avx2!(Self(_mm256_and_ps(self.0, other.0)));
        fn or(self, other: Self) -> Self = avx2!(Self(_mm256_or_ps(self.0, other.0)));
        fn and_not(self, other: Self) -> Self = avx2!(Self(_mm256_andnot_ps(other.0, self.0)));
        fn bits(self) -> u16 = avx2!(_mm256_movemask_ps(self.0) as u16);
    }
    #[inline(always)]
    fn from_bits(bits: u16) -> Self {
        avx2!({
            let all = _mm256_set1_epi32(i32::from(bits));
            let places = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            let held = _mm256_cmpeq_epi32(_mm256_and_si256(all, places), places);
            Self(_mm256_castsi256_ps(held))
        })
    }
}

impl Wide for AvxWide {
    #[inline(always)]
    fn splat(value: f64) -> Self {
        avx2!(Self(_mm256_set1_pd(value), _mm256_set1_pd(value)))
    }
    #[inline(always)]
    fn fma(self, factor: Self, addend: Self) -> Self {
        avx2!(Self(
            _mm256_fmadd_pd(self.0, factor.0, addend.0),
            _mm256_fmadd_pd(self.1, factor.1, addend.1),
        ))
    }
    #[inline(always)]
    fn store(self, out: &mut [f64]) {
        let out = &mut out[..8];
        // SAFETY: `out` holds 8 values; the instructions exist (`avx2!`).
        unsafe {
            _mm256_storeu_pd(out.as_mut_ptr(), self.0);
            _mm256_storeu_pd(out.as_mut_ptr().add(4), self.1);
        }
    }
}

impl Real for Avx {
    type Mask = AvxMask;

    lanes! {
        fn splat(value: f32) -> Self = avx2!(Self(_mm256_set1_ps(value)));
        fn min(self, other: Self) -> Self = avx2!(Self(_mm256_min_ps(self.0, other.0)));
        fn max(self, other: Self) -> Self = avx2!(Self(_mm256_max_ps(self.0, other.0)));
        fn sqrt(self) -> Self = avx2!(Self(_mm256_sqrt_ps(self.0)));
        fn ge(self, other: Self) -> AvxMask = avx2!(AvxMask(_mm256_cmp_ps::<_CMP_GE_OQ>(self.0, other.0)));
        fn gt(self, other: Self) -> AvxMask = avx2!(AvxMask(_mm256_cmp_ps::<_CMP_GT_OQ>(self.0, other.0)));
        fn select(mask: AvxMask, yes: Self, no: Self) -> Self = avx2!(Self(_mm256_blendv_ps(no.0, yes.0, mask.0)));
    }
    #[inline(always)]
    fn ldexp(self, n: Self) -> Self {
        avx2!({
            let exponent = _mm256_add_epi32(_mm256_cvttps_epi32(n.0), _mm256_set1_epi32(127));
            let power = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(exponent));
            Self(_mm256_mul_ps(self.0, power))
        })
    }
}

impl Vector for Avx {
    type Wide = AvxWide;

    const COUNT: usize = 8;

    lanes! {
        fn fma(self, factor: Self, addend: Self) -> Self = avx2!(Self(_mm256_fmadd_ps(self.0, factor.0, addend.0)));
        fn fnma(self, factor: Self, addend: Self) -> Self = avx2!(Self(_mm256_fnmadd_ps(self.0, factor.0, addend.0)));
        fn floor(self) -> Self = avx2!(Self(_mm256_floor_ps(self.0)));
        fn only(self, mask: AvxMask) -> Self = avx2!(Self(_mm256_and_ps(self.0, mask.0)));
    }
    #[inline(always)]
    unsafe fn load_at(at: *const f32) -> Self {
        // SAFETY: the caller vouches for 8 readable values; the instructions exist (`avx2!`).
        Self(unsafe { _mm256_loadu_ps(at) })
    }
    #[inline(always)]
    unsafe fn store_at(self, at: *mut f32) {
        // SAFETY: the caller vouches for 8 writable values; the instructions exist (`avx2!`).
        unsafe { _mm256_storeu_ps(at, self.0) }
    }
    #[inline(always)]
    fn widen(self) -> AvxWide {
        avx2!(AvxWide(
            _mm256_cvtps_pd(_mm256_castps256_ps128(self.0)),
            _mm256_cvtps_pd(_mm256_extractf128_ps::<1>(self.0)),
        ))
    }
    #[inline(always)]
    fn narrow(wide: AvxWide) -> Self {
        avx2!(Self(_mm256_set_m128(
            _mm256_cvtpd_ps(wide.1),
            _mm256_cvtpd_ps(wide.0)
        )))
    }
    #[inline(always)]
    fn recip(self) -> Self {
        // 12 bits, then Newton twice: y + y·(1 − x·y).
        let mut y = avx2!(Self(_mm256_rcp_ps(self.0)));
        for _ in 0..2 {
            y = y.fma(self.fnma(y, Self::splat(1.0)), y);
        }
        y
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        let magic = Self::splat(TO_NEAREST);
        let n = self + magic;
        let p = exp2_fraction(self - (n - magic));
        // The fraction's power is normal: its exponent can be raised as an integer.
        avx2!({
            let raise = _mm256_slli_epi32::<23>(_mm256_castps_si256(n.0));
            Self(_mm256_castsi256_ps(_mm256_add_epi32(
                _mm256_castps_si256(p.0),
                raise,
            )))
        })
    }
    #[inline(always)]
    fn sums(rows: &[Self; 10]) -> Lanes16 {
        let mut out = Lanes16::default();
        // SAFETY: `out` holds 16 values, aligned to 64 bytes; the instructions exist (`avx2!`).
        unsafe {
            let mut r = [_mm256_setzero_ps(); 12];
            for k in 0..10 {
                r[k] = rows[k].0;
            }
            for k in 0..3 {
                let (a, b) = (
                    _mm256_hadd_ps(r[4 * k], r[4 * k + 1]),
                    _mm256_hadd_ps(r[4 * k + 2], r[4 * k + 3]),
                );
                let four = _mm256_hadd_ps(a, b);
                let sum = _mm_add_ps(
                    _mm256_castps256_ps128(four),
                    _mm256_extractf128_ps::<1>(four),
                );
                _mm_store_ps(out.0.as_mut_ptr().add(4 * k), sum);
            }
        }
        out
    }
}
