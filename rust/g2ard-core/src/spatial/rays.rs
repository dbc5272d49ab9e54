//! First hits of rays in a box of cells whose distance to the nearest full cell is known.

use rayon::prelude::*;

use crate::{Error, Result};

/// Shortest stride, in cells: across the corner of a cell beside a full one.
const LEAST: f64 = 0.6;
/// Distance within the box, in cells, at which a ray from outside begins.
const INSET: f64 = 0.01;

/// Cells of side `cell` from `low`; `steps` are king's moves to the nearest full one, 0 in it, the last axis running.
#[derive(Debug, Clone, Copy)]
pub struct Steps<'a> {
    pub low: [f64; 3],
    pub cell: f64,
    pub shape: [usize; 3],
    pub steps: &'a [i8],
}

impl Steps<'_> {
    /// Distances along unit rays at which they first meet a full cell; infinite where they do not.
    pub fn cast(&self, eyes: &[[f64; 3]], directions: &[[f64; 3]]) -> Result<Vec<f64>> {
        let count: usize = self.shape.iter().product();
        refuse!(self.steps.len() != count || count == 0 =>
            "steps", format!("{count} cells, at least 1"), self.steps.len());
        Error::unless_equal("directions", directions.len(), eyes.len(), "rows")?;
        let rays = eyes.par_iter().zip(directions);
        Ok(rays
            .map(|(eye, direction)| self.first_hit(eye, direction))
            .collect())
    }

    /// Distance along a ray to the first full cell, infinite without one. From a cell that is s steps from the nearest full
    /// one, the ray can advance by s − 1 cells without missing any.
    fn first_hit(&self, eye: &[f64; 3], direction: &[f64; 3]) -> f64 {
        let (mut near, mut far) = (f64::NEG_INFINITY, f64::INFINITY);
        for k in 0..3 {
            let high = self.low[k] + self.cell * self.shape[k] as f64;
            let ends = [self.low[k], high].map(|end| (end - eye[k]) / direction[k]);
            if ends.iter().any(|end| end.is_nan()) {
                continue; // 0/0: the ray runs in a face of the box
            }
            near = near.max(ends[0].min(ends[1]));
            far = far.min(ends[0].max(ends[1]));
        }
        let mut reached = near.max(0.0) + INSET * self.cell;
        while reached < far {
            let steps = self.steps_at([0, 1, 2].map(|k| eye[k] + reached * direction[k]));
            if steps == 0 {
                return reached;
            }
            reached += self.cell * (f64::from(steps) - 1.0).max(LEAST);
        }
        f64::INFINITY
    }

    /// Steps at a point, which is taken into the box if rounding put it beside.
    fn steps_at(&self, point: [f64; 3]) -> i8 {
        let index = (0..3).fold(0, |flat, k| {
            let place = ((point[k] - self.low[k]) / self.cell).floor();
            flat * self.shape[k] + (place.max(0.0) as usize).min(self.shape[k] - 1)
        });
        self.steps[index]
    }
}
