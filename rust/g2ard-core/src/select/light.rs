//! Greedy choice of views by the light that they receive from each Gaussian.

use rayon::prelude::*;

use super::lazy::{Chosen, Objective, lazy_greedy};
use crate::{Control, Result};

/// Rows summed together: the order of the sum does not depend on the number of threads.
const CHUNK: usize = 4096;

/// Light that views receive from Gaussians, in units of what determines one.
#[derive(Debug, Clone, Copy)]
pub struct Light<'a> {
    /// Row by row for each view: (views, rows), not negative.
    pub received: &'a [f32],
    /// What each row has sent to views chosen before.
    pub before: &'a [f64],
}

impl Light<'_> {
    /// The `k` views that greedy maximisation of Σ_i log(1 + before_i + Σ_v received_vi) picks.
    pub fn greedy(&self, k: usize, control: &Control) -> Result<Chosen> {
        let rows = self.before.len();
        refuse!(rows == 0 || !self.received.len().is_multiple_of(rows) =>
            "received", format!("a multiple of {rows} values"), self.received.len());
        let bad = |v: f64| !(v >= 0.0 && v.is_finite());
        refuse!(self.before.iter().any(|&v| bad(v)) || self.received.iter().any(|&v| bad(v.into())) =>
            "received", "numbers, at least 0", "others");
        let state = State {
            received: self.received,
            total: self.before.to_vec(),
        };
        lazy_greedy(state, k, control)
    }
}

struct State<'a> {
    received: &'a [f32],
    total: Vec<f64>,
}

impl State<'_> {
    fn of(&self, view: usize) -> &[f32] {
        &self.received[view * self.total.len()..][..self.total.len()]
    }
}

impl Objective for State<'_> {
    fn views(&self) -> usize {
        self.received.len() / self.total.len()
    }

    /// Σ_i log(1 + received/(1 + total)).
    fn gain(&self, view: usize) -> f64 {
        let parts: Vec<f64> = self
            .of(view)
            .par_chunks(CHUNK)
            .zip(self.total.par_chunks(CHUNK))
            .map(|(received, total)| {
                received
                    .iter()
                    .zip(total)
                    .filter(|&(&r, _)| r > 0.0)
                    .map(|(&r, &t)| (f64::from(r) / (1.0 + t)).ln_1p())
                    .sum()
            })
            .collect();
        parts.iter().sum()
    }

    fn add(&mut self, view: usize) {
        let rows = self.total.len();
        let received = &self.received[view * rows..][..rows];
        for (total, &r) in self.total.iter_mut().zip(received) {
            *total += f64::from(r);
        }
    }
}
