//! SSIM and PSNR for reports.

use rayon::prelude::*;

use super::{Loss, Mask, Shape};
use crate::Result;

/// Mean SSIM over the pixels that count and channels.
pub fn ssim(a: &[f32], b: &[f32], shape: Shape, mask: Option<&Mask>) -> Result<f64> {
    let mut gradient = vec![0.0; shape.values()];
    Ok(1.0 - Loss::default().l1_ssim(a, b, shape, mask, 1.0, &mut gradient)?)
}

/// −10·log10 of the mean squared difference, for values in 0–1; infinite for equal images.
pub fn psnr(a: &[f32], b: &[f32], shape: Shape) -> Result<f64> {
    shape.check("image", a)?;
    shape.check("target", b)?;
    let chunks: Vec<f64> = a
        .par_chunks(1 << 14)
        .zip(b.par_chunks(1 << 14))
        .with_max_len(2)
        .map(|(a, b)| {
            a.iter()
                .zip(b)
                .map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2))
                .sum()
        })
        .collect();
    Ok(-10.0 * (chunks.iter().sum::<f64>() / shape.values() as f64).log10())
}
