//! Masks of images: pixels that count.

use rayon::prelude::*;

use super::{RADIUS, Shape, TAPS, window};
use crate::{Error, Result};

/// Pixels that count, with the factor of each one's window.
///
/// A window's weights on other pixels, and beyond the image's edge, are 0, and the rest are divided by their sum, so
/// that these have no part. Without a mask, pixels beyond the edge are black and count.
#[derive(Debug, Clone)]
pub struct Mask {
    /// Per value: 1 / the sum of its window's weights on pixels that count; 0 for pixels that do not.
    pub(crate) factors: Vec<f32>,
    /// Pixels that count.
    count: usize,
}

impl Mask {
    /// `counts`: height × width.
    pub fn new(counts: &[bool], shape: Shape) -> Result<Self> {
        let (width, pixels) = (shape.width, shape.height * shape.width);
        Error::unless_equal("mask", counts.len(), pixels, "values")?;
        refuse!(shape.values() == 0 => "mask", "at least one value", 0);
        let weights = window();
        let along = |row: &[bool]| -> Vec<f64> {
            let on = |x| taps(x, width).filter(|(_, at)| row[*at]);
            (0..width)
                .map(|x| on(x).map(|(k, _)| weights[k]).sum())
                .collect()
        };
        // Weights on pixels that count, along rows, then down.
        let whole = along(&vec![true; width]);
        let mut across = vec![0f64; pixels];
        (across.par_chunks_mut(width).zip(counts.par_chunks(width))).for_each(|(sums, row)| {
            if !row.contains(&false) {
                sums.copy_from_slice(&whole);
            } else if row.contains(&true) {
                sums.copy_from_slice(&along(row));
            }
        });
        let mut factors = vec![0f32; shape.values()];
        (factors.par_chunks_mut(shape.row()).enumerate()).for_each(|(y, row)| {
            for (x, values) in row.chunks_exact_mut(shape.channels).enumerate() {
                if counts[y * width + x] {
                    let sum: f64 = (taps(y, shape.height))
                        .map(|(k, at)| weights[k] * across[at * width + x])
                        .sum();
                    values.fill((1.0 / sum) as f32);
                }
            }
        });
        let count = counts.iter().filter(|counts| **counts).count();
        Ok(Self { factors, count })
    }

    /// Values that count, at least 1.
    pub(crate) fn values(&self, channels: usize) -> usize {
        (self.count * channels).max(1)
    }
}

/// The taps of the window at `at` that lie within `length`, and their places.
fn taps(at: usize, length: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..TAPS)
        .map(move |k| (k, (at + k).wrapping_sub(RADIUS)))
        .filter(move |(_, place)| *place < length)
}
