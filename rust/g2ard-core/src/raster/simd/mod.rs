//! Sixteen f32 lanes, written once and compiled for each instruction set.
//!
//! A kernel is a struct of its arguments with a generic `run`; [`dispatch`] compiles `run` inside a function that
//! has the instruction set's features enabled. Everything on the way must be `#[inline(always)]` (and free of
//! closures), or the intrinsics stay calls.

use std::ops::{Add, Div, Mul};

/// Inlined methods of one expression each.
macro_rules! lanes {
    ($($(#[$doc:meta])* fn $name:ident($($args:tt)*) -> $out:ty = $value:expr;)*) => {$(
        $(#[$doc])*
        #[inline(always)]
        fn $name($($args)*) -> $out {
            $value
        }
    )*};
}

/// Inlined methods that set each part of an array in turn, and return it.
macro_rules! per_lane {
    ($k:ident in $parts:expr; $(fn $name:ident($($args:tt)*) { $out:ident[$_k:ident] = $value:expr })*) => {$(
        #[inline(always)]
        fn $name($($args)*) -> Self {
            for $k in $parts {
                $out.0[$k] = $value;
            }
            $out
        }
    )*};
}

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;
mod portable;
mod real;
mod twice;

pub use portable::Portable;
pub use real::{Real, exp_negative};

pub const LANES: usize = 16;

/// One value per lane in memory, aligned for the widest registers.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
#[repr(C, align(64))]
pub struct Lanes16(pub [f32; LANES]);

/// log2(e) and ln(2).
pub const LOG2_E: f32 = std::f32::consts::LOG2_E;
pub const LN_2: f32 = std::f32::consts::LN_2;

/// One truth value per lane.
pub trait Mask: Copy {
    fn and(self, other: Self) -> Self;
    fn or(self, other: Self) -> Self;
    /// `self & !other`.
    fn and_not(self, other: Self) -> Self;
    /// Bit `l` is lane `l`.
    fn bits(self) -> u16;
    fn from_bits(bits: u16) -> Self;

    #[inline(always)]
    fn any(self) -> bool {
        self.bits() != 0
    }
}

/// f64 lanes: just enough for a rigid transform and a division.
pub trait Wide: Copy + Add<Output = Self> + Mul<Output = Self> + Div<Output = Self> {
    fn splat(value: f64) -> Self;
    fn fma(self, factor: Self, addend: Self) -> Self;
    /// # Panics
    /// `out` does not hold a value per lane.
    fn store(self, out: &mut [f64]);
}

/// f32 lanes, 8 or 16.
pub trait Vector: Real<Mask: Mask> {
    type Wide: Wide;

    /// Number of lanes.
    const COUNT: usize;

    /// `COUNT` values from `at`, which may be unaligned.
    ///
    /// # Safety
    /// `at` must be readable for `COUNT` values.
    unsafe fn load_at(at: *const f32) -> Self;
    /// # Safety
    /// `at` must be writable for `COUNT` values.
    unsafe fn store_at(self, at: *mut f32);
    /// `self · factor + addend`.
    fn fma(self, factor: Self, addend: Self) -> Self;
    /// `addend − self · factor`.
    fn fnma(self, factor: Self, addend: Self) -> Self;
    fn floor(self) -> Self;
    fn widen(self) -> Self::Wide;
    fn narrow(wide: Self::Wide) -> Self;
    /// Lane `k` of the result is the sum of `rows[k]`, in one fixed order; lanes past 10 are unspecified.
    fn sums(rows: &[Self; 10]) -> Lanes16;

    /// A row's values from lane `part · COUNT` on, counted modulo 16.
    #[inline(always)]
    fn load_part(row: &Lanes16, part: usize) -> Self {
        const { assert!(LANES.is_multiple_of(Self::COUNT)) };
        let first = part * Self::COUNT % LANES;
        // SAFETY: COUNT divides 16, so `first` is one of its multiples below 16 and the values lie in the row.
        unsafe { Self::load_at(row.0.as_ptr().add(first)) }
    }

    /// To where [`Vector::load_part`] loads from.
    #[inline(always)]
    fn store_part(self, row: &mut Lanes16, part: usize) {
        const { assert!(LANES.is_multiple_of(Self::COUNT)) };
        let first = part * Self::COUNT % LANES;
        // SAFETY: as in `load_part`.
        unsafe { self.store_at(row.0.as_mut_ptr().add(first)) }
    }

    lanes! {
        fn zero() -> Self = Self::splat(0.0);
        /// `self` where the mask holds, else 0.
        fn only(self, mask: Self::Mask) -> Self = Self::select(mask, self, Self::zero());
        fn abs(self) -> Self = self.max(-self);
        /// 1 / self to about one ulp, for values far from 0 and ∞.
        fn recip(self) -> Self = Self::splat(1.0) / self;
    }

    /// 2^self for −126 ≤ self ≤ 127: relative error ≤ 1.7e-7.
    #[inline(always)]
    fn exp2(self) -> Self {
        let n = (self + Self::splat(0.5)).floor();
        exp2_fraction(self - n).ldexp(n)
    }

    /// e^self, clamped to the normal range; relative error ≤ 2e-7.
    #[inline(always)]
    fn exp(self) -> Self {
        let x = self.max(Self::splat(-87.0)).min(Self::splat(88.0));
        let n = x.fma(Self::splat(LOG2_E), Self::splat(0.5)).floor();
        // Cody–Waite: n·ln2 in two parts, so that the fraction keeps all its digits.
        let r = n.fnma(Self::splat(0.693_359_4), x);
        let r = n.fnma(Self::splat(-2.121_944_4e-4), r);
        let mut p = Self::splat(1.0 / 5040.0);
        for c in [
            1.0 / 720.0,
            1.0 / 120.0,
            1.0 / 24.0,
            1.0 / 6.0,
            0.5,
            1.0,
            1.0,
        ] {
            p = p.fma(r, Self::splat(c));
        }
        p.ldexp(n)
    }

    /// log2(1 + self) for 0 ≤ self ≤ 1: relative error ≤ 3e-7.
    #[inline(always)]
    fn log2_1p(self) -> Self {
        // ln(1 + t) = 2·atanh(s), s = t / (2 + t) ≤ 1/3.
        let s = self / (self + Self::splat(2.0));
        let s2 = s * s;
        let mut p = Self::splat(1.0 / 15.0);
        for c in [
            1.0 / 13.0,
            1.0 / 11.0,
            1.0 / 9.0,
            1.0 / 7.0,
            1.0 / 5.0,
            1.0 / 3.0,
            1.0,
        ] {
            p = p.fma(s2, Self::splat(c));
        }
        p * s * Self::splat(2.0 * LOG2_E)
    }
}

/// Sixteen f32 lanes.
pub trait Lanes: Vector {
    /// Lanes that process a block of pixels: 16 lanes are 4×4 pixels; 8 are 4×2, of which fewer are evaluated without
    /// effect.
    type Block: Vector;

    #[inline(always)]
    fn load(row: &Lanes16) -> Self {
        Self::load_part(row, 0)
    }

    #[inline(always)]
    fn store(self, row: &mut Lanes16) {
        self.store_part(row, 0);
    }
}

/// 2^f on [0, 1): minimax polynomial of degree 5 in the relative error.
#[inline(always)]
pub fn exp2_fraction<F: Vector>(f: F) -> F {
    let mut p = F::splat(EXP2[5]);
    for k in (0..5).rev() {
        p = p.fma(f, F::splat(EXP2[k]));
    }
    p
}

/// Coefficients of 2^f on [−½, ½], lowest power first: within 9.2e-08 of it, 1.7e-07 after rounding to f32.
#[allow(clippy::approx_constant)] // near ln 2, as it must be, but not it
const EXP2: [f32; 6] = [
    1.0,
    0.693_147,
    0.240_222_42,
    0.055_507_336,
    0.009_671_513,
    0.001_326_472_7,
];

/// 1.5·2²³: added to a small number it leaves the nearest integer in the low bits, without a rounding instruction.
pub const TO_NEAREST: f32 = 12_582_912.0;

/// The instruction set that kernels run on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Isa {
    Avx512,
    Avx2,
    Neon,
    Portable,
}

impl Default for Isa {
    fn default() -> Self {
        Self::detect()
    }
}

impl Isa {
    /// The instruction sets that this machine can run, fastest first.
    pub fn available() -> Vec<Self> {
        let all = [Self::Avx512, Self::Avx2, Self::Neon, Self::Portable];
        all.into_iter().filter(|isa| isa.runs_here()).collect()
    }

    /// The fastest.
    pub fn detect() -> Self {
        Self::available()[0]
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Avx512 => "avx512",
            Self::Avx2 => "avx2",
            Self::Neon => "neon",
            Self::Portable => "portable",
        }
    }

    #[cfg(target_arch = "x86_64")]
    fn runs_here(self) -> bool {
        let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        match self {
            Self::Avx512 => {
                avx2 && is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq")
            }
            Self::Avx2 => avx2,
            Self::Neon => false,
            Self::Portable => true,
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn runs_here(self) -> bool {
        self == Self::Portable || (self == Self::Neon && cfg!(target_arch = "aarch64"))
    }
}

/// A kernel: a struct of arguments that can run on any lanes. `run` must be `#[inline(always)]`.
pub trait Kernel {
    type Output;
    fn run<F: Lanes>(self) -> Self::Output;
}

/// Runs a kernel on an instruction set, which must be one that [`Isa::available`] names.
#[inline]
pub fn dispatch<K: Kernel>(isa: Isa, kernel: K) -> K::Output {
    match isa {
        #[cfg(target_arch = "x86_64")]
        Isa::Avx512 => {
            debug_assert!(isa.runs_here());
            // SAFETY: the features were detected when the set was chosen.
            unsafe { on_avx512(kernel) }
        }
        #[cfg(target_arch = "x86_64")]
        Isa::Avx2 => {
            debug_assert!(isa.runs_here());
            // SAFETY: as above.
            unsafe { on_avx2(kernel) }
        }
        #[cfg(target_arch = "aarch64")]
        Isa::Neon => kernel.run::<neon::Neon>(),
        _ => kernel.run::<Portable>(),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
fn on_avx512<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<avx512::Avx512>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn on_avx2<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<avx2::Avx2>()
}

#[cfg(test)]
mod tests;
