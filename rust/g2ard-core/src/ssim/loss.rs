//! (1 − λ)·L1 + λ·(1 − SSIM) and its gradient in two passes over bands of rows: `Forward` and `Backward` in `bands.rs`.
//!
//! With e = x − y the textbook fraction reads SSIM = l·c, l = 1 − d²/P, c = 1 − E/Q, where d = ⟨e⟩, E = ⟨e²⟩ − d²,
//! P = μx² + μy² + C₁, Q = σx² + σy² + C₂: nothing cancels where the images agree, and SSIM(x, x) is 1 exactly.

mod bands;

use rayon::prelude::*;

use super::{Shape, TAPS, window};
use crate::Result;
use crate::raster::memory::bytes;
use crate::raster::simd::{Isa, LANES, dispatch};
use bands::{Backward, Forward, span};

/// Rows processed together: fixed, so that sums are split equally for any number of threads.
const BAND: usize = 32;
/// x, e, x² + y² and e² are blurred going forward; three derivatives going back.
const FORWARD: usize = 4;
const BACK: usize = 3;

/// The fused loss and its buffers, reused from call to call.
#[derive(Default)]
pub struct Loss {
    isa: Isa,
    /// The three derivative maps, blurred along rows: row after row, each map padded to whole lanes.
    maps: Vec<f32>,
    sums: Vec<[f64; 2]>,
}

impl Loss {
    pub fn new(isa: Isa) -> Self {
        Self {
            isa,
            ..Self::default()
        }
    }

    /// Bytes held between calls.
    pub(crate) fn bytes(&self) -> usize {
        bytes(&self.maps) + bytes(&self.sums)
    }

    /// The loss; `gradient` receives dloss/d(image).
    pub fn l1_ssim(
        &mut self,
        image: &[f32],
        target: &[f32],
        shape: Shape,
        ssim_weight: f32,
        gradient: &mut [f32],
    ) -> Result<f64> {
        shape.check("image", image)?;
        shape.check("target", target)?;
        shape.check("gradient", gradient)?;
        let (isa, row) = (self.isa, shape.row());
        let padded = row.next_multiple_of(LANES);
        let band = BACK * padded * BAND;
        self.maps.resize(BACK * padded * shape.height, 0.0);
        self.sums.resize(shape.height, [0.0; 2]);
        let weights = window().map(|w| w as f32);
        let forward = self
            .maps
            .par_chunks_mut(band)
            .zip(self.sums.par_chunks_mut(BAND))
            .enumerate();
        forward.for_each_init(
            || vec![0f32; (FORWARD * (TAPS + 1) + BACK) * span(shape)],
            |scratch, (index, (maps, sums))| {
                let first = index * BAND;
                dispatch(
                    isa,
                    Forward {
                        image,
                        target,
                        shape,
                        weights,
                        first,
                        maps,
                        sums,
                        scratch,
                    },
                );
            },
        );
        let count = shape.values() as f32;
        let maps = &self.maps;
        gradient
            .par_chunks_mut(row * BAND)
            .enumerate()
            .for_each(|(index, out)| {
                let first = index * BAND;
                let scale = [(1.0 - ssim_weight) / count, -ssim_weight / count];
                dispatch(
                    isa,
                    Backward {
                        image,
                        target,
                        shape,
                        weights,
                        first,
                        maps,
                        scale,
                        out,
                    },
                );
            });
        let total = self
            .sums
            .iter()
            .fold([0.0; 2], |t, s| [t[0] + s[0], t[1] + s[1]]);
        let (count, weight) = (shape.values() as f64, f64::from(ssim_weight));
        Ok((1.0 - weight) * total[0] / count + weight * total[1] / count)
    }
}
