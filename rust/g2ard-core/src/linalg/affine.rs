//! The residual of predicting colour by an affine function of position, for flags and the energy guard.

use glam::DVec3;

use super::{Sym3, outer, symmetric_eigen};

/// Directions flatter than this share of the widest carry no slope.
const RANK_FLOOR: f64 = 1e-12;

/// Centred least squares c ≈ a + B(x − x̄), by the principal directions of x.
struct Fit {
    center: DVec3,
    color: DVec3,
    rank: usize,
    axes: [DVec3; 3],
    slopes: [DVec3; 3],
}

impl Fit {
    fn new(points: &[[f64; 3]], colors: &[[f64; 3]]) -> Self {
        let (center, color) = (mean(points), mean(colors));
        let mut scatter: Sym3 = [0.0; 6];
        for &x in points {
            let o = outer((DVec3::from(x) - center).into());
            (0..6).for_each(|k| scatter[k] += o[k]);
        }
        let e = symmetric_eigen(&scatter);
        let narrow = RANK_FLOOR * e.values[0];
        let mut fit = Self {
            center,
            color,
            rank: e.values.iter().filter(|&&v| v > narrow).count(),
            axes: e.vectors.map(DVec3::from),
            slopes: [DVec3::ZERO; 3],
        };
        for k in 0..fit.rank {
            let (mut zz, mut zc) = (0.0, DVec3::ZERO);
            for (&x, &c) in points.iter().zip(colors) {
                let z = fit.axes[k].dot(DVec3::from(x) - center);
                zz += z * z;
                zc += z * (DVec3::from(c) - color);
            }
            fit.slopes[k] = zc / zz;
        }
        fit
    }

    /// The predicted colour at `x`.
    fn predict(&self, x: [f64; 3]) -> DVec3 {
        let d = DVec3::from(x) - self.center;
        let mut color = self.color;
        for (axis, slope) in self.axes.iter().zip(self.slopes).take(self.rank) {
            color += axis.dot(d) * slope;
        }
        color
    }
}

/// About the first row, so that a far-away origin costs no digits.
fn mean(rows: &[[f64; 3]]) -> DVec3 {
    let base = DVec3::from(rows[0]);
    let sum: DVec3 = rows.iter().map(|&v| DVec3::from(v) - base).sum();
    base + sum * (1.0 / rows.len() as f64)
}

/// E_j of eq. `frequency`: mean over the first `own` points of ‖c_i − ĉ_i‖², ĉ_i predicted by the affine
/// least-squares fit of all points.
///
/// The rest only support the fit (borrowed from neighbouring cells). Up to four points in general position are
/// fitted exactly.
pub fn affine_energy(points: &[[f64; 3]], colors: &[[f64; 3]], own: usize) -> f64 {
    if points.len() < 2 || own == 0 {
        return 0.0;
    }
    let fit = Fit::new(points, colors);
    let energy: f64 = (0..own)
        .map(|i| {
            let residual = DVec3::from(colors[i]) - fit.predict(points[i]);
            residual.dot(residual)
        })
        .sum();
    energy / own as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;

    fn cloud(n: usize, seed: u64) -> Vec<[f64; 3]> {
        let mut random = Lcg(seed);
        let mut next = || random.centred();
        (0..n).map(|_| [next(), next(), next()]).collect()
    }

    #[test]
    fn affine_colours_have_no_energy_however_narrow_or_far_the_cell() {
        for (squash, shift) in [(1.0, 0.0), (1e-7, 0.0), (0.0, 0.0), (1.0, 1e6)] {
            let points: Vec<_> = cloud(30, 7)
                .into_iter()
                .map(|p| [p[0] + shift, p[1] - shift, p[2] * squash])
                .collect();
            let colors: Vec<_> = points
                .iter()
                .map(|p| [0.3 + (p[0] - shift), 0.1 * (p[1] + shift), 0.5])
                .collect();
            assert!(affine_energy(&points, &colors, 30) < 1e-16);
        }
    }

    #[test]
    fn four_points_are_fitted_exactly_five_are_not() {
        let (points, colors) = (cloud(5, 1), cloud(5, 2));
        for n in 1..=4 {
            assert!(affine_energy(&points[..n], &colors[..n], n) < 1e-24, "{n}");
        }
        assert!(affine_energy(&points, &colors, 5) > 1e-4);
    }

    #[test]
    fn points_at_one_place_leave_the_variance() {
        let points = vec![[1.0, 2.0, 3.0]; 10];
        assert_eq!(affine_energy(&points, &vec![[0.5; 3]; 10], 10), 0.0);
        let colors = [[0.0; 3], [0.3, 0.0, 0.4]];
        let energy = affine_energy(&points[..2], &colors, 2);
        assert!((energy - 0.0625).abs() < 1e-15, "{energy}");
    }
}
