//! Comparison of images for registration: direct alignment, and the likeness of a render and a photo.
//!
//! All in f64 and row by row; a row's sums are added in order, so the bits do not depend on threads.

mod likeness;
mod normal;
mod shot;

pub use likeness::local_zncc;
pub use normal::{Lens, Light, Normal, Photo, Render, flow, normal_equations};
pub use shot::{Shot, shot};

use crate::Result;

/// Rows and columns of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    pub height: usize,
    pub width: usize,
}

impl Size {
    pub fn pixels(self) -> usize {
        self.height * self.width
    }

    fn check<T>(self, name: &'static str, values: &[T], channels: usize) -> Result<()> {
        let expected = self.pixels() * channels;
        refuse!(values.len() != expected || expected == 0 => name, format!("{expected} values, some"), values.len());
        Ok(())
    }
}

/// The slope along `values[at], values[at + step], …` at the `index`-th of `count`: central, one-sided at the ends,
/// 0 where there is only one.
#[inline(always)]
fn slope(values: &[f64], at: usize, index: usize, count: usize, step: usize) -> f64 {
    if count < 2 {
        return 0.0;
    }
    let (before, after) = (usize::from(index > 0), usize::from(index + 1 < count));
    let rise = values[at + after * step] - values[at - before * step];
    if before + after == 2 {
        rise / 2.0
    } else {
        rise
    }
}

/// Σ aᵢ·bᵢ in eight interleaved sums, which do not depend on the machine's lanes.
#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    const SUMS: usize = 8;
    let mut sums = [0.0; SUMS];
    let (a, a_rest) = a.as_chunks::<SUMS>();
    let (b, b_rest) = b.as_chunks::<SUMS>();
    for (a, b) in a.iter().zip(b) {
        for l in 0..SUMS {
            sums[l] += a[l] * b[l];
        }
    }
    for (l, (a, b)) in a_rest.iter().zip(b_rest).enumerate() {
        sums[l] += a * b;
    }
    sums.iter().sum()
}
