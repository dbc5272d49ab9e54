//! Arithmetic on pairs of f32 where f32 is too coarse, and coordinates as integers.

use g2ard_core::spatial::RobustBounds;
use rayon::prelude::*;

#[cfg(test)]
mod tests;
#[cfg(test)]
mod twin;

/// WGSL source that precedes kernels.
pub const TWO: &str = include_str!("two.wgsl");

/// The number that two words from the device represent.
pub fn number(words: &[u32]) -> f64 {
    f64::from(f32::from_bits(words[0])) + f64::from(f32::from_bits(words[1]))
}

/// Coordinates as 64-bit multiples of a power of two. Their differences are exact on every device, however far the
/// scene lies from its origin.
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    origin: [f64; 3],
    /// The unit is two to this power.
    pub exponent: i32,
}

/// Bits of the farthest coordinate.
const BITS: i32 = 60;

/// Points farther out than this many radii of the scene are clamped; no cell of the lattice reaches as far.
const FARTHEST: f64 = (1 << 24) as f64;

impl Frame {
    pub fn around(points: &[[f64; 3]]) -> Self {
        let bounds = RobustBounds::of(points);
        let far =
            |p: &[f64; 3]| (0..3).fold(0f64, |far, k| far.max((p[k] - bounds.origin[k]).abs()));
        let farthest = points.par_iter().map(far).reduce(|| 0.0, f64::max);
        let reach = farthest.clamp(bounds.radius, FARTHEST * bounds.radius);
        Self {
            origin: bounds.origin,
            exponent: reach.log2().ceil() as i32 - BITS,
        }
    }

    pub fn unit(&self) -> f64 {
        2f64.powi(self.exponent)
    }

    pub fn fixed(&self, point: [f64; 3]) -> [i64; 3] {
        let most = (1i64 << (BITS + 1)) as f64;
        let unit = self.unit();
        let along = |k: usize| ((point[k] - self.origin[k]) / unit).clamp(-most, most);
        [0, 1, 2].map(|k| along(k).round() as i64)
    }
}
