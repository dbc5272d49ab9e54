//! The trainer's Adam on row-major arrays, as torch holds them, with gradients from anywhere.

use rayon::prelude::*;

use super::adam::{BETA2, Biases, EPSILON, GRADIENT_MAX};
use crate::raster::disjoint::DisjointSlice;
use crate::{Error, Result};

/// Rows that one thread steps at a time.
const CHUNK: usize = 1024;

/// One attribute of N Gaussians: N rows of equally many values.
#[derive(Debug)]
pub struct Attribute<'a> {
    pub values: &'a mut [f32],
    /// Adam's moments, as many as values.
    pub first: &'a mut [f32],
    pub second: &'a mut [f32],
    pub gradients: &'a [f32],
    pub rate: f32,
    /// Factors of the rate, one per row or one per value.
    pub share: Option<&'a [f32]>,
}

/// An [`Attribute`] as the threads share it.
struct Shared<'a> {
    values: DisjointSlice<'a, f32>,
    first: DisjointSlice<'a, f32>,
    second: DisjointSlice<'a, f32>,
    gradients: &'a [f32],
    rate: f32,
    share: Option<&'a [f32]>,
    width: usize,
    /// Factors per row.
    shares: usize,
}

/// Takes a step with every row that has a gradient, and counts it in `counts`. Returns the number of rows that were
/// skipped because a gradient is not finite, or too large to be squared.
pub fn step_rows(
    attributes: &mut [Attribute],
    counts: &mut [i64],
    momentum: f32,
    biases: &mut Biases,
) -> Result<usize> {
    let rows = counts.len();
    for attribute in attributes.iter() {
        let all = attribute.values.len();
        refuse!(rows == 0 || !all.is_multiple_of(rows) => "values", "rows of equal length", all);
        Error::unless_equal("first moments", attribute.first.len(), all, "values")?;
        Error::unless_equal("second moments", attribute.second.len(), all, "values")?;
        Error::unless_equal("gradients", attribute.gradients.len(), all, "values")?;
        if let Some(share) = attribute.share
            && share.len() != rows
        {
            Error::unless_equal("shares", share.len(), all, "values")?;
        }
    }
    let most = counts.par_iter().copied().max().unwrap_or(0);
    biases.extend_to(momentum, usize::try_from(most).unwrap_or(0) + 1);
    let shared: Vec<Shared> = attributes
        .iter_mut()
        .map(|a| Shared {
            width: a.values.len() / rows,
            shares: a.share.map_or(0, |share| share.len() / rows),
            values: DisjointSlice::new(a.values),
            first: DisjointSlice::new(a.first),
            second: DisjointSlice::new(a.second),
            gradients: a.gradients,
            rate: a.rate,
            share: a.share,
        })
        .collect();
    let skipped = counts
        .par_chunks_mut(CHUNK)
        .enumerate()
        .map(|(chunk, counts)| {
            let mut skipped = 0;
            for (row, count) in (chunk * CHUNK..).zip(counts) {
                let gradients = shared
                    .iter()
                    .flat_map(|a| &a.gradients[row * a.width..][..a.width]);
                let (mut touched, mut sound) = (false, true);
                for g in gradients {
                    touched |= *g != 0.0;
                    sound &= g.abs() <= GRADIENT_MAX; // false for NaN
                }
                if !touched {
                    continue;
                }
                if !sound {
                    skipped += 1;
                    continue;
                }
                *count += 1;
                let bias = biases.of(*count as usize);
                for attribute in &shared {
                    attribute.step(row, momentum, bias);
                }
            }
            skipped
        });
    Ok(skipped.sum())
}

impl Shared<'_> {
    /// One row's step; rows of one chunk are one thread's.
    fn step(&self, row: usize, momentum: f32, [bias1, bias2]: [f32; 2]) {
        let (from, width) = (row * self.width, self.width);
        // SAFETY: the arrays hold `width` values of every row, and each row is one thread's.
        let (values, first, second) = unsafe {
            (
                self.values.slice(from, width),
                self.first.slice(from, width),
                self.second.slice(from, width),
            )
        };
        let gradients = &self.gradients[from..][..width];
        let whole = match self.share {
            Some(share) if self.shares == 1 => share[row],
            _ => 1.0,
        };
        let rate = self.rate * whole * bias1;
        for k in 0..width {
            let g = gradients[k];
            let m = first[k] + (g - first[k]) * (1.0 - momentum);
            let v = second[k] * BETA2 as f32 + g * g * (1.0 - BETA2) as f32;
            let own = match self.share {
                Some(share) if self.shares > 1 => share[from + k],
                _ => 1.0,
            };
            values[k] -= rate * own * m / (v.sqrt() * bias2 + EPSILON);
            (first[k], second[k]) = (m, v);
        }
    }
}
