//! SSIM and PSNR for reports, accumulated in f64.

use rayon::prelude::*;

use super::{C1, C2, RADIUS, Shape, window};
use crate::Result;

/// Mean SSIM over pixels and channels.
pub fn ssim(a: &[f32], b: &[f32], shape: Shape) -> Result<f64> {
    shape.check("image", a)?;
    shape.check("target", b)?;
    let w = window();
    let (row, step) = (shape.row(), shape.channels);
    // Vertical sums of x, y, x², y², xy for one row, then horizontal ones value by value.
    let rows: Vec<f64> = (0..shape.height)
        .into_par_iter()
        .map(|y| {
            let mut sums = vec![[0f64; 5]; row];
            for yy in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(shape.height) {
                let k = w[yy + RADIUS - y];
                for (i, s) in sums.iter_mut().enumerate() {
                    let (p, q) = (f64::from(a[yy * row + i]), f64::from(b[yy * row + i]));
                    for (s, v) in s.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                        *s += k * v;
                    }
                }
            }
            (0..row).map(|i| value(&sums, &w, i, step)).sum()
        })
        .collect();
    Ok(rows.iter().sum::<f64>() / shape.values() as f64)
}

fn value(sums: &[[f64; 5]], w: &[f64], i: usize, step: usize) -> f64 {
    let mut m = [0f64; 5];
    for (t, k) in w.iter().enumerate() {
        let Some(at) = (i + t * step).checked_sub(RADIUS * step) else {
            continue;
        };
        if let Some(s) = sums.get(at) {
            for (m, s) in m.iter_mut().zip(s) {
                *m += k * s;
            }
        }
    }
    let [x, y, xx, yy, xy] = m;
    let variances = (xx - x * x).max(0.0) + (yy - y * y).max(0.0);
    let (l, c) = (2.0 * x * y + C1, 2.0 * (xy - x * y) + C2);
    l * c / ((x * x + y * y + C1) * (variances + C2))
}

/// −10·log10 of the mean squared difference, for values in 0–1; infinite for equal images.
pub fn psnr(a: &[f32], b: &[f32], shape: Shape) -> Result<f64> {
    shape.check("image", a)?;
    shape.check("target", b)?;
    let chunks: Vec<f64> = a
        .par_chunks(1 << 14)
        .zip(b.par_chunks(1 << 14))
        .map(|(a, b)| {
            a.iter()
                .zip(b)
                .map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2))
                .sum()
        })
        .collect();
    Ok(-10.0 * (chunks.iter().sum::<f64>() / shape.values() as f64).log10())
}
