//! How well an affine function of position predicts colour: the residual behind flags and the energy guard.

use super::{Sym3, dot, outer, sub, symmetric_eigen};

/// Directions flatter than this share of the widest carry no slope.
const RANK_FLOOR: f64 = 1e-12;

/// Leverage this close to 1: the fit rests on that one point, so it is left out by fitting anew.
const FULL_LEVERAGE: f64 = 1.0 - 1e-6;

/// Centred least squares c ≈ a + B(x − x̄), by the principal directions of x.
struct Fit {
    center: [f64; 3],
    color: [f64; 3],
    inverse_count: f64,
    rank: usize,
    axes: [[f64; 3]; 3],
    /// Σ z² along each axis.
    spread: [f64; 3],
    slopes: [[f64; 3]; 3],
}

impl Fit {
    /// At least two points for each coefficient: fewer would fit noise exactly.
    fn new(points: &[[f64; 3]], colors: &[[f64; 3]], skip: Option<usize>) -> Self {
        let rows = || (0..points.len()).filter(move |&i| Some(i) != skip);
        let n = points.len() - usize::from(skip.is_some());
        let inverse_count = 1.0 / n as f64;
        let mean = |values: &[[f64; 3]]| {
            // About the first row, so that a far-away origin costs no digits.
            let base = values[rows().next().unwrap_or(0)];
            let mut sum = [0.0; 3];
            for i in rows() {
                let d = sub(values[i], base);
                (0..3).for_each(|k| sum[k] += d[k]);
            }
            [0, 1, 2].map(|k| base[k] + sum[k] * inverse_count)
        };
        let (center, color) = (mean(points), mean(colors));
        let mut scatter: Sym3 = [0.0; 6];
        for i in rows() {
            let o = outer(sub(points[i], center));
            (0..6).for_each(|k| scatter[k] += o[k]);
        }
        let e = symmetric_eigen(&scatter);
        let wide = e
            .values
            .iter()
            .filter(|&&v| v > RANK_FLOOR * e.values[0])
            .count();
        let mut fit = Self {
            center,
            color,
            inverse_count,
            rank: wide.min(n.saturating_sub(1) / 2),
            axes: e.vectors,
            spread: [1.0; 3],
            slopes: [[0.0; 3]; 3],
        };
        for k in 0..fit.rank {
            let (mut zz, mut zc) = (0.0, [0.0; 3]);
            for i in rows() {
                let z = dot(fit.axes[k], sub(points[i], center));
                let c = sub(colors[i], color);
                zz += z * z;
                (0..3).for_each(|j| zc[j] += z * c[j]);
            }
            fit.spread[k] = zz;
            fit.slopes[k] = zc.map(|v| v / zz);
        }
        fit
    }

    /// The predicted colour at `x`, and the leverage of a point there.
    fn predict(&self, x: [f64; 3]) -> ([f64; 3], f64) {
        let d = sub(x, self.center);
        let (mut color, mut leverage) = (self.color, self.inverse_count);
        for k in 0..self.rank {
            let z = dot(self.axes[k], d);
            leverage += z * z / self.spread[k];
            (0..3).for_each(|j| color[j] += z * self.slopes[k][j]);
        }
        (color, leverage)
    }
}

/// Mean over the first `own` points of ‖c_i − ĉ_i‖², where ĉ_i is predicted by an affine fit of all
/// points *but i* (leave-one-out: few points fitted exactly must not read as smooth).
///
/// The rest only support the fit (borrowed from neighbouring cells). One point alone has energy 0.
pub fn affine_energy(points: &[[f64; 3]], colors: &[[f64; 3]], own: usize) -> f64 {
    if points.len() < 2 || own == 0 {
        return 0.0;
    }
    let fit = Fit::new(points, colors, None);
    let mut energy = 0.0;
    for i in 0..own {
        let (predicted, leverage) = fit.predict(points[i]);
        let residual = if leverage < FULL_LEVERAGE {
            sub(colors[i], predicted).map(|v| v / (1.0 - leverage))
        } else {
            sub(
                colors[i],
                Fit::new(points, colors, Some(i)).predict(points[i]).0,
            )
        };
        energy += dot(residual, residual);
    }
    energy / own as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(n: usize, seed: u64) -> Vec<[f64; 3]> {
        let mut state = seed;
        let mut next = || {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        (0..n).map(|_| [next(), next(), next()]).collect()
    }

    /// Leave-one-out by refitting for each point.
    fn naive(points: &[[f64; 3]], colors: &[[f64; 3]]) -> f64 {
        let total: f64 = (0..points.len())
            .map(|i| {
                let p = Fit::new(points, colors, Some(i)).predict(points[i]).0;
                let r = sub(colors[i], p);
                dot(r, r)
            })
            .sum();
        total / points.len() as f64
    }

    #[test]
    fn leverage_formula_is_leave_one_out() {
        for n in [8, 9, 20, 100] {
            let (points, colors) = (cloud(n, 3), cloud(n, 4));
            let (got, want) = (affine_energy(&points, &colors, n), naive(&points, &colors));
            assert!((got - want).abs() <= 1e-10 * want, "{n}: {got} {want}");
        }
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
    fn few_points_do_not_read_as_smooth() {
        let points = cloud(2, 1);
        let colors = [[0.0; 3], [0.3, 0.0, 0.4]];
        assert!((affine_energy(&points, &colors, 2) - 0.25).abs() < 1e-15);
        assert_eq!(affine_energy(&points[..1], &colors[..1], 1), 0.0);
        let line = [[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 5.0, 0.0]];
        let colors = [[0.0; 3], [0.0; 3], [0.0; 3], [1.0, 0.0, 0.0]];
        assert!(affine_energy(&line, &colors, 4) > 0.2);
    }

    #[test]
    fn duplicates_at_one_point() {
        let points = vec![[1.0, 2.0, 3.0]; 10];
        assert_eq!(affine_energy(&points, &vec![[0.5; 3]; 10], 10), 0.0);
    }
}
