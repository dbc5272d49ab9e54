//! How far merged Gaussians widen so that surfaces stay closed.
//!
//! Moment matching keeps the extent of a cluster, and where its members overlap, α ≤ 0.99 cannot hold their mass. A
//! surface of one layer, such as a lifted point cloud, needs all of it to stay opaque; where layers lie on top of each
//! other, as in trained scenes, others stop the light and widening only blurs. The optical depth of what lies around a
//! Gaussian tells the two apart.

use rayon::prelude::*;

use crate::linalg::{Sym3, dot, sub};
use crate::scene::Gaussian;
use crate::scene::limits::MAX_OPACITY;
use crate::spatial::Tree;
use crate::{Control, Result, Splats};

use super::moments::sigmoid;

/// Neighbours that count as the same surface.
const NEIGHBORS: usize = 24;

/// Growth that every Gaussian may take.
const LEAST_GROWTH: f64 = 1.15;

/// Least determinant of a projected covariance relative to the square of its trace, so that lines stay finite.
const DETERMINANT_FLOOR: f64 = 1e-12;

/// Gaussians between two checks of the control.
const CHUNK: usize = 4096;

/// Widens each Gaussian by what its mass needs, at most `max_growth` times its area and at most so far that the
/// optical depth at its centre reaches `depth`.
///
/// `needed` is the growth with which α ≤ 0.99 holds the mass; rows of 1 are left as they are. Means are centred.
pub fn close(
    splats: &mut Splats,
    needed: &[f64],
    depth: f64,
    max_growth: f64,
    control: &Control,
) -> Result<()> {
    if needed.iter().all(|&n| n <= 1.0) || max_growth <= 1.0 {
        return Ok(());
    }
    let limits = if depth.is_finite() {
        let depths = optical_depths(splats, |i| needed[i] > LEAST_GROWTH, control)?;
        depths
            .iter()
            .map(|d| (depth / d).max(LEAST_GROWTH))
            .collect()
    } else {
        vec![f64::INFINITY; needed.len()]
    };
    for (i, (&needed, limit)) in needed.iter().zip(limits).enumerate() {
        let growth = needed.min(limit).min(max_growth);
        if growth > 1.0 {
            let mut gaussian = Gaussian::of(splats, i);
            gaussian.widen(growth);
            splats.scales[i] = gaussian.stored_scales();
        }
    }
    Ok(())
}

/// Σ α exp(−½ dᵀ Σ⁻¹ d) of each Gaussian and its nearest neighbours, where they are cut by the line through its centre
/// along its shortest axis: the optical depth of the surface there, for small α; 0 for rows that are not `wanted`.
fn optical_depths(
    splats: &Splats,
    wanted: impl Fn(usize) -> bool + Sync,
    control: &Control,
) -> Result<Vec<f64>> {
    let every = (0..splats.len()).into_par_iter();
    let opacity = |i: usize| sigmoid(f64::from(splats.logit_opacities[i])).min(MAX_OPACITY);
    let opacities: Vec<f64> = every.clone().map(opacity).collect();
    let covariances: Vec<Sym3> = every
        .map(|i| Gaussian::of(splats, i).covariance())
        .collect();
    let tree = Tree::build(&splats.means);
    let found: Vec<Vec<(u32, f64)>> = (0..splats.len().div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            control.check()?;
            let here = chunk * CHUNK..((chunk + 1) * CHUNK).min(splats.len());
            let mut depths = Vec::new();
            let wanted = |at: usize| wanted(tree.rows()[at] as usize);
            tree.nearest_of(here, wanted, NEIGHBORS, |at, near| {
                let row = tree.rows()[at] as usize;
                let own = Gaussian::of(splats, row);
                let [a, b, _] = own.axes_by_scale();
                let (u, v) = (own.axis(a), own.axis(b));
                let of_others = near.iter().map(|n| {
                    let other = n.1 as usize;
                    let d = sub(own.mean, splats.means[other]);
                    opacities[other] * falloff(&covariances[other], [u, v], [dot(u, d), dot(v, d)])
                });
                depths.push((row as u32, opacities[row] + of_others.sum::<f64>()));
            });
            Ok(depths)
        })
        .collect::<Result<_>>()?;
    let mut out = vec![0.0; splats.len()];
    for (row, depth) in found.into_iter().flatten() {
        out[row as usize] = depth;
    }
    Ok(out)
}

/// exp(−½ dᵀ C⁻¹ d) with C a covariance projected onto the plane of two axes.
fn falloff(cov: &Sym3, axes: [[f64; 3]; 2], d: [f64; 2]) -> f64 {
    let times = |p: [f64; 3]| {
        let [xx, xy, xz, yy, yz, zz] = *cov;
        [
            dot([xx, xy, xz], p),
            dot([xy, yy, yz], p),
            dot([xz, yz, zz], p),
        ]
    };
    let (cu, cv) = (times(axes[0]), times(axes[1]));
    let (uu, uv, vv) = (dot(axes[0], cu), dot(axes[0], cv), dot(axes[1], cv));
    let trace = uu + vv;
    let det = (uu * vv - uv * uv).max(DETERMINANT_FLOOR * trace * trace);
    if det <= 0.0 {
        return f64::from(u8::from(d == [0.0; 2])); // a point
    }
    let square = (vv * d[0] * d[0] - 2.0 * uv * d[0] * d[1] + uu * d[1] * d[1]) / det;
    (-0.5 * square.max(0.0)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `side`² flat discs of σ = 0.5 on a unit grid, in each of `layers` planes that lie on each other.
    fn wall(side: usize, layers: usize) -> Splats {
        let mut splats = Splats {
            sh_coeffs: 1,
            ..Splats::default()
        };
        for at in 0..side * side * layers {
            let (x, y) = (at % side, at / side % side);
            let z = (at / (side * side)) as f64 * 0.01;
            splats.means.push([x as f64, y as f64, z]);
            splats.quats.push([1.0, 0.0, 0.0, 0.0]);
            splats.scales.push([0.5, 0.5, 0.001]);
            splats.logit_opacities.push(20.0);
            splats.sh.push([0.0; 3]);
        }
        splats
    }

    #[test]
    fn one_layer_grows_and_many_do_not() {
        let control = Control::default();
        let area = |layers: usize, depth: f64, most: f64| {
            let mut splats = wall(9, layers);
            let needed = vec![2.5; splats.len()];
            close(&mut splats, &needed, depth, most, &control).unwrap();
            assert!(splats.scales.iter().all(|s| s[2] == 0.001));
            let middle = splats.scales[40];
            f64::from(middle[0] * middle[1]) / 0.25
        };
        // Four neighbours at e^-2 and four at e^-4: a depth of 0.99 · (1 + 4 e^-2 + 4 e^-4) = 1.6.
        assert!((area(1, 3.0, 9.0) - 3.0 / 1.598).abs() < 0.01);
        assert!((area(1, 9.0, 9.0) - 2.5).abs() < 1e-5);
        assert!((area(4, 3.0, 9.0) - LEAST_GROWTH).abs() < 1e-5);
        assert!((area(4, f64::INFINITY, 2.0) - 2.0).abs() < 1e-5);
        assert!((area(1, 3.0, 1.0) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn points_and_lines_stay_finite() {
        let mut splats = wall(3, 1);
        splats.means = vec![[0.0; 3]; 9];
        splats.scales[0] = [0.0; 3];
        splats.scales[1] = [1.0, 0.0, 0.0];
        let depths = optical_depths(&splats, |_| true, &Control::default()).unwrap();
        assert!(depths.iter().all(|d| d.is_finite() && *d >= 0.98));
    }
}
