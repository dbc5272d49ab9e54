//! What merging two Gaussians costs in the image: the squared error of their projections, averaged over
//! directions, in f32 and in lanes.
//!
//! Six axes of an icosahedron stand for all directions. Along a unit axis d a Gaussian of covariance S
//! projects to one of area A_d = √(dᵀ adj(S) d), and two of them overlap by
//! ⟨a, b⟩_d = 2π A_d(a) A_d(b) / √D · exp(−q/2), D = dᵀ adj(S_a + S_b) d, q = (d×δ)ᵀ(S_a + S_b)(d×δ) / D.

use std::f32::consts::PI;

/// Six axes in eight lanes; the last two repeat and weigh nothing.
const LANES: usize = 8;
pub type Lanes = [f32; LANES];

const USED: f32 = 6.0;

/// Unit vectors through the vertices of an icosahedron, one of each opposite pair, by coordinate.
const AXES: [Lanes; 3] = {
    const A: f32 = 0.525_731_1; // 1 / √(1 + φ²)
    const B: f32 = 0.850_650_8; // φ / √(1 + φ²)
    [
        [0.0, 0.0, A, -A, B, B, 0.0, 0.0],
        [A, -A, B, B, 0.0, 0.0, A, A],
        [B, B, 0.0, 0.0, A, -A, B, B],
    ]
};

/// A symmetric 3×3 matrix: xx, xy, xz, yy, yz, zz.
pub type Sym = [f32; 6];

/// One cluster, in units of the scene's typical size.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Node {
    pub mean: [f32; 3],
    /// Without the dilation.
    pub cov: Sym,
    /// e²: the variance a renderer adds, (0.4 pixel)².
    pub blur: f32,
    pub alpha: f32,
    /// Σ α·A, A with the dilation: light stopped, as rendered.
    pub mass: f32,
    /// Σ αT over the views, or its estimate.
    pub visibility: f32,
    /// A_d.
    pub areas: Lanes,
}

/// α never exceeds it: renderers clip there.
pub const MAX_ALPHA: f32 = 0.99;

/// Renderers draw nothing fainter.
const MIN_ALPHA: f32 = 1.0 / 255.0;

#[inline(always)]
fn adjugate(s: &Sym) -> Sym {
    let [xx, xy, xz, yy, yz, zz] = *s;
    [
        yy * zz - yz * yz,
        xz * yz - xy * zz,
        xy * yz - xz * yy,
        xx * zz - xz * xz,
        xy * xz - xx * yz,
        xx * yy - xy * xy,
    ]
}

/// vᵀ S v in every lane.
#[inline(always)]
fn quadratic(s: &Sym, v: &[Lanes; 3]) -> Lanes {
    let mut out = [0.0; LANES];
    for l in 0..LANES {
        let (x, y, z) = (v[0][l], v[1][l], v[2][l]);
        out[l] = x * (s[0] * x + 2.0 * (s[1] * y + s[2] * z))
            + y * (s[3] * y + 2.0 * s[4] * z)
            + s[5] * z * z;
    }
    out
}

#[inline(always)]
fn dilated(s: &Sym, blur: f32) -> Sym {
    [s[0] + blur, s[1], s[2], s[3] + blur, s[4], s[5] + blur]
}

#[inline(always)]
fn areas(s: &Sym) -> Lanes {
    let mut out = quadratic(&adjugate(s), &AXES);
    for v in &mut out {
        *v = v.max(f32::MIN_POSITIVE).sqrt();
    }
    out
}

/// √tr adj(S): the rendered area, √3 times its mean square over all directions.
#[inline(always)]
fn area(s: &Sym) -> f32 {
    let a = adjugate(s);
    (a[0] + a[3] + a[5]).max(f32::MIN_POSITIVE).sqrt()
}

/// exp(x) for x ≤ 0, relative error 4e-7; 0 below −87.
#[inline(always)]
fn exp_negative(x: Lanes) -> Lanes {
    let mut out = [0.0; LANES];
    for l in 0..LANES {
        let t = x[l].max(-87.0) * std::f32::consts::LOG2_E;
        // Adding 1.5·2²³ rounds to the nearest integer in any rounding hardware.
        let n = (t + 12_582_912.0) - 12_582_912.0;
        let f = (t - n) * std::f32::consts::LN_2;
        let p =
            1.0 + f * (1.0 + f * (0.5 + f * (1.0 / 6.0 + f * (1.0 / 24.0 + f * (1.0 / 120.0)))));
        out[l] = p * f32::from_bits(((n as i32 + 127) << 23) as u32);
    }
    out
}

/// ⟨a, b⟩_d / 2π in every lane.
#[inline(always)]
fn overlap(a: &Sym, a_areas: &Lanes, b: &Sym, b_areas: &Lanes, delta: [f32; 3]) -> Lanes {
    let sum = [
        a[0] + b[0],
        a[1] + b[1],
        a[2] + b[2],
        a[3] + b[3],
        a[4] + b[4],
        a[5] + b[5],
    ];
    let d = quadratic(&adjugate(&sum), &AXES);
    let mut cross = [[0.0; LANES]; 3];
    for l in 0..LANES {
        cross[0][l] = AXES[1][l] * delta[2] - AXES[2][l] * delta[1];
        cross[1][l] = AXES[2][l] * delta[0] - AXES[0][l] * delta[2];
        cross[2][l] = AXES[0][l] * delta[1] - AXES[1][l] * delta[0];
    }
    let q = quadratic(&sum, &cross);
    let mut exponent = [0.0; LANES];
    let mut out = [0.0; LANES];
    for l in 0..LANES {
        let d = d[l].max(f32::MIN_POSITIVE);
        exponent[l] = -0.5 * q[l] / d;
        out[l] = a_areas[l] * b_areas[l] / d.sqrt();
    }
    let fall = exp_negative(exponent);
    for l in 0..LANES {
        out[l] *= fall[l];
    }
    out
}

impl Node {
    /// Completes a node whose mean, covariance, dilation and α are set: areas and mass.
    pub fn weighed(mut self) -> Self {
        let s = dilated(&self.cov, self.blur);
        self.areas = areas(&s);
        self.mass = self.alpha * area(&s);
        self
    }

    /// The other's share of the mass of the two.
    #[inline(always)]
    pub fn share(&self, other: &Self) -> f32 {
        let mass = self.mass + other.mass;
        if mass > 0.0 { other.mass / mass } else { 0.5 }
    }

    /// The two as one: mean and covariance averaged by mass, mass and visibility summed.
    #[inline(always)]
    pub fn merged(&self, other: &Self) -> Self {
        let mass = self.mass + other.mass;
        let w = self.share(other);
        let v = 1.0 - w;
        let delta = [0, 1, 2].map(|k| other.mean[k] - self.mean[k]);
        let [x, y, z] = delta;
        let spread = [x * x, x * y, x * z, y * y, y * z, z * z];
        let mut cov = [0.0; 6];
        for k in 0..6 {
            cov[k] = v * self.cov[k] + w * other.cov[k] + v * w * spread[k];
        }
        let blur = self.blur.min(other.blur);
        let s = dilated(&cov, blur);
        Self {
            mean: [0, 1, 2].map(|k| self.mean[k] + w * delta[k]),
            cov,
            blur,
            alpha: (mass / area(&s)).min(MAX_ALPHA),
            mass,
            visibility: self.visibility + other.visibility,
            areas: areas(&s),
        }
    }

    /// (λ·E_geo + |Δ|²·E_col)·(C_i + C_j)/(m_i + m_j); `color` is |Δ|², the squared difference of the two
    /// colours averaged over directions.
    #[inline(always)]
    pub fn cost(&self, other: &Self, color: f32, geometric: f32) -> f32 {
        self.cost_as(other, &self.merged(other), color, geometric)
    }

    /// The same where `m` is known to be the two merged.
    #[inline(always)]
    pub fn cost_as(&self, other: &Self, m: &Self, color: f32, geometric: f32) -> f32 {
        let (a, b, s) = (
            dilated(&self.cov, self.blur),
            dilated(&other.cov, other.blur),
            dilated(&m.cov, m.blur),
        );
        let to = |n: &Self| [0, 1, 2].map(|k| n.mean[k] - m.mean[k]);
        let between = [0, 1, 2].map(|k| other.mean[k] - self.mean[k]);
        let ab = overlap(&a, &self.areas, &b, &other.areas, between);
        let am = overlap(&a, &self.areas, &s, &m.areas, to(self));
        let bm = overlap(&b, &other.areas, &s, &m.areas, to(other));
        let share = if m.mass > 0.0 {
            other.mass / m.mass
        } else {
            0.5
        };
        let (p, q, r) = (self.alpha, other.alpha, m.alpha);
        if r < MIN_ALPHA && p.max(q) >= MIN_ALPHA {
            return f32::MAX; // spread so thin that it is no longer drawn, its light would be lost
        }
        let (u, v) = (share * p, (1.0 - share) * q);
        let (mut geo, mut col) = (0.0, 0.0);
        for l in 0..USED as usize {
            let own = p * p * self.areas[l] + q * q * other.areas[l] + r * r * m.areas[l];
            geo += own + 4.0 * (p * q * ab[l] - r * (p * am[l] + q * bm[l]));
            col += u * u * self.areas[l] + v * v * other.areas[l] - 4.0 * u * v * ab[l];
        }
        let error = geometric * geo.max(0.0) + color * col.max(0.0);
        let cost = error * (PI / USED) * m.visibility / m.mass.max(f32::MIN_POSITIVE);
        if cost < f32::MAX { cost } else { f32::MAX }
    }
}

/// |Δ|²: Σ over coefficients and channels of Δ²/4π.
#[inline(always)]
pub fn color_distance(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; LANES];
    let (a8, a_rest) = a.as_chunks::<LANES>();
    let (b8, b_rest) = b.as_chunks::<LANES>();
    for (x, y) in a8.iter().zip(b8) {
        for l in 0..LANES {
            lanes[l] += (x[l] - y[l]) * (x[l] - y[l]);
        }
    }
    let rest: f32 = a_rest
        .iter()
        .zip(b_rest)
        .map(|(x, y)| (x - y) * (x - y))
        .sum();
    (lanes.iter().sum::<f32>() + rest) / (4.0 * PI)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linalg::{Sym3, covariance, dot, rotation_from_quat};
    use crate::random::Lcg;

    type Flat = ([f64; 2], [f64; 3]);

    /// Mean and 2×2 covariance (xx, xy, yy) in the plane across `d`.
    fn projected(mean: [f64; 3], s: &Sym3, d: [f64; 3]) -> Flat {
        let helper = if d[0].abs() < 0.9 {
            [1.0, 0.0, 0.0]
        } else {
            [0.0, 1.0, 0.0]
        };
        let cross = |a: [f64; 3], b: [f64; 3]| {
            [
                a[1] * b[2] - a[2] * b[1],
                a[2] * b[0] - a[0] * b[2],
                a[0] * b[1] - a[1] * b[0],
            ]
        };
        let u = cross(d, helper);
        let u = u.map(|v| v / dot(u, u).sqrt());
        let v = cross(d, u);
        let row = |a: [f64; 3]| {
            [
                s[0] * a[0] + s[1] * a[1] + s[2] * a[2],
                s[1] * a[0] + s[3] * a[1] + s[4] * a[2],
                s[2] * a[0] + s[4] * a[1] + s[5] * a[2],
            ]
        };
        (
            [dot(u, mean), dot(v, mean)],
            [dot(u, row(u)), dot(u, row(v)), dot(v, row(v))],
        )
    }

    /// ∫ G_a G_b over the plane.
    fn product(a: &Flat, b: &Flat) -> f64 {
        let det = |c: [f64; 3]| c[0] * c[2] - c[1] * c[1];
        let c = [0, 1, 2].map(|k| a.1[k] + b.1[k]);
        let (x, y) = (a.0[0] - b.0[0], a.0[1] - b.0[1]);
        let q = (c[2] * x * x - 2.0 * c[1] * x * y + c[0] * y * y) / det(c);
        2.0 * std::f64::consts::PI * (det(a.1) * det(b.1) / det(c)).sqrt() * (-0.5 * q).exp()
    }

    fn naive(a: &Node, b: &Node, color: f64, geometric: f64) -> f64 {
        let m = a.merged(b);
        let mut error = 0.0;
        for l in 0..6 {
            let d = [0, 1, 2].map(|k| f64::from(AXES[k][l]));
            let flat = |n: &Node| {
                projected(
                    n.mean.map(f64::from),
                    &dilated(&n.cov, n.blur).map(f64::from),
                    d,
                )
            };
            let all = [(a, flat(a)), (b, flat(b)), (&m, flat(&m))];
            let squared = |w: [f64; 3]| -> f64 {
                (0..9)
                    .map(|k| {
                        let ((p, x), (q, y)) = (&all[k / 3], &all[k % 3]);
                        w[k / 3]
                            * w[k % 3]
                            * f64::from(p.alpha)
                            * f64::from(q.alpha)
                            * product(x, y)
                    })
                    .sum()
            };
            let share = f64::from(b.mass / m.mass);
            error +=
                geometric * squared([1.0, 1.0, -1.0]) + color * squared([share, share - 1.0, 0.0]);
        }
        error / 6.0 * f64::from(m.visibility / m.mass)
    }

    #[test]
    fn equals_the_projected_squared_error_in_f64() {
        let mut random = Lcg(11);
        let mut next = || random.centred();
        let mut node = || {
            let r = rotation_from_quat([next(), next(), next(), next()]);
            let scales = [0, 1, 2].map(|_| (3.0 * next()).exp());
            let mut n = Node {
                mean: [0, 1, 2].map(|_| (2.0 * next()) as f32),
                cov: covariance(&r, scales).map(|v| v as f32),
                blur: 0.1,
                alpha: (next() + 0.5) as f32,
                ..Node::default()
            }
            .weighed();
            n.visibility = 3.0 * n.mass;
            n
        };
        for _ in 0..300 {
            let (a, b) = (node(), node());
            for (color, geometric) in [(0.3, 0.0), (0.0, 1.0), (0.2, 0.03)] {
                let (got, want) = (
                    a.cost(&b, color, geometric),
                    naive(&a, &b, color.into(), geometric.into()),
                );
                let scale = f64::from(3.0 * (a.mass + b.mass));
                assert!(
                    (f64::from(got) - want).abs() <= 1e-4 * want + 1e-5 * scale,
                    "{got} {want}"
                );
            }
        }
    }

    #[test]
    fn identical_gaussians_cost_nothing_and_extremes_stay_finite() {
        let plain = Node {
            cov: [1.0, 0.0, 0.0, 1.0, 0.0, 0.01],
            blur: 0.1,
            alpha: 0.3,
            ..Node::default()
        };
        let mut a = plain.weighed();
        a.visibility = a.mass;
        assert!(a.cost(&a, 0.0, 1.0) < 0.2); // α adds up, shape stays
        let mut far = Node {
            mean: [1e15; 3],
            cov: [1e12, 0.0, 0.0, 1e12, 0.0, 1e12],
            ..plain
        }
        .weighed();
        far.visibility = far.mass;
        let cost = a.cost(&far, 1.0, 0.03);
        assert!(cost.is_finite() && cost >= 0.0);
    }

    #[test]
    fn color_distance_is_the_mean_over_directions() {
        let (a, b): (Vec<f32>, Vec<f32>) = (0..27).map(|i| (i as f32, i as f32 * 0.5)).unzip();
        let want: f32 = a
            .iter()
            .zip(&b)
            .map(|(x, y)| (x - y) * (x - y))
            .sum::<f32>()
            / (4.0 * PI);
        assert!((color_distance(&a, &b) - want).abs() < 1e-4 * want);
    }
}
