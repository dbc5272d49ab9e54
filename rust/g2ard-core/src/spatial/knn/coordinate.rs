//! Coordinates of points, and keys that order results by distance and row.

use std::ops::{AddAssign, Mul, Sub};

/// Squared distance and row.
pub type Neighbor<T> = (T, u32);

/// f32 or f64.
pub trait Coordinate:
    Copy + PartialOrd + Send + Sync + Default + Sub<Output = Self> + Mul<Output = Self> + AddAssign
{
    const INFINITY: Self;
    const NEG_INFINITY: Self;
    const MAX: Self;
    /// A squared distance and a row as one integer, which orders by both.
    type Key: Copy + Ord;
    fn least(self, other: Self) -> Self;
    fn most(self, other: Self) -> Self;
    fn key(self, row: u32) -> Self::Key;
    fn of_key(key: Self::Key) -> Neighbor<Self>;
}

macro_rules! coordinate {
    ($t:ident, $bits:ident, $key:ident) => {
        impl Coordinate for $t {
            const INFINITY: Self = $t::INFINITY;
            const NEG_INFINITY: Self = $t::NEG_INFINITY;
            const MAX: Self = $t::MAX;
            type Key = $key;

            #[inline(always)]
            fn least(self, other: Self) -> Self {
                if self < other { self } else { other }
            }

            #[inline(always)]
            fn most(self, other: Self) -> Self {
                if self > other { self } else { other }
            }

            #[inline(always)]
            fn key(self, row: u32) -> $key {
                // Floats that are not negative order as their bits.
                $key::from(self.to_bits()) << 32 | $key::from(row)
            }

            #[inline(always)]
            fn of_key(key: $key) -> Neighbor<Self> {
                ($t::from_bits((key >> 32) as $bits), key as u32)
            }
        }
    };
}

coordinate!(f32, u32, u64);
coordinate!(f64, u64, u128);
