//! The prior as cells of surface, each with a normal, how far to trust it, and how much it matters.

use rayon::prelude::*;

use crate::linalg::{Sym3, covariance, outer, rotation_from_quat, sub, symmetric_eigen};
use crate::spatial::{Cells, RobustBounds};
use crate::{Error, Result};

/// A scene's geometry, borrowed; means are centred by the caller.
#[derive(Debug, Clone, Copy)]
pub struct Gaussians<'a> {
    pub means: &'a [[f64; 3]],
    pub quats: &'a [[f32; 4]],
    pub scales: &'a [[f32; 3]],
    /// In [0, 1].
    pub opacities: &'a [f32],
}

impl Gaussians<'_> {
    pub fn validate(&self) -> Result<()> {
        let n = self.means.len();
        for (name, rows) in [
            ("quats", self.quats.len()),
            ("scales", self.scales.len()),
            ("opacities", self.opacities.len()),
        ] {
            Error::unless_equal(name, rows, n, "rows")?;
        }
        refuse!(n == 0 => "means", "at least one Gaussian", 0);
        let bad = |i: &usize| {
            let i = *i;
            !(self.means[i].iter().all(|v| v.is_finite())
                && self.quats[i].iter().all(|v| v.is_finite())
                && self.scales[i].iter().all(|v| v.is_finite())
                && self.opacities[i].is_finite())
        };
        match (0..n).find(bad) {
            None => Ok(()),
            Some(first_index) => Err(Error::NonFinite {
                field: "scene",
                count: (0..n).filter(bad).count(),
                first_index,
            }),
        }
    }

    /// Σ = R diag(s²) Rᵀ.
    pub fn covariance(&self, i: usize) -> Sym3 {
        covariance(
            &rotation_from_quat(self.quats[i].map(f64::from)),
            self.scales[i].map(f64::from),
        )
    }

    /// Opacity × the area of the Gaussian's largest ellipse, in units of π.
    fn footprint(&self, i: usize) -> f64 {
        let mut s = self.scales[i].map(f64::from);
        s.sort_by(|a, b| b.total_cmp(a));
        f64::from(self.opacities[i]) * s[0] * s[1]
    }
}

/// M cells of surface.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    /// Means of the members, weighted by footprint.
    pub centers: Vec<[f64; 3]>,
    /// Unit eigenvectors of the least spread, members' own covariances included; no orientation.
    pub normals: Vec<[f64; 3]>,
    /// Planarity (λ₂ − λ₃)/λ₁, in [0, 1].
    pub confidence: Vec<f64>,
    /// Footprint area of the members, capped at the 99th percentile, summing to 1.
    pub weights: Vec<f64>,
    /// Edge of a cell.
    pub size: f64,
}

impl Surface {
    /// About `target` adaptive voxels of the scene.
    pub fn of(scene: &Gaussians<'_>, target: usize) -> Result<Self> {
        scene.validate()?;
        let cells = Cells::adaptive(scene.means, &RobustBounds::of(scene.means), target);
        let rows: Vec<_> = (0..cells.len())
            .into_par_iter()
            .map(|c| cell(scene, cells.members_of(c)))
            .collect();
        let mut weights: Vec<f64> = rows.iter().map(|r| r.3).collect();
        normalise(&mut weights);
        Ok(Self {
            centers: rows.iter().map(|r| r.0).collect(),
            normals: rows.iter().map(|r| r.1).collect(),
            confidence: rows.iter().map(|r| r.2).collect(),
            weights,
            size: cells.size,
        })
    }

    pub fn len(&self) -> usize {
        self.centers.len()
    }
}

/// Centre, normal, planarity and footprint of one cell. With the members' own covariances even a single
/// disc has a normal, where the spread of a few means is mostly noise.
fn cell(scene: &Gaussians<'_>, members: &[u32]) -> ([f64; 3], [f64; 3], f64, f64) {
    let rows = || members.iter().map(|&i| i as usize);
    let area: f64 = rows().map(|i| scene.footprint(i)).sum();
    // Members without area still count by position.
    let mass = |i: usize| {
        if area > 0.0 {
            scene.footprint(i) / area
        } else {
            1.0 / members.len() as f64
        }
    };
    let origin = scene.means[members[0] as usize];
    let mut shift = [0.0; 3];
    for i in rows() {
        let d = sub(scene.means[i], origin);
        for k in 0..3 {
            shift[k] += mass(i) * d[k];
        }
    }
    let center = [0, 1, 2].map(|k| origin[k] + shift[k]);
    let mut spread = [0.0; 6];
    for i in rows() {
        let (own, around) = (scene.covariance(i), outer(sub(scene.means[i], center)));
        for k in 0..6 {
            spread[k] += mass(i) * (own[k] + around[k]);
        }
    }
    let e = symmetric_eigen(&spread);
    let planarity = if e.values[0] > 0.0 {
        (e.values[1] - e.values[2].max(0.0)) / e.values[0]
    } else {
        0.0
    };
    (center, e.vectors[2], planarity.clamp(0.0, 1.0), area)
}

/// Limits weights to their 99th percentile, then scales them to sum to 1.
fn normalise(weights: &mut [f64]) {
    let mut sorted = weights.to_vec();
    sorted.sort_by(f64::total_cmp);
    let cap = sorted[(sorted.len() - 1) * 99 / 100];
    let cap = if cap > 0.0 {
        cap
    } else {
        sorted[sorted.len() - 1]
    };
    for w in weights.iter_mut() {
        *w = w.min(cap);
    }
    let total: f64 = weights.iter().sum();
    let n = weights.len() as f64;
    for w in weights.iter_mut() {
        *w = if total > 0.0 { *w / total } else { 1.0 / n };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_of_discs_knows_its_normal() {
        let mut means = Vec::new();
        for i in 0..30 {
            for j in 0..30 {
                means.push([f64::from(i) * 0.1, f64::from(j) * 0.1, 5.0]);
            }
        }
        let n = means.len();
        let (quats, scales) = (vec![[1.0, 0.0, 0.0, 0.0]; n], vec![[0.1, 0.1, 0.001]; n]);
        let mut opacities = vec![0.9; n];
        opacities[3] = 0.0;
        let scene = Gaussians {
            means: &means,
            quats: &quats,
            scales: &scales,
            opacities: &opacities,
        };
        for target in [n, 60] {
            let surface = Surface::of(&scene, target).unwrap();
            assert!((surface.weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
            for c in 0..surface.len() {
                assert!(surface.normals[c][2].abs() > 1.0 - 1e-9);
                assert!(surface.confidence[c] > 0.3, "{}", surface.confidence[c]);
                assert!((surface.centers[c][2] - 5.0).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_cell_weighs_its_members_by_footprint_in_any_unit() {
        for unit in [1e-4, 1.0, 1e4] {
            for (opacities, share) in [([0.4, 0.8], 0.8), ([0.4, 0.0], 0.0), ([0.0, 0.0], 0.5)] {
                let scene = Gaussians {
                    means: &[[unit, 0.0, 0.0], [3.0 * unit, 0.0, 0.0]],
                    quats: &[[1.0, 0.0, 0.0, 0.0]; 2],
                    scales: &[[0.1, 0.1, 0.01], [0.2, 0.1, 0.01]]
                        .map(|s| s.map(|v| v * unit as f32)),
                    opacities: &opacities,
                };
                let (center, _, _, area) = cell(&scene, &[0, 1]);
                assert!(
                    (center[0] / unit - 1.0 - 2.0 * share).abs() < 1e-5,
                    "{unit}"
                );
                let want: f64 = 0.01 * f64::from(opacities[0]) + 0.02 * f64::from(opacities[1]);
                assert!((area / (unit * unit) - want).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn weights_sum_to_one_and_the_largest_hundredth_is_cut() {
        let mut weights: Vec<f64> = (1..=1001).map(f64::from).collect();
        weights[1000] = 1e9;
        normalise(&mut weights);
        assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert_eq!(weights[990], weights[1000]);
        assert!(weights[989] < weights[990]);
        let mut few = [0.0, 0.0, 3.0];
        normalise(&mut few);
        assert_eq!(few, [0.0, 0.0, 1.0]);
        let mut none = [0.0; 4];
        normalise(&mut none);
        assert_eq!(none, [0.25; 4]);
    }

    #[test]
    fn a_footprint_is_opacity_times_the_two_longer_scales() {
        let scene = Gaussians {
            means: &[[0.0; 3]],
            quats: &[[1.0, 0.0, 0.0, 0.0]],
            scales: &[[2.0, 0.5, 3.0]],
            opacities: &[0.25],
        };
        assert_eq!(scene.footprint(0), 1.5);
    }

    #[test]
    fn names_what_is_wrong() {
        let scene = Gaussians {
            means: &[[0.0; 3]],
            quats: &[],
            scales: &[[1.0; 3]],
            opacities: &[1.0],
        };
        assert!(Surface::of(&scene, 10).is_err());
        let scene = Gaussians {
            means: &[[0.0, f64::NAN, 0.0]],
            quats: &[[1.0, 0.0, 0.0, 0.0]],
            scales: &[[1.0; 3]],
            opacities: &[1.0],
        };
        assert_eq!(
            Surface::of(&scene, 10),
            Err(Error::NonFinite {
                field: "scene",
                count: 1,
                first_index: 0
            })
        );
    }
}
