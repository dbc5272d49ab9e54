//! Whether a merged Gaussian may stand in for its members.

use std::f64::consts::PI;
use std::sync::OnceLock;

use super::moments::Gaussian;
use crate::linalg::{dot, sub};

/// A footprint ends at one standard deviation. Two discs side by side then fail below 0.6 once their
/// centres are some four deviations apart; at two deviations the merged disc would span any gap.
const EDGE: f64 = 1.0;
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

/// Share of the members' footprint area that lies inside the merged footprint, in the merged tangent
/// plane. A member whose centre is farther off that plane than the merged normal extent covers nothing.
pub fn coverage(members: &[Gaussian], merged: &Gaussian) -> f64 {
    let [t1, t2, n] = merged.axes_by_scale();
    let (mut covered, mut total) = (0.0, 0.0);
    for g in members {
        let [a, b, _] = g.axes_by_scale();
        let area = g.scales[a] * g.scales[b];
        total += area;
        let offset = sub(g.mean, merged.mean);
        if dot(merged.axis(n), offset).abs() > EDGE * merged.scales[n] {
            continue;
        }
        // In units of the merged footprint's half axes.
        let inside = |t: usize| {
            let axis = merged.axis(t);
            let reach = EDGE * merged.scales[t];
            let along = |k: usize| EDGE * g.scales[k] * dot(axis, g.axis(k)) / reach;
            (dot(axis, offset) / reach, along(a), along(b))
        };
        let ((u0, ua, ub), (v0, va, vb)) = (inside(t1), inside(t2));
        let hits = disc().iter().filter(|[x, y]| {
            let (u, v) = (u0 + x * ua + y * ub, v0 + x * va + y * vb);
            u * u + v * v <= 1.0
        });
        covered += area * hits.count() as f64 / SAMPLES as f64;
    }
    if total > 0.0 { covered / total } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simplify::pool;

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
            .map(|g| (1.0, g.mean, g.covariance()))
            .collect();
        let (mean, cov) = pool(&parts);
        coverage(members, &Gaussian::from_moments(mean, &cov))
    }

    const FLAT: [f64; 4] = [1.0, 0.0, 0.0, 0.0];

    #[test]
    fn together_is_covered_apart_is_not() {
        assert_eq!(covered(&[disc_at([0.0; 3], FLAT)]), 1.0);
        assert!(covered(&[disc_at([0.0; 3], FLAT), disc_at([0.5, 0.0, 0.0], FLAT)]) > 0.8);
        let far = covered(&[disc_at([0.0; 3], FLAT), disc_at([50.0, 0.0, 0.0], FLAT)]);
        assert!(far < 0.6, "{far}");
    }

    #[test]
    fn a_single_member_far_off_the_plane_is_uncovered() {
        let mut members = vec![disc_at([0.0; 3], FLAT); 20];
        members.push(disc_at([0.0, 0.0, 0.9], FLAT));
        let got = covered(&members);
        assert!((got - 20.0 / 21.0).abs() < 1e-12, "{got}");
    }
}
