//! The scene as simplification sees it: centred, finite, in an order that only its content decides.

use std::cmp::Ordering;

use rayon::prelude::*;

use super::moments::Gaussian;
use crate::linalg::{rotation_from_quat, sub};
use crate::spatial::{Frame, codes, order};
use crate::{Error, Result, Splats};

/// Means as the caller holds them.
#[derive(Debug, Clone, Copy)]
pub enum Means<'a> {
    F32(&'a [[f32; 3]]),
    F64(&'a [[f64; 3]]),
}

impl Means<'_> {
    pub fn len(&self) -> usize {
        match self {
            Self::F32(m) => m.len(),
            Self::F64(m) => m.len(),
        }
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn get(&self, i: usize) -> [f64; 3] {
        match self {
            Self::F32(m) => m[i].map(f64::from),
            Self::F64(m) => m[i],
        }
    }
}

/// N Gaussians, borrowed. Logits may be infinite (α = 0 or 1); everything else is finite.
#[derive(Debug, Clone, Copy)]
pub struct SceneRef<'a> {
    pub means: Means<'a>,
    pub quats: &'a [[f32; 4]],
    pub scales: &'a [[f32; 3]],
    pub logit_opacities: &'a [f32],
    pub sh0: &'a [[f32; 3]],
    /// N × `rest` triples.
    pub sh_rest: &'a [[f32; 3]],
    pub rest: usize,
}

impl SceneRef<'_> {
    pub fn len(&self) -> usize {
        self.means.len()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The logit of a row, finite.
    pub fn logit(&self, row: usize) -> f32 {
        clamp_logit(self.logit_opacities[row])
    }

    /// Band 0 and the higher bands of a row.
    pub fn sh_of(&self, row: usize) -> ([f32; 3], &[[f32; 3]]) {
        (
            self.sh0[row],
            &self.sh_rest[row * self.rest..(row + 1) * self.rest],
        )
    }

    fn validate(&self) -> Result<()> {
        let n = self.len();
        if n >= u32::MAX as usize {
            return Err(Error::invalid("means", "fewer than 2³² − 1 rows", n));
        }
        for (name, rows) in [
            ("quats", self.quats.len()),
            ("scales", self.scales.len()),
            ("logit_opacities", self.logit_opacities.len()),
            ("sh0", self.sh0.len()),
        ] {
            if rows != n {
                return Err(Error::invalid(name, format!("{n} rows"), rows));
            }
        }
        if self.sh_rest.len() != n * self.rest {
            return Err(Error::invalid(
                "shN",
                format!("{} triples", n * self.rest),
                self.sh_rest.len(),
            ));
        }
        Ok(())
    }

    /// All attributes of two rows, bit by bit: equal only where the rows are interchangeable.
    fn compare(&self, a: usize, b: usize) -> Ordering {
        let bits = |v: f32| v.to_bits();
        let triple = |v: &[f32; 3]| v.map(bits);
        let rest = |i: usize| {
            self.sh_rest[i * self.rest..(i + 1) * self.rest]
                .iter()
                .map(triple)
        };
        self.means
            .get(a)
            .map(f64::to_bits)
            .cmp(&self.means.get(b).map(f64::to_bits))
            .then_with(|| self.scales[a].map(bits).cmp(&self.scales[b].map(bits)))
            .then_with(|| self.quats[a].map(bits).cmp(&self.quats[b].map(bits)))
            .then_with(|| bits(self.logit_opacities[a]).cmp(&bits(self.logit_opacities[b])))
            .then_with(|| triple(&self.sh0[a]).cmp(&triple(&self.sh0[b])))
            .then_with(|| rest(a).cmp(rest(b)))
    }
}

/// Logit of α = 0 and α = 1 stated exactly: 1e-7 away, as for files.
const LOGIT_OF_ONE: f32 = 16.0;

/// Merged means lie on a grid of this share of the scene's radius (rounded down to a power of two), so
/// that adding back a dyadic origin rounds nothing.
const MEAN_GRID: f64 = 1.0 / (1u64 << 36) as f64;

/// The order of a scene: Morton, ties by all attribute bits, by row only between identical rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Ordered {
    /// The input row of each ordered row.
    pub rows: Vec<u32>,
    /// Morton codes in that order, ascending.
    pub codes: Vec<u64>,
    /// The median point; everything is computed relative to it.
    pub origin: [f64; 3],
    /// Spacing of merged means, a power of two.
    pub grid: f64,
    /// Logits that are infinite, and clamped wherever they are used.
    pub infinite_logits: usize,
}

impl Ordered {
    pub fn new(scene: &SceneRef) -> Result<Self> {
        scene.validate()?;
        let world: Vec<[f64; 3]> = (0..scene.len()).map(|i| scene.means.get(i)).collect();
        let frame = Frame::of(&world);
        let keys = codes(&world, &frame);
        let mut rows = order(&keys);
        let ties = rows.chunk_by_mut(|&a, &b| keys[a as usize] == keys[b as usize]);
        for run in ties.filter(|run| run.len() > 1) {
            run.sort_by(|&a, &b| scene.compare(a as usize, b as usize).then(a.cmp(&b)));
        }
        Ok(Self {
            codes: rows.par_iter().map(|&row| keys[row as usize]).collect(),
            rows,
            origin: frame.origin,
            grid: power_of_two_below(frame.radius) * MEAN_GRID,
            infinite_logits: scene
                .logit_opacities
                .iter()
                .filter(|v| v.is_infinite())
                .count(),
        })
    }

    /// Values by input row, in the scene's order.
    pub fn sorted<T: Copy + Send + Sync>(&self, by_row: &[T]) -> Vec<T> {
        self.rows
            .par_iter()
            .map(|&row| by_row[row as usize])
            .collect()
    }

    /// One row's geometry about the origin.
    pub fn gaussian(&self, scene: &SceneRef, row: usize) -> Gaussian {
        Gaussian {
            mean: sub(scene.means.get(row), self.origin),
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
                .map(|i| sub(scene.means.get(i), self.origin))
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

fn clamp_logit(v: f32) -> f32 {
    if v.is_infinite() {
        LOGIT_OF_ONE.copysign(v)
    } else {
        v
    }
}

fn power_of_two_below(x: f64) -> f64 {
    f64::from_bits(x.to_bits() & (0x7ff << 52))
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn names_the_short_array() {
        let scene = SceneRef {
            means: Means::F64(&[[0.0; 3]; 2]),
            quats: &[[1.0, 0.0, 0.0, 0.0]],
            scales: &[[0.1; 3]; 2],
            logit_opacities: &[0.0; 2],
            sh0: &[[0.0; 3]; 2],
            sh_rest: &[],
            rest: 0,
        };
        assert_eq!(
            Ordered::new(&scene).unwrap_err(),
            Error::invalid("quats", "2 rows", 1)
        );
    }
}
