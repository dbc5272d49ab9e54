//! Lanes in two halves: every operation is done on one, then on the other.

use std::ops::{Add, Div, Mul, Neg, Sub};

use super::{Lanes, Lanes16, Mask, Real, Vector, Wide};

#[derive(Clone, Copy)]
pub struct Twice<H>(H, H);

macro_rules! operators {
    ($($trait:ident $name:ident),*) => {$(
        impl<H: $trait<Output = H>> $trait for Twice<H> {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                Self(self.0.$name(other.0), self.1.$name(other.1))
            }
        }
    )*};
}

operators!(Add add, Sub sub, Mul mul, Div div);

impl<H: Neg<Output = H>> Neg for Twice<H> {
    type Output = Self;
    lanes! { fn neg(self) -> Self = Self(-self.0, -self.1); }
}

impl<M: Mask> Mask for Twice<M> {
    lanes! {
        fn and(self, other: Self) -> Self = Self(self.0.and(other.0), self.1.and(other.1));
        fn or(self, other: Self) -> Self = Self(self.0.or(other.0), self.1.or(other.1));
        fn and_not(self, other: Self) -> Self = Self(self.0.and_not(other.0), self.1.and_not(other.1));
        fn bits(self) -> u16 = self.0.bits() | self.1.bits() << 8;
        fn from_bits(bits: u16) -> Self = Self(M::from_bits(bits), M::from_bits(bits >> 8));
        fn any(self) -> bool = self.0.or(self.1).any();
    }
}

impl<W: Wide> Wide for Twice<W> {
    lanes! {
        fn splat(value: f64) -> Self = Self(W::splat(value), W::splat(value));
        fn fma(self, factor: Self, addend: Self) -> Self =
            Self(self.0.fma(factor.0, addend.0), self.1.fma(factor.1, addend.1));
    }
    #[inline(always)]
    fn store(self, out: &mut [f64]) {
        let (low, high) = out.split_at_mut(out.len() / 2);
        self.0.store(low);
        self.1.store(high);
    }
}

impl<H: Real> Real for Twice<H> {
    type Mask = Twice<H::Mask>;

    lanes! {
        fn splat(value: f32) -> Self = Self(H::splat(value), H::splat(value));
        fn min(self, other: Self) -> Self = Self(self.0.min(other.0), self.1.min(other.1));
        fn max(self, other: Self) -> Self = Self(self.0.max(other.0), self.1.max(other.1));
        fn sqrt(self) -> Self = Self(self.0.sqrt(), self.1.sqrt());
        fn ldexp(self, n: Self) -> Self = Self(self.0.ldexp(n.0), self.1.ldexp(n.1));
        fn ge(self, other: Self) -> Self::Mask = Twice(self.0.ge(other.0), self.1.ge(other.1));
        fn gt(self, other: Self) -> Self::Mask = Twice(self.0.gt(other.0), self.1.gt(other.1));
        fn select(mask: Self::Mask, yes: Self, no: Self) -> Self =
            Self(H::select(mask.0, yes.0, no.0), H::select(mask.1, yes.1, no.1));
    }
}

impl<H: Vector> Vector for Twice<H> {
    type Wide = Twice<H::Wide>;

    const COUNT: usize = 2 * H::COUNT;

    lanes! {
        fn fma(self, factor: Self, addend: Self) -> Self =
            Self(self.0.fma(factor.0, addend.0), self.1.fma(factor.1, addend.1));
        fn fnma(self, factor: Self, addend: Self) -> Self =
            Self(self.0.fnma(factor.0, addend.0), self.1.fnma(factor.1, addend.1));
        fn floor(self) -> Self = Self(self.0.floor(), self.1.floor());
        fn only(self, mask: Self::Mask) -> Self = Self(self.0.only(mask.0), self.1.only(mask.1));
        fn recip(self) -> Self = Self(self.0.recip(), self.1.recip());
        fn exp2(self) -> Self = Self(self.0.exp2(), self.1.exp2());
        fn widen(self) -> Self::Wide = Twice(self.0.widen(), self.1.widen());
        fn narrow(wide: Self::Wide) -> Self = Self(H::narrow(wide.0), H::narrow(wide.1));
    }
    #[inline(always)]
    unsafe fn load_at(at: *const f32) -> Self {
        // SAFETY: the caller vouches for twice as many readable values as a half has.
        unsafe { Self(H::load_at(at), H::load_at(at.add(H::COUNT))) }
    }
    #[inline(always)]
    unsafe fn store_at(self, at: *mut f32) {
        // SAFETY: the caller vouches for twice as many writable values as a half has.
        unsafe {
            self.0.store_at(at);
            self.1.store_at(at.add(H::COUNT));
        }
    }
    #[inline(always)]
    fn sums(rows: &[Self; 10]) -> Lanes16 {
        let mut folded = [H::zero(); 10];
        for k in 0..10 {
            folded[k] = rows[k].0 + rows[k].1;
        }
        H::sums(&folded)
    }
}

impl<H: Vector> Lanes for Twice<H> {
    type Block = H;
}
