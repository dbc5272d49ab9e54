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
    use crate::simplify::pool;

    /// Support as far as INRIA's renderer draws.
    const SUPPORT: f64 = 3.0;

    fn disc_at(mean: [f64; 3], quat: [f64; 4]) -> Gaussian {
        Gaussian {
            mean,
            rotation: crate::linalg::rotation_from_quat(quat),
            scales: [1.0, 1.0, 0.01],
        }
    }

    fn covered(members: &[Gaussian]) -> f64 {
        let parts: Vec<_> = members
            .iter()
            .map(|g| (footprint(g.scales), g.mean, g.covariance()))
            .collect();
        let (mean, cov) = pool(&parts);
        coverage(members, &Gaussian::from_moments(mean, &cov), SUPPORT)
    }

    const FLAT: [f64; 4] = [1.0, 0.0, 0.0, 0.0];

    /// `side`² discs, `step` apart, at height `z`.
    fn floor(side: usize, step: f64, z: f64) -> Vec<Gaussian> {
        let at = |i: usize| step * i as f64;
        (0..side * side)
            .map(|i| disc_at([at(i % side), at(i / side), z], FLAT))
            .collect()
    }

    #[test]
    fn a_flat_floor_is_covered_however_its_discs_overlap() {
        for step in [0.0, 0.3, 1.0, 2.0, 4.0] {
            let got = covered(&floor(4, step, 0.0));
            assert!(got > 0.9, "{step}: {got}");
        }
        let row: Vec<_> = (0..10)
            .map(|i| disc_at([f64::from(i), 0.0, 0.0], FLAT))
            .collect();
        assert!(covered(&row) > 0.9);
    }

    #[test]
    fn two_parallel_sheets_are_not_however_far_apart() {
        // Supports part at 2 · 3 · 0.01.
        for gap in [0.07, 0.1, 0.5, 1.0, 1.9, 3.0, 10.0, 100.0] {
            for side in [1, 2, 3, 5] {
                let members = [floor(side, 1.0, 0.0), floor(side, 1.0, gap)].concat();
                let got = covered(&members);
                assert!(got < 0.6, "{side}² discs, {gap}: {got}");
            }
        }
        let touching = [floor(3, 1.0, 0.0), floor(3, 1.0, 0.05)].concat();
        assert!(covered(&touching) > 0.9);
    }

    #[test]
    fn a_rough_floor_is_one_surface_when_its_discs_are_as_thick_as_it_is_rough() {
        let mut members = floor(4, 1.0, 0.0);
        let heights = [0.02, -0.02, 0.01, -0.015, 0.0];
        for (i, g) in members.iter_mut().enumerate() {
            g.mean[2] = heights[i % 5];
        }
        assert!(covered(&members) > 0.9);
        members
            .iter_mut()
            .for_each(|g| g.mean[2] *= 100.0 * if g.mean[2] > 0.0 { 1.0 } else { 3.0 });
        assert!(covered(&members) < 0.6);
    }

    #[test]
    fn what_leans_is_foreshortened_and_a_ball_has_no_lean() {
        let turned = |angle: f64| [(angle / 2.0).cos(), (angle / 2.0).sin(), 0.0, 0.0];
        let mut members = vec![disc_at([0.0; 3], FLAT); 4];
        members.push(disc_at([0.0; 3], turned(1.2)));
        // Four discs stick out by a tenth of a narrower ellipse; of the fifth cos 1.2 counts.
        let got = covered(&members);
        assert!((0.75..0.88).contains(&got), "{got}");
        let ball = |q| Gaussian {
            scales: [1.0; 3],
            ..disc_at([0.0; 3], q)
        };
        assert_eq!(covered(&[ball(FLAT), ball(turned(1.5))]), 1.0);
    }

    #[test]
    fn a_single_member_far_off_the_plane_is_uncovered() {
        let mut members = vec![disc_at([0.0; 3], FLAT); 20];
        members.push(disc_at([0.0, 0.0, 0.9], FLAT));
        // The other twenty lie 0.9/21 off the plane.
        assert_eq!(covered(&members), 0.0);
        members[20].mean[2] = 0.3;
        let got = covered(&members);
        assert!((got - 20.0 / 21.0).abs() < 1e-6, "{got}");
    }

    #[test]
    fn without_area_nothing_is_uncovered() {
        let mut g = disc_at([0.0; 3], FLAT);
        g.scales = [1.0, 0.0, 0.0];
        assert_eq!(coverage(&[g], &g, SUPPORT), 1.0);
    }
}
