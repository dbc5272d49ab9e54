//! L1 and SSIM: fused forward and backward for training ([`Loss`]), and metrics for reports ([`ssim`], [`psnr`],
//! [`Compared`]).
//!
//! SSIM of Wang et al. (2004): 11×11 Gaussian window, σ 1.5, zero-padded as 3DGS does, values in 0–1, C₁ = 0.01²,
//! C₂ = 0.03². Images are row-major with interleaved channels, so one channel's neighbour is `channels` values away.
//! With a mask, windows are weighted by it ([`Mask`]), and both losses are means over the pixels that count.

mod detail;
mod loss;
mod mask;
mod metrics;

pub use detail::{Compared, Steps};
pub use loss::Loss;
pub use mask::Mask;
pub use metrics::{psnr, ssim};

use crate::Result;

pub(crate) const RADIUS: usize = 5;
pub(crate) const TAPS: usize = 2 * RADIUS + 1;
pub(crate) const C1: f64 = 0.01 * 0.01;
pub(crate) const C2: f64 = 0.03 * 0.03;

/// Height, width and channels of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    pub height: usize,
    pub width: usize,
    pub channels: usize,
}

impl Shape {
    pub fn values(&self) -> usize {
        self.height * self.width * self.channels
    }

    pub(crate) fn row(&self) -> usize {
        self.width * self.channels
    }

    pub(crate) fn check(&self, name: &'static str, image: &[f32]) -> Result<()> {
        refuse!(self.values() == 0 || image.len() != self.values() =>
            name, format!( "{}×{}×{} values, more than none", self.height, self.width, self.channels ), image.len());
        Ok(())
    }
}

/// The window's weights in one direction; they sum to 1.
pub(crate) fn window() -> [f64; TAPS] {
    let mut w = [0.0; TAPS];
    for (i, v) in w.iter_mut().enumerate() {
        let x = i as f64 - RADIUS as f64;
        *v = (-x * x / (2.0 * 1.5 * 1.5)).exp();
    }
    let sum: f64 = w.iter().sum();
    w.map(|v| v / sum)
}
