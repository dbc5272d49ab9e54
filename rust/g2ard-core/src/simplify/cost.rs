//! Cost of merging two Gaussians in the image: the squared error of their projections, averaged over
//! directions, for one pair or for sixteen.
//!
//! Six axes of an icosahedron stand for all directions. Along a unit axis d a Gaussian of covariance S
//! projects to one of area A_d = √(dᵀ adj(S) d), and two of them overlap by
//! ⟨a, b⟩_d = 2π A_d(a) A_d(b) / √D · exp(−q/2), D = dᵀ adj(S_a + S_b) d, q = (d×δ)ᵀ(S_a + S_b)(d×δ) / D.
//!
//! To that error of values the cost adds the one of gradients. Its weight μ is an area, so that edges as fine as √μ
//! count twice and plain areas once: ⟨a, b⟩ + μ⟨∇a, ∇b⟩ = ⟨a, b⟩·(1 + μ·(tr T⁻¹ − δᵀT⁻²δ)), T the projected S_a + S_b.

use std::f32::consts::PI;

use crate::raster::simd::{Real, exp_negative};
use crate::scene::limits::MAX_OPACITY;

/// Six axes in eight lanes, to fill a register; the last two are repeated with weight zero.
const PLACES: usize = 8;
const USED: usize = 6;

/// Unit vectors through the vertices of an icosahedron, one of each opposite pair, by coordinate.
const AXES: [[f32; PLACES]; 3] = {
    const A: f32 = 0.525_731_1; // 1 / √(1 + φ²)
    const B: f32 = 0.850_650_8; // φ / √(1 + φ²)
    [
        [0.0, 0.0, A, -A, B, B, 0.0, 0.0],
        [A, -A, B, B, 0.0, 0.0, A, A],
        [B, B, 0.0, 0.0, A, -A, B, B],
    ]
};

/// A symmetric 3×3 matrix: xx, xy, xz, yy, yz, zz.
pub type Sym<T = f32> = [T; 6];

/// One cluster, in units of the scene's typical size; sixteen clusters if `T` has lanes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Node<T = f32> {
    pub mean: [T; 3],
    /// Without the dilation.
    pub cov: Sym<T>,
    /// e²: the variance a renderer adds, (0.4 pixel)².
    pub blur: T,
    pub alpha: T,
    /// Σ α·A, A with the dilation: light stopped, as rendered.
    pub mass: T,
    /// Σ αT² over the views, or its estimate.
    pub visibility: T,
    /// A_d.
    pub areas: [T; PLACES],
}

/// Weights of the parts of a cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weights<T = f32> {
    /// λ: of the geometric error beside that of colour.
    pub geometric: T,
    /// μ / e²: of the error of gradients, over the variance that a renderer adds.
    pub edge: T,
}

impl Weights {
    /// The same in every lane.
    #[inline(always)]
    pub fn splat<T: Real>(&self) -> Weights<T> {
        Weights {
            geometric: T::splat(self.geometric),
            edge: T::splat(self.edge),
        }
    }
}

/// α never exceeds it: renderers clip there.
pub const MAX_ALPHA: f32 = MAX_OPACITY as f32;

/// Renderers skip fainter contributions.
const MIN_ALPHA: f32 = 1.0 / 255.0;

#[inline(always)]
fn adjugate<T: Real>(s: &Sym<T>) -> Sym<T> {
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

/// vᵀ S v.
#[inline(always)]
fn quadratic<T: Real>(s: &Sym<T>, [x, y, z]: [T; 3]) -> T {
    let two = T::splat(2.0);
    x * (s[0] * x + two * (s[1] * y + s[2] * z)) + y * (s[3] * y + two * s[4] * z) + s[5] * z * z
}

/// S v.
#[inline(always)]
fn times<T: Real>(s: &Sym<T>, [x, y, z]: [T; 3]) -> [T; 3] {
    [
        s[0] * x + s[1] * y + s[2] * z,
        s[1] * x + s[3] * y + s[4] * z,
        s[2] * x + s[4] * y + s[5] * z,
    ]
}

#[inline(always)]
fn inner<T: Real>(a: [T; 3], b: [T; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The trace of S projected along a unit vector.
#[inline(always)]
fn across<T: Real>(s: &Sym<T>, v: [T; 3]) -> T {
    s[0] + s[3] + s[5] - quadratic(s, v)
}

#[inline(always)]
fn axis<T: Real>(l: usize) -> [T; 3] {
    [
        T::splat(AXES[0][l]),
        T::splat(AXES[1][l]),
        T::splat(AXES[2][l]),
    ]
}

#[inline(always)]
fn dilated<T: Real>(s: &Sym<T>, blur: T) -> Sym<T> {
    [s[0] + blur, s[1], s[2], s[3] + blur, s[4], s[5] + blur]
}

#[inline(always)]
fn areas<T: Real>(s: &Sym<T>) -> [T; PLACES] {
    let adjugate = adjugate(s);
    let mut out = [T::splat(0.0); PLACES];
    for l in 0..PLACES {
        let squared = quadratic(&adjugate, axis(l));
        out[l] = squared.max(T::splat(f32::MIN_POSITIVE)).sqrt();
    }
    out
}

/// √tr adj(S): the rendered area, √3 times its mean square over all directions.
#[inline(always)]
fn area<T: Real>(s: &Sym<T>) -> T {
    let a = adjugate(s);
    (a[0] + a[3] + a[5]).max(T::splat(f32::MIN_POSITIVE)).sqrt()
}

/// (⟨a, b⟩_d + μ⟨∇a, ∇b⟩_d) / 2π for every axis.
#[inline(always)]
fn overlap<T: Real>(
    a: &Sym<T>,
    a_areas: &[T; PLACES],
    b: &Sym<T>,
    b_areas: &[T; PLACES],
    delta: [T; 3],
    mu: T,
) -> [T; PLACES] {
    let mut sum = *a;
    for k in 0..6 {
        sum[k] = a[k] + b[k];
    }
    let adjugate = adjugate(&sum);
    let one = T::splat(1.0);
    let mut out = [T::splat(0.0); PLACES];
    for l in 0..PLACES {
        let v: [T; 3] = axis(l);
        let cross = [
            v[1] * delta[2] - v[2] * delta[1],
            v[2] * delta[0] - v[0] * delta[2],
            v[0] * delta[1] - v[1] * delta[0],
        ];
        let turned = times(&sum, cross);
        let d = quadratic(&adjugate, v).max(T::splat(f32::MIN_POSITIVE));
        let q = inner(cross, turned) / d;
        // T⁻¹δ is the part of `turned` across the axis, turned back, over d.
        let along = inner(v, turned);
        let slope = (across(&sum, v) - (inner(turned, turned) - along * along) / d) / d;
        let value = a_areas[l] * b_areas[l] / d.sqrt() * exp_negative(T::splat(-0.5) * q);
        out[l] = value * (one + mu * slope);
    }
    out
}

#[inline(always)]
fn difference<T: Real>(a: &[T; 3], b: &[T; 3]) -> [T; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

impl Node {
    /// Completes a node whose mean, covariance, dilation and α are set: areas and mass.
    #[cfg(test)]
    pub fn weighed(mut self) -> Self {
        (self.areas, self.mass) = (self.areas_of(), self.mass_of());
        self
    }

    /// The areas of a node whose covariance and dilation are set.
    pub fn areas_of(&self) -> [f32; PLACES] {
        areas(&dilated(&self.cov, self.blur))
    }

    /// The mass of a node whose covariance, dilation and α are set.
    pub fn mass_of(&self) -> f32 {
        self.alpha * area(&dilated(&self.cov, self.blur))
    }
}

impl<T: Real> Node<T> {
    /// The other's share of the mass of the two.
    #[inline(always)]
    pub fn share(&self, other: &Self) -> T {
        let mass = self.mass + other.mass;
        T::select(mass.gt(T::splat(0.0)), other.mass / mass, T::splat(0.5))
    }

    /// The two as one: mean and covariance averaged by mass, mass and visibility summed.
    #[inline(always)]
    pub fn merged(&self, other: &Self) -> Self {
        let mass = self.mass + other.mass;
        let w = self.share(other);
        let v = T::splat(1.0) - w;
        let [x, y, z] = difference(&other.mean, &self.mean);
        let spread = [x * x, x * y, x * z, y * y, y * z, z * z];
        let mut cov = self.cov;
        for k in 0..6 {
            cov[k] = v * self.cov[k] + w * other.cov[k] + v * w * spread[k];
        }
        let blur = self.blur.min(other.blur);
        let s = dilated(&cov, blur);
        Self {
            mean: [
                self.mean[0] + w * x,
                self.mean[1] + w * y,
                self.mean[2] + w * z,
            ],
            cov,
            blur,
            alpha: (mass / area(&s)).min(T::splat(MAX_ALPHA)),
            mass,
            visibility: self.visibility + other.visibility,
            areas: areas(&s),
        }
    }

    /// (λ·E_geo + |Δ|²·E_col)·(C_i + C_j)/(m_i + m_j); `color` is |Δ|², the squared difference of the two
    /// colours averaged over directions.
    #[inline(always)]
    pub fn cost(&self, other: &Self, color: T, weights: Weights<T>) -> T {
        self.cost_as(other, &self.merged(other), color, weights)
    }

    /// The same where `m` is known to be the two merged.
    #[inline(always)]
    pub fn cost_as(&self, other: &Self, m: &Self, color: T, weights: Weights<T>) -> T {
        let (a, b, s) = (
            dilated(&self.cov, self.blur),
            dilated(&other.cov, other.blur),
            dilated(&m.cov, m.blur),
        );
        let between = difference(&other.mean, &self.mean);
        let (to_a, to_b) = (
            difference(&self.mean, &m.mean),
            difference(&other.mean, &m.mean),
        );
        let mu = weights.edge * m.blur;
        let ab = overlap(&a, &self.areas, &b, &other.areas, between, mu);
        let am = overlap(&a, &self.areas, &s, &m.areas, to_a, mu);
        let bm = overlap(&b, &other.areas, &s, &m.areas, to_b, mu);
        let norm =
            |s: &Sym<T>, area: T, l: usize| area + mu * T::splat(0.5) * across(s, axis(l)) / area;
        let (zero, four, most) = (T::splat(0.0), T::splat(4.0), T::splat(f32::MAX));
        let share = T::select(m.mass.gt(zero), other.mass / m.mass, T::splat(0.5));
        let (p, q, r) = (self.alpha, other.alpha, m.alpha);
        let (u, v) = (share * p, (T::splat(1.0) - share) * q);
        let (mut geo, mut col) = (zero, zero);
        for l in 0..USED {
            let aa = norm(&a, self.areas[l], l);
            let bb = norm(&b, other.areas[l], l);
            let own = p * p * aa + q * q * bb + r * r * norm(&s, m.areas[l], l);
            geo = geo + (own + four * (p * q * ab[l] - r * (p * am[l] + q * bm[l])));
            col = col + (u * u * aa + v * v * bb - four * u * v * ab[l]);
        }
        let error = weights.geometric * geo.max(zero) + color * col.max(zero);
        let mass = m.mass.max(T::splat(f32::MIN_POSITIVE));
        let cost = error * T::splat(PI / USED as f32) * m.visibility / mass;
        // Spread so thin that it is no longer drawn, their light would be lost.
        let drawn = T::splat(MIN_ALPHA);
        let fades = T::select(drawn.gt(r), p.max(q), zero).ge(drawn);
        T::select(fades, most, cost.min(most))
    }
}

/// |Δ|²: Σ over coefficients and channels of Δ²/4π.
#[inline(always)]
pub fn color_distance(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; PLACES];
    let (a8, a_rest) = a.as_chunks::<PLACES>();
    let (b8, b_rest) = b.as_chunks::<PLACES>();
    for (x, y) in a8.iter().zip(b8) {
        for l in 0..PLACES {
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

    const WEIGHTS: Weights = Weights {
        geometric: 0.03,
        edge: 3.0,
    };

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

    /// ∫ G_a G_b + μ ∇G_a·∇G_b over the plane.
    fn product(a: &Flat, b: &Flat, mu: f64) -> f64 {
        let det = |c: [f64; 3]| c[0] * c[2] - c[1] * c[1];
        let c = [0, 1, 2].map(|k| a.1[k] + b.1[k]);
        let (x, y) = (a.0[0] - b.0[0], a.0[1] - b.0[1]);
        let q = (c[2] * x * x - 2.0 * c[1] * x * y + c[0] * y * y) / det(c);
        let value =
            2.0 * std::f64::consts::PI * (det(a.1) * det(b.1) / det(c)).sqrt() * (-0.5 * q).exp();
        let solved = [
            (c[2] * x - c[1] * y) / det(c),
            (c[0] * y - c[1] * x) / det(c),
        ];
        let slope = (c[0] + c[2]) / det(c) - solved[0] * solved[0] - solved[1] * solved[1];
        value * (1.0 + mu * slope)
    }

    #[test]
    fn the_closed_form_is_the_integral_of_values_and_gradients() {
        let a: Flat = ([0.3, -0.2], [1.0, 0.4, 0.7]);
        let b: Flat = ([-0.5, 0.6], [0.5, -0.2, 1.3]);
        // G and ∇G.
        let sampled = |(mean, s): &Flat, x: f64, y: f64| {
            let det = s[0] * s[2] - s[1] * s[1];
            let (x, y) = (x - mean[0], y - mean[1]);
            let slope = [(s[2] * x - s[1] * y) / det, (s[0] * y - s[1] * x) / det];
            let value = (-0.5 * (x * slope[0] + y * slope[1])).exp();
            [value, -value * slope[0], -value * slope[1]]
        };
        let (step, mu) = (0.05, 0.7);
        let mut sum = 0.0;
        for i in -200..200 {
            for j in -200..200 {
                let (x, y) = (f64::from(i) * step, f64::from(j) * step);
                let (p, q) = (sampled(&a, x, y), sampled(&b, x, y));
                sum += (p[0] * q[0] + mu * (p[1] * q[1] + p[2] * q[2])) * step * step;
            }
        }
        let want = product(&a, &b, mu);
        assert!((sum - want).abs() < 1e-9 * want.abs(), "{sum} {want}");
        assert!((want - product(&a, &b, 0.0)).abs() > 0.01 * want.abs());
    }

    fn naive(a: &Node, b: &Node, color: f64, weights: Weights) -> f64 {
        let m = a.merged(b);
        let (geometric, edge) = (f64::from(weights.geometric), f64::from(weights.edge));
        let mu = edge * f64::from(m.blur);
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
                            * product(x, y, mu)
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
                blur: (0.15 + 0.2 * next()) as f32,
                alpha: (next() + 0.5) as f32,
                ..Node::default()
            }
            .weighed();
            n.visibility = 3.0 * n.mass;
            n
        };
        for _ in 0..300 {
            let (a, b) = (node(), node());
            for (color, geometric, edge) in [
                (0.3, 0.0, 0.0),
                (0.0, 1.0, 0.0),
                (0.2, 0.03, 0.0),
                (0.3, 0.0, 4.0),
                (0.0, 1.0, 4.0),
                (0.2, 0.03, 40.0),
            ] {
                let weights = Weights { geometric, edge };
                let got = a.cost(&b, color, weights);
                let want = naive(&a, &b, color.into(), weights);
                let scale = f64::from((3.0 + edge) * (a.mass + b.mass));
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
        let geometric_alone = Weights {
            geometric: 1.0,
            edge: 0.0,
        };
        assert!(a.cost(&a, 0.0, geometric_alone) < 0.2); // α adds up, shape stays
        let mut far = Node {
            mean: [1e15; 3],
            cov: [1e12, 0.0, 0.0, 1e12, 0.0, 1e12],
            ..plain
        }
        .weighed();
        far.visibility = far.mass;
        let cost = a.cost(&far, 1.0, WEIGHTS);
        assert!(cost.is_finite() && cost >= 0.0);
    }

    #[test]
    fn light_is_not_spread_too_thin_to_be_drawn() {
        let (mut kept, mut lost) = ([0; 2], [0; 2]);
        for (p, q) in [
            (0.5, 0.5),
            (0.02, 0.001),
            (0.001, 0.02),
            (0.0035, 0.0035),
            (MIN_ALPHA, 0.001),
        ] {
            for step in 0..60 {
                let node = |x: f32, alpha: f32| {
                    let mut node = Node {
                        mean: [x, 0.0, 0.0],
                        cov: [1.0, 0.0, 0.0, 1.0, 0.0, 1.0],
                        blur: 0.1,
                        alpha,
                        ..Node::default()
                    }
                    .weighed();
                    node.visibility = node.mass;
                    node
                };
                let (a, b) = (node(0.0, p), node(1.3f32.powi(step) - 1.0, q));
                let shown = p.max(q) >= MIN_ALPHA;
                let fades = shown && a.merged(&b).alpha < MIN_ALPHA;
                let cost = a.cost(&b, 0.1, WEIGHTS);
                assert_eq!(cost == f32::MAX, fades, "{p} {q} {step}: {cost}");
                [&mut kept, &mut lost][usize::from(fades)][usize::from(shown)] += 1;
            }
        }
        assert!(
            kept[0] >= 60 && kept[1] > 30 && lost[1] > 30,
            "{kept:?} {lost:?}"
        );
    }

    #[test]
    fn of_two_pairs_of_one_shape_the_smaller_gains_weight_with_edges() {
        let pair = |size: f32| {
            let node = |x: f32| {
                let variance = size * size;
                let mut node = Node {
                    mean: [x * size, 0.0, 0.0],
                    cov: [variance, 0.0, 0.0, variance, 0.0, 0.01 * variance],
                    blur: 0.16,
                    alpha: 0.5,
                    ..Node::default()
                }
                .weighed();
                node.visibility = node.mass;
                node
            };
            (node(0.0), node(2.0))
        };
        let ratio = |edge: f32| {
            let weights = Weights {
                geometric: 0.03,
                edge,
            };
            let [small, large] = [pair(1.0), pair(10.0)].map(|(a, b)| a.cost(&b, 0.1, weights));
            small / large
        };
        assert!(
            ratio(3.0) > 1.2 * ratio(0.0),
            "{} {}",
            ratio(3.0),
            ratio(0.0)
        );
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
