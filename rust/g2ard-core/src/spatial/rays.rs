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
        let rays = eyes.par_iter().zip(directions).with_max_len(256);
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
        // No line through the box is longer than its three sides, so a ray that takes more strides is not a unit ray
        // or too far away for strides to move it.
        let cells: usize = self.shape.iter().sum();
        let mut strides = 2 + (cells as f64 / LEAST) as usize;
        while reached < far && strides > 0 {
            strides -= 1;
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
            let place = (point[k] - self.low[k]) / self.cell;
            flat * self.shape[k] + (place.max(0.0) as usize).min(self.shape[k] - 1)
        });
        self.steps[index]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cast a ray through a box that is empty except for one full cell in its far corner.
    fn cast(shape: [usize; 3], eye: [f64; 3], direction: [f64; 3]) -> f64 {
        let mut steps = Vec::new();
        for x in 0..shape[0] {
            for y in 0..shape[1] {
                for z in 0..shape[2] {
                    let far = (shape[0] - 1 - x)
                        .max(shape[1] - 1 - y)
                        .max(shape[2] - 1 - z);
                    steps.push(far.min(127) as i8);
                }
            }
        }
        let grid = Steps {
            low: [0.0; 3],
            cell: 1.0,
            shape,
            steps: &steps,
        };
        grid.cast(&[eye], &[direction]).unwrap()[0]
    }

    #[test]
    fn every_ray_ends() {
        let nothing = f64::INFINITY;
        let odd = [
            0.0,
            -0.0,
            1.0,
            1e-300,
            1e20,
            -1e20,
            1e300,
            nothing,
            f64::NAN,
        ];
        for x in odd {
            for y in odd {
                for (eye, direction) in [
                    ([0.5; 3], [x, y, 0.0]),
                    ([x, y, 0.5], [1.0, 0.0, 0.0]),
                    ([x, y, 0.5], [-1.0, 0.0, 0.0]),
                    ([x, y, x], [0.6, 0.8, 0.0]),
                ] {
                    let _ = cast([5, 4, 3], eye, direction);
                }
            }
        }
        assert_eq!(cast([5, 4, 3], [0.5; 3], [0.0; 3]), nothing);
        assert_eq!(cast([5, 4, 3], [-1e20, 0.5, 0.5], [1.0, 0.0, 0.0]), nothing);
    }

    #[test]
    fn the_longest_ray_reaches_the_last_cell() {
        for shape in [[1, 1, 1], [40, 1, 1], [1, 40, 2], [17, 17, 17]] {
            let [x, y, z] = shape.map(|n: usize| n as f64 - 0.5);
            let eye = [-3.0 * x, -3.0 * y, -3.0 * z];
            let to = [x - eye[0], y - eye[1], z - eye[2]];
            let length = to.iter().map(|v| v * v).sum::<f64>().sqrt();
            let hit = cast(shape, eye, to.map(|v| v / length));
            assert!((hit - length).abs() < 1.0, "{shape:?}: {hit} of {length}");
        }
    }
}
