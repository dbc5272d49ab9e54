//! The order of a scene: neighbours in space become neighbours in memory, whatever the order of the caller's rows.

use rayon::prelude::*;

use super::{Gaussian, SceneRef};
use crate::linalg::{rotation_from_quat, sub};
use crate::spatial::{RobustBounds, code, codes, order};
use crate::{Result, Splats};

/// Merged means lie on a grid of this share of the scene's radius (rounded down to a power of two), so that adding a
/// dyadic origin back is exact.
const MEAN_GRID: f64 = 1.0 / (1u64 << 36) as f64;

/// The order of a scene: Morton, ties by all attribute bits, by row only between identical rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Ordered {
    /// The input row of each ordered row.
    pub rows: Vec<u32>,
    /// Bounds of the means; everything is computed relative to the origin, the median point.
    pub bounds: RobustBounds,
    /// Spacing of merged means, a power of two.
    pub grid: f64,
    /// Logits that are infinite, and clamped wherever they are used.
    pub infinite_logits: usize,
}

impl Ordered {
    pub fn new(scene: &SceneRef) -> Result<Self> {
        scene.validate()?;
        let world: Vec<[f64; 3]> = (0..scene.len()).map(|i| scene.means.get(i)).collect();
        let bounds = RobustBounds::of(&world);
        let keys = codes(&world, &bounds);
        let mut rows = order(&keys);
        let ties = rows.chunk_by_mut(|&a, &b| keys[a as usize] == keys[b as usize]);
        for run in ties.filter(|run| run.len() > 1) {
            run.sort_by(|&a, &b| scene.compare(a as usize, b as usize).then(a.cmp(&b)));
        }
        Ok(Self::of(scene, rows, bounds))
    }

    /// An order that `new` found before, of the same scene.
    pub fn restored(scene: &SceneRef, rows: Vec<u32>, bounds: RobustBounds) -> Result<Self> {
        scene.validate()?;
        let mut there = vec![false; scene.len()];
        for &row in &rows {
            if let Some(flag) = there.get_mut(row as usize) {
                *flag = true;
            }
        }
        refuse!(rows.len() != scene.len() || there.contains(&false) =>
            "order", format!("each of {} rows once", scene.len()), rows.len());
        Ok(Self::of(scene, rows, bounds))
    }

    fn of(scene: &SceneRef, rows: Vec<u32>, bounds: RobustBounds) -> Self {
        Self {
            rows,
            bounds,
            grid: power_of_two_below(bounds.radius) * MEAN_GRID,
            infinite_logits: scene
                .logit_opacities
                .iter()
                .filter(|v| v.is_infinite())
                .count(),
        }
    }

    /// Morton codes in the scene's order, ascending.
    pub fn codes(&self, scene: &SceneRef) -> Vec<u64> {
        let code = |&row: &u32| code(scene.means.get(row as usize), &self.bounds);
        self.rows.par_iter().map(code).collect()
    }

    /// Values by input row, in the scene's order.
    pub fn sorted<T: Copy + Send + Sync>(&self, by_row: &[T]) -> Vec<T> {
        self.rows
            .par_iter()
            .map(|&row| by_row[row as usize])
            .collect()
    }

    /// One row's geometry relative to the origin.
    pub fn gaussian(&self, scene: &SceneRef, row: usize) -> Gaussian {
        Gaussian {
            mean: sub(scene.means.get(row), self.bounds.origin),
            rotation: rotation_from_quat(scene.quats[row].map(f64::from)),
            scales: scene.scales[row].map(f64::from),
        }
    }

    /// The whole scene in its order, about the origin.
    pub fn splats(&self, scene: &SceneRef) -> Splats {
        let coeffs = scene.rest + 1;
        let mut sh = vec![[0.0; 3]; self.rows.len() * coeffs];
        sh.par_chunks_mut(coeffs)
            .zip(&self.rows)
            .for_each(|(out, &row)| {
                let (dc, rest) = scene.sh_of(row as usize);
                out[0] = dc;
                out[1..].copy_from_slice(rest);
            });
        let rows = || self.rows.iter().map(|&row| row as usize);
        Splats {
            means: rows()
                .map(|i| sub(scene.means.get(i), self.bounds.origin))
                .collect(),
            quats: rows().map(|i| scene.quats[i]).collect(),
            scales: rows().map(|i| scene.scales[i]).collect(),
            logit_opacities: rows().map(|i| scene.logit(i)).collect(),
            sh,
            sh_coeffs: coeffs,
        }
    }

    /// A merged mean, rounded to the grid.
    pub fn on_grid(&self, mean: [f64; 3]) -> [f64; 3] {
        mean.map(|v| (v / self.grid).round() * self.grid)
    }
}

/// The power of two at or below a positive number; 0 for 0.
pub fn power_of_two_below(x: f64) -> f64 {
    f64::from_bits(x.to_bits() & (0x7ff << 52))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Means;

    #[test]
    fn order_depends_on_content_only() {
        let means = [
            [0.5f32, 0.0, 0.0],
            [0.0; 3],
            [0.0; 3],
            [0.0; 3],
            [-0.5, 0.1, 0.0],
        ];
        let logits = [1.0f32, 3.0, f32::INFINITY, 2.0, 0.0];
        let sorted = |permutation: [usize; 5]| {
            let scene = SceneRef {
                means: Means::F32(&permutation.map(|i| means[i])),
                quats: &[[1.0, 0.0, 0.0, 0.0]; 5],
                scales: &[[0.1; 3]; 5],
                logit_opacities: &permutation.map(|i| logits[i]),
                sh0: &[[0.0; 3]; 5],
                sh_rest: &[],
                rest: 0,
            };
            let ordered = Ordered::new(&scene).unwrap();
            (ordered.splats(&scene), ordered)
        };
        let (a, b) = (sorted([0, 1, 2, 3, 4]), sorted([3, 4, 2, 0, 1]));
        assert_eq!(a.0, b.0);
        let (a, b) = (a.1, b.1);
        assert_eq!(a.infinite_logits, 1);
        let back: Vec<usize> = b
            .rows
            .iter()
            .map(|&r| [3, 4, 2, 0, 1][r as usize])
            .collect();
        assert_eq!(back, a.rows.iter().map(|&r| r as usize).collect::<Vec<_>>());
    }

    #[test]
    fn grid_is_a_power_of_two() {
        assert_eq!(power_of_two_below(5.3), 4.0);
        assert_eq!(power_of_two_below(0.3), 0.25);
    }
}
