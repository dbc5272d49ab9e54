//! One step of direct alignment: weighted normal equations of ξ, gain and bias.

use rayon::prelude::*;

use super::{Size, dot, slope};
use crate::Result;

/// Residuals beyond this many standard deviations have no weight (Tukey): 95 % as efficient as least squares.
const TUKEY: f64 = 4.685;
/// Standard deviations of a normal distribution in its median absolute deviation.
const SIGMAS: f64 = 1.4826;
/// Smallest scale of the residuals: a quarter of an 8-bit step.
const LEAST_SCALE: f64 = 1e-3;
/// v, ω, zoom, gain and bias.
const UNKNOWNS: usize = 9;
/// v, ω and the logarithm of the focal length.
const MOTION: usize = 7;

/// A photo at one size: grey, blurred; its gradients; its mask.
#[derive(Debug, Clone, Copy)]
pub struct Photo<'a> {
    pub grey: &'a [f64],
    pub right: &'a [f64],
    pub down: &'a [f64],
    pub mask: &'a [bool],
}

/// A render as [`super::shot`] returns it.
#[derive(Debug, Clone, Copy)]
pub struct Render<'a> {
    pub grey: &'a [f64],
    pub depth: &'a [f64],
    pub mask: &'a [bool],
}

/// Pixels.
#[derive(Debug, Clone, Copy)]
pub struct Lens {
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
}

/// photo = gain·render + bias.
#[derive(Debug, Clone, Copy)]
pub struct Light {
    pub gain: f64,
    pub bias: f64,
}

/// H·δ = y of δ = (v, ω, Δlog f, Δgain, Δbias).
#[derive(Debug, Clone, PartialEq)]
pub struct Normal {
    pub matrix: [[f64; UNKNOWNS]; UNKNOWNS],
    pub right: [f64; UNKNOWNS],
    /// σ of the residuals, by their median absolute deviation.
    pub scale: f64,
    /// Mean of Tukey's ρ(r/σ) over the unmasked pixels, in [0, 1]; NaN without any.
    pub cost: f64,
    /// Σ w.
    pub weights: f64,
}

/// One row of unmasked pixels: the unknowns' derivatives, the residuals and their weights.
type Columns = [Vec<f64>; UNKNOWNS + 2];

/// Sums of one row of pixels.
struct Sums {
    products: [[f64; UNKNOWNS]; UNKNOWNS],
    right: [f64; UNKNOWNS],
    cost: f64,
    weights: f64,
}

/// ∇I·∂π/∂X·[I | −[X]ₓ], with x = X/Z, y = Y/Z and gradients times focal lengths p, q:
/// (p/Z, q/Z, −(px + qy)/Z, −pxy − q(1 + y²), p(1 + x²) + qxy, −py + qx), and px + qy for the focal length.
#[inline(always)]
fn motion(x: f64, y: f64, depth: f64, p: f64, q: f64) -> [f64; MOTION] {
    let along = p * x + q * y;
    [
        p / depth,
        q / depth,
        -along / depth,
        -along * y - q,
        along * x + p,
        q * x - p * y,
        along,
    ]
}

/// The normal equations at a pose, and their cost. `scale` is σ of the residuals, estimated from them by default.
pub fn normal_equations(
    photo: &Photo,
    shot: &Render,
    size: Size,
    lens: &Lens,
    light: Light,
    scale: Option<f64>,
) -> Result<Normal> {
    for (name, values) in [
        ("photo", photo.grey),
        ("photo's gradient", photo.right),
        ("photo's gradient", photo.down),
        ("shot", shot.grey),
        ("shot's depth", shot.depth),
    ] {
        size.check(name, values, 1)?;
    }
    size.check("photo's mask", photo.mask, 1)?;
    size.check("shot's mask", shot.mask, 1)?;
    let counts = |i: usize| photo.mask[i] && shot.mask[i];
    let residual = |i: usize| photo.grey[i] - light.gain * shot.grey[i] - light.bias;
    let counted = |y: usize| (y * size.width..(y + 1) * size.width).filter(|&i| counts(i));
    let rows = 0..size.height;
    let pixels = (0..size.pixels()).filter(|&i| counts(i)).count();
    let scale = scale.unwrap_or_else(|| {
        let residuals: Vec<f64> = rows
            .clone()
            .flat_map(|y| counted(y).map(residual))
            .collect();
        deviation(residuals).max(LEAST_SCALE)
    });
    refuse!(!(scale.is_finite() && scale > 0.0) => "scale", "a positive number", scale);
    let row = |columns: &mut Columns, y: usize| -> Sums {
        columns.iter_mut().for_each(Vec::clear);
        let mut cost = 0.0;
        let ray_y = (y as f64 + 0.5 - lens.cy) / lens.fy;
        for i in counted(y) {
            let x = i - y * size.width;
            let r = residual(i);
            let inlying = (1.0 - (r / (TUKEY * scale)).powi(2)).max(0.0);
            cost += 1.0 - inlying * inlying * inlying;
            let right = slope(shot.grey, i, x, size.width, 1);
            let down = slope(shot.grey, i, y, size.height, size.width);
            // the mean of both images' gradients; the render's grey at a pixel changes by −∇I·flow
            let p = -lens.fx * (light.gain * right + photo.right[i]) / 2.0;
            let q = -lens.fy * (light.gain * down + photo.down[i]) / 2.0;
            let ray_x = (x as f64 + 0.5 - lens.cx) / lens.fx;
            let of_motion = motion(ray_x, ray_y, shot.depth[i], p, q);
            let rest = [shot.grey[i], 1.0, r, inlying * inlying];
            let values = of_motion.into_iter().chain(rest);
            for (column, value) in columns.iter_mut().zip(values) {
                column.push(value);
            }
        }
        Sums::of(columns, cost)
    };
    let rows: Vec<Sums> = rows
        .into_par_iter()
        .map_init(|| std::array::from_fn(|_| Vec::new()), row)
        .collect();
    Ok(total(&rows, scale, pixels))
}

impl Sums {
    fn of(columns: &Columns, cost: f64) -> Self {
        let (unknowns, rest) = columns.split_at(UNKNOWNS);
        let (residuals, weights) = (&rest[0], &rest[1]);
        let mut out = Self {
            products: [[0.0; UNKNOWNS]; UNKNOWNS],
            right: [0.0; UNKNOWNS],
            cost,
            weights: weights.iter().sum(),
        };
        let mut weighted = vec![0.0; weights.len()];
        for (a, column) in unknowns.iter().enumerate() {
            for (out, (value, weight)) in weighted.iter_mut().zip(column.iter().zip(weights)) {
                *out = value * weight;
            }
            out.right[a] = dot(&weighted, residuals);
            for (b, other) in unknowns.iter().enumerate().skip(a) {
                out.products[a][b] = dot(&weighted, other);
            }
        }
        out
    }
}

/// Adds up rows in order, completes the symmetric matrix, and divides the cost by the number of `pixels`.
fn total(rows: &[Sums], scale: f64, pixels: usize) -> Normal {
    let mut out = Normal {
        matrix: [[0.0; UNKNOWNS]; UNKNOWNS],
        right: [0.0; UNKNOWNS],
        scale,
        cost: 0.0,
        weights: 0.0,
    };
    for row in rows {
        for a in 0..UNKNOWNS {
            out.right[a] += row.right[a];
            for b in a..UNKNOWNS {
                out.matrix[a][b] += row.products[a][b];
            }
        }
        out.cost += row.cost;
        out.weights += row.weights;
    }
    for a in 0..UNKNOWNS {
        for b in 0..a {
            out.matrix[a][b] = out.matrix[b][a];
        }
    }
    out.cost /= pixels as f64;
    out
}

/// 1.4826 × the median absolute deviation; 0 for no values.
fn deviation(mut values: Vec<f64>) -> f64 {
    let middle = median(&mut values);
    for value in &mut values {
        *value = (*value - middle).abs();
    }
    SIGMAS * median(&mut values)
}

/// The middle value, or the mean of the middle two; 0 for no values. Reorders the values.
pub(super) fn median(values: &mut [f64]) -> f64 {
    let count = values.len();
    if count == 0 {
        return 0.0;
    }
    let (below, &mut upper, _) = values.select_nth_unstable_by(count / 2, f64::total_cmp);
    if count % 2 == 1 {
        return upper;
    }
    let lower = below.iter().copied().max_by(f64::total_cmp);
    lower.map_or(upper, |lower| (lower + upper) / 2.0)
}

/// Root mean square, in pixels, by which ξ and a zoom move the unmasked pixels; NaN without any.
pub fn flow(shot: &Render, size: Size, lens: &Lens, xi: &[f64; MOTION]) -> Result<f64> {
    size.check("shot's depth", shot.depth, 1)?;
    size.check("shot's mask", shot.mask, 1)?;
    let moved = |motion: [f64; MOTION]| -> f64 {
        let along: f64 = motion.iter().zip(xi).map(|(m, xi)| m * xi).sum();
        along * along
    };
    let row = |y: usize| -> (f64, usize) {
        let ray_y = (y as f64 + 0.5 - lens.cy) / lens.fy;
        let (mut sum, mut number) = (0.0, 0);
        for i in (y * size.width..(y + 1) * size.width).filter(|&i| shot.mask[i]) {
            let ray_x = ((i - y * size.width) as f64 + 0.5 - lens.cx) / lens.fx;
            let depth = shot.depth[i];
            sum += moved(motion(ray_x, ray_y, depth, lens.fx, 0.0));
            sum += moved(motion(ray_x, ray_y, depth, 0.0, lens.fy));
            number += 1;
        }
        (sum, number)
    };
    let rows: Vec<(f64, usize)> = (0..size.height).into_par_iter().map(row).collect();
    let sum: f64 = rows.iter().map(|row| row.0).sum();
    let number: usize = rows.iter().map(|row| row.1).sum();
    Ok((sum / number as f64).sqrt())
}
