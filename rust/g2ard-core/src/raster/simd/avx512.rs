//! One AVX-512 register.

use std::arch::x86_64::*;
use std::ops::{Add, Div, Mul, Neg, Sub};

use super::{LANES, Lanes, Lanes16, Mask, Real, TO_NEAREST, Vector, Wide, exp2_fraction};

/// Intrinsics that touch no memory.
macro_rules! avx512 {
    ($value:expr) => {
        // SAFETY: values of these types are only made inside kernels that `dispatch` runs after it found AVX-512F and DQ,
        // so the instructions exist.
        unsafe { $value }
    };
}

#[derive(Clone, Copy)]
pub struct Avx512(__m512);

#[derive(Clone, Copy)]
pub struct Avx512Mask(__mmask16);

#[derive(Clone, Copy)]
pub struct Avx512Wide(__m512d, __m512d);

macro_rules! operators {
    ($($trait:ident $name:ident $single:ident $double:ident),*) => {$(
        impl $trait for Avx512 {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                Self(avx512!($single(self.0, other.0)))
            }
        }
        impl $trait for Avx512Wide {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                avx512!(Self($double(self.0, other.0), $double(self.1, other.1)))
            }
        }
    )*};
}

operators!(
    Add add _mm512_add_ps _mm512_add_pd,
    Sub sub _mm512_sub_ps _mm512_sub_pd,
    Mul mul _mm512_mul_ps _mm512_mul_pd,
    Div div _mm512_div_ps _mm512_div_pd
);

impl Neg for Avx512 {
    type Output = Self;
    lanes! { fn neg(self) -> Self = Self(avx512!(_mm512_xor_ps(self.0, _mm512_set1_ps(-0.0)))); }
}

impl Mask for Avx512Mask {
    lanes! {
        fn and(self, other: Self) -> Self = Self(self.0 & other.0);
        fn or(self, other: Self) -> Self = Self(self.0 | other.0);
        fn and_not(self, other: Self) -> Self = Self(self.0 & !other.0);
        fn bits(self) -> u16 = self.0;
        fn from_bits(bits: u16) -> Self = Self(bits);
    }
}

impl Wide for Avx512Wide {
    #[inline(always)]
    fn splat(value: f64) -> Self {
        avx512!(Self(_mm512_set1_pd(value), _mm512_set1_pd(value)))
    }
    #[inline(always)]
    fn fma(self, factor: Self, addend: Self) -> Self {
        avx512!(Self(
            _mm512_fmadd_pd(self.0, factor.0, addend.0),
            _mm512_fmadd_pd(self.1, factor.1, addend.1),
        ))
    }
    #[inline(always)]
    fn store(self, out: &mut [f64]) {
        let out = &mut out[..LANES];
        // SAFETY: `out` holds 16 values; the instructions exist (`avx512!`).
        unsafe {
            _mm512_storeu_pd(out.as_mut_ptr(), self.0);
            _mm512_storeu_pd(out.as_mut_ptr().add(8), self.1);
        }
    }
}

impl Real for Avx512 {
    type Mask = Avx512Mask;

    lanes! {
        fn splat(value: f32) -> Self = Self(avx512!(_mm512_set1_ps(value)));
        fn min(self, other: Self) -> Self = Self(avx512!(_mm512_min_ps(self.0, other.0)));
        fn max(self, other: Self) -> Self = Self(avx512!(_mm512_max_ps(self.0, other.0)));
        fn sqrt(self) -> Self = Self(avx512!(_mm512_sqrt_ps(self.0)));
        fn ldexp(self, n: Self) -> Self = Self(avx512!(_mm512_scalef_ps(self.0, n.0)));
        fn ge(self, other: Self) -> Avx512Mask = Avx512Mask(avx512!(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(self.0, other.0)));
        fn gt(self, other: Self) -> Avx512Mask = Avx512Mask(avx512!(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(self.0, other.0)));
    }
    #[inline(always)]
    fn select(mask: Avx512Mask, yes: Self, no: Self) -> Self {
        Self(avx512!(_mm512_mask_blend_ps(mask.0, no.0, yes.0)))
    }
}

impl Lanes for Avx512 {
    type Block = Self;
}

impl Vector for Avx512 {
    type Wide = Avx512Wide;

    const COUNT: usize = LANES;

    lanes! {
        fn fma(self, factor: Self, addend: Self) -> Self = Self(avx512!(_mm512_fmadd_ps(self.0, factor.0, addend.0)));
        fn fnma(self, factor: Self, addend: Self) -> Self = Self(avx512!(_mm512_fnmadd_ps(self.0, factor.0, addend.0)));
        fn floor(self) -> Self = Self(avx512!(_mm512_roundscale_ps::<TO_FLOOR>(self.0)));
        fn only(self, mask: Avx512Mask) -> Self = Self(avx512!(_mm512_maskz_mov_ps(mask.0, self.0)));
    }
    #[inline(always)]
    unsafe fn load_at(at: *const f32) -> Self {
        // SAFETY: the caller vouches for 16 readable values; the instructions exist (`avx512!`).
        Self(unsafe { _mm512_loadu_ps(at) })
    }
    #[inline(always)]
    unsafe fn store_at(self, at: *mut f32) {
        // SAFETY: the caller vouches for 16 writable values; the instructions exist (`avx512!`).
        unsafe { _mm512_storeu_ps(at, self.0) }
    }
    #[inline(always)]
    fn widen(self) -> Avx512Wide {
        avx512!({
            let high = _mm512_extractf32x8_ps::<1>(self.0);
            Avx512Wide(
                _mm512_cvtps_pd(_mm512_castps512_ps256(self.0)),
                _mm512_cvtps_pd(high),
            )
        })
    }
    #[inline(always)]
    fn narrow(wide: Avx512Wide) -> Self {
        avx512!({
            let low = _mm512_castps256_ps512(_mm512_cvtpd_ps(wide.0));
            Self(_mm512_insertf32x8::<1>(low, _mm512_cvtpd_ps(wide.1)))
        })
    }
    #[inline(always)]
    fn recip(self) -> Self {
        // 14 bits, then Newton: y + y·(1 − x·y).
        let y = Self(avx512!(_mm512_rcp14_ps(self.0)));
        y.fma(self.fnma(y, Self::splat(1.0)), y)
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        let magic = Self::splat(TO_NEAREST);
        let n = self + magic;
        let p = exp2_fraction(self - (n - magic));
        // The fraction's power is normal: its exponent can be raised as an integer, on other ports than vscalefps.
        avx512!({
            let raise = _mm512_slli_epi32::<23>(_mm512_castps_si512(n.0));
            Self(_mm512_castsi512_ps(_mm512_add_epi32(
                _mm512_castps_si512(p.0),
                raise,
            )))
        })
    }
    #[inline(always)]
    fn sums(rows: &[Self; 10]) -> Lanes16 {
        let mut out = Lanes16::default();
        // SAFETY: `out` holds 16 values, aligned to 64 bytes; the instructions exist (`avx512!`).
        unsafe {
            // Halve the quarters: [a₀+a₂, a₁+a₃, b₀+b₂, b₁+b₃], then [a, b, c, d], a 128-bit quarter each.
            let mut halves = [_mm512_setzero_ps(); 6];
            for k in 0..5 {
                let (a, b) = (rows[2 * k].0, rows[2 * k + 1].0);
                halves[k] = _mm512_add_ps(
                    _mm512_shuffle_f32x4::<0x44>(a, b),
                    _mm512_shuffle_f32x4::<0xEE>(a, b),
                );
            }
            halves[5] = halves[4];
            let mut quarters = [_mm512_setzero_ps(); 3];
            for k in 0..3 {
                let (a, b) = (halves[2 * k], halves[2 * k + 1]);
                quarters[k] = _mm512_add_ps(
                    _mm512_shuffle_f32x4::<0x88>(a, b),
                    _mm512_shuffle_f32x4::<0xDD>(a, b),
                );
            }
            // The same within the quarters.
            let [a, b, c] = quarters;
            let ab = _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
            let cc = _mm512_add_ps(_mm512_unpacklo_ps(c, c), _mm512_unpackhi_ps(c, c));
            let all = _mm512_add_ps(
                _mm512_shuffle_ps::<0x44>(ab, cc),
                _mm512_shuffle_ps::<0xEE>(ab, cc),
            );
            let order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 0, 0, 0, 0, 0, 0);
            _mm512_store_ps(out.0.as_mut_ptr(), _mm512_permutexvar_ps(order, all));
        }
        out
    }
}

/// Round towards −∞, no exceptions.
const TO_FLOOR: i32 = 0x09;
