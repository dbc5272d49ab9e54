//! A loss over unmasked pixels only, from the loss over all of them.

use crate::{Error, Result};

/// Unmasked pixels, and their number.
#[derive(Debug, Clone, Copy)]
pub struct Mask<'a> {
    counts: &'a [bool],
    /// All pixels over the unmasked ones: turns a mean over all pixels into one over the unmasked.
    pub share: f32,
}

impl<'a> Mask<'a> {
    pub fn new(counts: &'a [bool], pixels: usize) -> Result<Self> {
        Error::unless_equal("mask", counts.len(), pixels, "values")?;
        let count = counts.iter().filter(|counts| **counts).count();
        let share = pixels as f32 / count.max(1) as f32;
        Ok(Self { counts, share })
    }

    /// Set masked pixels of the image to the target, so that they have no error.
    pub fn cover(&self, image: &mut [f32], target: &[f32]) {
        let pixels = image.chunks_exact_mut(3).zip(target.chunks_exact(3));
        for ((pixel, wanted), _) in pixels.zip(self.counts).filter(|(_, counts)| !**counts) {
            pixel.copy_from_slice(wanted);
        }
    }

    /// Convert the gradient of the mean over all pixels to that over the unmasked ones.
    pub fn clear(&self, gradient: &mut [f32]) {
        for (pixel, counts) in gradient.chunks_exact_mut(3).zip(self.counts) {
            let factor = if *counts { self.share } else { 0.0 };
            for value in pixel {
                *value *= factor;
            }
        }
    }
}
