//! Moment matching: the mass, mean and covariance of a group of Gaussians.

use crate::Splats;
use crate::linalg::{Sym3, outer, sub};
use crate::scene::Gaussian;
use crate::scene::limits::MAX_OPACITY;

/// −log(1 − σ(x)) without cancellation: 1 − σ(x) loses every digit from x = 17 on.
pub fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

pub fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Product of the two largest scales.
pub fn footprint(scales: [f64; 3]) -> f64 {
    let [a, b, c] = scales;
    (a * b).max(b * c).max(a * c)
}

/// −log(1 − α)·A, α clipped at [`MAX_OPACITY`].
pub fn optical_mass(logit: f64, scales: [f64; 3]) -> f64 {
    let cap = (MAX_OPACITY / (1.0 - MAX_OPACITY)).ln();
    softplus(logit.min(cap)) * footprint(scales)
}

/// √tr adj(Σ + e²I): √3 times the root mean square, over all directions, of the area a Gaussian covers in
/// an image, with the variance e² that a renderer adds. No eigenvalues needed.
pub fn rendered_area(cov: &Sym3, blur: f64) -> f64 {
    let [xx, xy, xz, yy, yz, zz] = [
        cov[0] + blur,
        cov[1],
        cov[2],
        cov[3] + blur,
        cov[4],
        cov[5] + blur,
    ];
    let trace = yy * zz - yz * yz + xx * zz - xz * xz + xx * yy - xy * xy;
    trace.max(f64::MIN_POSITIVE).sqrt()
}

/// Mean and covariance of a mixture: parallel-axis terms about the group's own mean, itself taken about
/// the first member, so that neither a far origin nor a narrow group costs digits.
///
/// Members are (weight, mean, covariance); the weights sum to something positive.
pub fn pool(members: &[(f64, [f64; 3], Sym3)]) -> ([f64; 3], Sym3) {
    let total: f64 = members.iter().map(|m| m.0).sum();
    let base = members[0].1;
    let mut mean = [0.0; 3];
    for (w, x, _) in members {
        let d = sub(*x, base);
        (0..3).for_each(|k| mean[k] += w * d[k]);
    }
    let mean = [0, 1, 2].map(|k| base[k] + mean[k] / total);
    let mut cov = [0.0; 6];
    for (w, x, c) in members {
        let o = outer(sub(*x, mean));
        (0..6).for_each(|k| cov[k] += w * (c[k] + o[k]));
    }
    (mean, cov.map(|v| v / total))
}

/// A group merged into one Gaussian.
#[derive(Debug, Clone, PartialEq)]
pub struct Merged {
    pub gaussian: Gaussian,
    pub logit: f64,
    pub sh: Vec<[f32; 3]>,
    /// Σ m.
    pub mass: f64,
    /// Whether α reached [`MAX_OPACITY`], so that the group's mass could not all be kept.
    pub clamped: bool,
}

/// The weight of each row in a merged group, and Σm. A group without mass is averaged evenly.
pub fn weights(splats: &Splats, rows: &[u32]) -> (Vec<f64>, f64) {
    let weigh = |&i: &u32| {
        let logit = f64::from(splats.logit_opacities[i as usize]);
        optical_mass(logit, splats.scales[i as usize].map(f64::from))
    };
    let masses: Vec<f64> = rows.iter().map(weigh).collect();
    let mass: f64 = masses.iter().sum();
    if mass > 0.0 {
        (masses, mass)
    } else {
        (vec![1.0; rows.len()], mass)
    }
}

/// Mean, covariance and SH averaged by optical mass; α = 1 − exp(−Σm / A), A the merged footprint.
pub fn merge(splats: &Splats, rows: &[u32]) -> Merged {
    let (weights, mass) = weights(splats, rows);
    let members: Vec<_> = rows
        .iter()
        .zip(&weights)
        .map(|(&i, &w)| {
            let g = Gaussian::of(splats, i as usize);
            (w, g.mean, g.covariance())
        })
        .collect();
    let (mean, cov) = pool(&members);
    let gaussian = Gaussian::from_moments(mean, &cov);
    Merged::of(splats, rows, &weights, mass, gaussian)
}

impl Merged {
    /// The rows' opacity and SH for the Gaussian that their moments make.
    pub fn of(
        splats: &Splats,
        rows: &[u32],
        weights: &[f64],
        mass: f64,
        gaussian: Gaussian,
    ) -> Self {
        let depth = mass / footprint(gaussian.scales);
        let limit = softplus((MAX_OPACITY / (1.0 - MAX_OPACITY)).ln());
        let logit = if depth > 0.0 {
            depth.min(limit).exp_m1().ln()
        } else {
            f64::from(splats.logit_opacities[rows[0] as usize])
        };
        Self {
            gaussian,
            logit,
            sh: average_sh(splats, rows, weights),
            mass,
            clamped: depth > limit,
        }
    }
}

fn average_sh(splats: &Splats, rows: &[u32], weights: &[f64]) -> Vec<[f32; 3]> {
    let total: f64 = weights.iter().sum();
    let mut sums = vec![[0.0; 3]; splats.sh_coeffs];
    for (&i, &w) in rows.iter().zip(weights) {
        for (sum, sh) in sums.iter_mut().zip(splats.sh_of(i as usize)) {
            (0..3).for_each(|k| sum[k] += w * f64::from(sh[k]));
        }
    }
    sums.into_iter()
        .map(|s| s.map(|v| (v / total) as f32))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn softplus_is_minus_log_of_transmittance() {
        for x in [-1e4f64, -40.0, -1.0, 0.0, 3.0, 15.0, 17.0, 40.0, 1e4] {
            let want = if x > 30.0 { x } else { x.exp().ln_1p() };
            assert!((softplus(x) - want).abs() <= 1e-6 * want.max(1e-300), "{x}");
        }
        assert!(optical_mass(1e4, [1.0; 3]) < 5.0);
    }

    #[test]
    fn merged_opacities_hold_the_mass_up_to_the_largest() {
        let splats = Splats {
            logit_opacities: vec![-3.0],
            sh: vec![[0.0; 3]],
            sh_coeffs: 1,
            ..Splats::default()
        };
        for scale in [0.3, 1.0, 20.0] {
            let gaussian = Gaussian {
                mean: [0.0; 3],
                rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
                scales: [scale; 3],
            };
            for depth in [1e-6f64, 0.01, 0.7, 3.0, 4.6, 4.7, 30.0, 1e4] {
                let mass = depth * footprint(gaussian.scales);
                let merged = Merged::of(&splats, &[0], &[1.0], mass, gaussian);
                let want = (-(-depth).exp_m1()).min(MAX_OPACITY);
                assert!((sigmoid(merged.logit) / want - 1.0).abs() < 1e-6, "{depth}");
                assert_eq!(merged.clamped, want == MAX_OPACITY, "{depth}");
            }
            let none = Merged::of(&splats, &[0], &[1.0], 0.0, gaussian);
            assert_eq!(none.logit, -3.0);
        }
    }

    #[test]
    fn pooling_conserves_moments_far_from_the_origin() {
        let at = |x: f64| [5.4e6 + x, -3e5, 12.0];
        let unit = [1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4];
        let (mean, cov) = pool(&[(1.0, at(0.0), unit), (3.0, at(0.125), unit)]);
        assert_eq!(mean, at(0.09375));
        assert!((cov[0] - (1e-4 + 0.1875 * 0.015625)).abs() < 1e-16);
        assert!((cov[3] - 1e-4).abs() < 1e-18);
    }
}
