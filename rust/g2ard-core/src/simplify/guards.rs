//! The guard of coverage: how much of its members' footprints a merged Gaussian covers.

use std::f64::consts::PI;
use std::sync::OnceLock;

use glam::{DVec2, DVec3};

use super::moments::footprint;
use crate::linalg::Sym3;
use crate::scene::Gaussian;

const SAMPLES: usize = 16;

/// Points that divide the unit disc into equal areas (sunflower).
pub fn disc() -> &'static [[f64; 2]; SAMPLES] {
    static POINTS: OnceLock<[[f64; 2]; SAMPLES]> = OnceLock::new();
    POINTS.get_or_init(|| {
        let golden = PI * (3.0 - 5f64.sqrt());
        std::array::from_fn(|i| {
            let r = ((i as f64 + 0.5) / SAMPLES as f64).sqrt();
            let (sin, cos) = (i as f64 * golden).sin_cos();
            [r * cos, r * sin]
        })
    })
}

/// A footprint cast on a plane along its normal.
struct Shadow {
    /// Position of the mean.
    center: DVec2,
    /// L of LLᵀ, the covariance in the plane: rows (l₁₁, 0) and (l₂₁, l₂₂).
    factor: [DVec2; 2],
}

impl Shadow {
    /// The footprint on the plane with axes `x` and `y`; `offset` is the mean's from the plane's origin.
    fn of(g: &Gaussian, offset: DVec3, [x, y]: [DVec3; 2]) -> Self {
        // Σ^½ times each axis: their products are the covariance in the plane.
        let axes = [0, 1, 2].map(|k| DVec3::from(g.axis(k)));
        let root = |axis: DVec3| DVec3::from([0, 1, 2].map(|k| g.scales[k] * axis.dot(axes[k])));
        let (p, q) = (root(x), root(y));
        let first = p.length();
        let (mut second, mut along) = (0.0, 0.0);
        if first > 0.0 {
            second = p.dot(q) / first;
            along = second / first;
        }
        Self {
            center: DVec2::new(x.dot(offset), y.dot(offset)),
            factor: [
                DVec2::new(first, 0.0),
                DVec2::new(second, (q - p * along).length()),
            ],
        }
    }

    /// Area like A, the product of two scales: for a disc A·|n_i·n|.
    fn area(&self) -> f64 {
        self.factor[0].x * self.factor[1].y
    }
}

/// Share of the members' footprint area ΣA_i, A_i the product of the two longer scales, that the merged Gaussian covers. Footprints end `support` standard
/// deviations from the mean, as far as a renderer draws them.
///
/// Each member casts its footprint on the merged tangent plane, foreshortened by how far it leans; the part
/// inside the merged footprint is covered, unless the mean lies off the plane by more than `support` times the
/// members' own extent along the normal, √(nᵀWn) of W = ΣA_iΣ_i / ΣA_i. The merged extent would not do: it
/// grows with the gap between two sheets.
pub fn coverage(members: &[Gaussian], merged: &Gaussian, support: f64) -> f64 {
    let order = merged.axes_by_scale();
    let [x, y, normal] = order.map(|k| DVec3::from(merged.axis(k)));
    let (mut total, mut within) = (0.0, [0.0; 6]);
    for g in members {
        let (area, cov) = (footprint(g.scales), g.covariance());
        total += area;
        for k in 0..6 {
            within[k] += area * cov[k];
        }
    }
    if total <= 0.0 {
        return 1.0;
    }
    let reach = support * (along(&within, normal) / total).sqrt();
    let mut covered = 0.0;
    for g in members {
        let offset = DVec3::from(g.mean) - DVec3::from(merged.mean);
        if normal.dot(offset).abs() > reach {
            continue;
        }
        let shadow = Shadow::of(g, offset, [x, y]);
        // In units of the merged footprint's half axes.
        let scales = [0, 1].map(|t| merged.scales[order[t]]);
        let center = shadow.center / (support * DVec2::from(scales));
        let [first, second] = [0, 1].map(|t| shadow.factor[t] / scales[t]);
        let hits = disc().iter().filter(|[x, y]| {
            let u = center.x + x * first.x + y * first.y;
            let v = center.y + x * second.x + y * second.y;
            u * u + v * v <= 1.0
        });
        covered += shadow.area() * hits.count() as f64 / SAMPLES as f64;
    }
    covered / total
}

/// nᵀΣn, not below 0.
fn along(cov: &Sym3, n: DVec3) -> f64 {
    let [xx, xy, xz, yy, yz, zz] = *cov;
    let rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    n.dot(rows.map(|row| DVec3::from(row).dot(n)).into())
        .max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_points_part_the_disc_evenly() {
        let points = disc();
        let mean =
            |f: fn(f64, f64) -> f64| points.iter().map(|p| f(p[0], p[1])).sum::<f64>() / 16.0;
        assert!(mean(|x, _| x).abs() < 0.05 && mean(|_, y| y).abs() < 0.05);
        assert!(
            (mean(|x, _| x * x) - 0.25).abs() < 0.03 && (mean(|_, y| y * y) - 0.25).abs() < 0.03
        );
        for (i, a) in points.iter().enumerate() {
            let gap = |b: &[f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
            assert!(points[..i].iter().all(|b| gap(b) > 0.3), "{i}");
        }
    }

    #[test]
    fn without_area_nothing_is_uncovered() {
        let needle = Gaussian {
            mean: [0.0; 3],
            rotation: crate::linalg::rotation_from_quat([1.0, 0.0, 0.0, 0.0]),
            scales: [1.0, 0.0, 0.0],
        };
        assert_eq!(coverage(&[needle], &needle, 3.0), 1.0);
    }
}
