//! (1 − λ)·L1 + λ·(1 − SSIM) and its gradient, tile by tile: `Tile` in `tile.rs`.
//!
//! With e = x − y the textbook fraction reads SSIM = l·c, l = 1 − d²/P, c = 1 − E/Q, where d = ⟨e⟩, E = ⟨e²⟩ − d²,
//! P = μx² + μy² + C₁, Q = σx² + σy² + C₂: nothing cancels where the images agree, and SSIM(x, x) is 1 exactly.
//! A tile computes what it needs of its neighbours again, so that everything between image and gradient stays in the
//! cache, and skips rows where the images agree, such as the background around an object.

mod tile;

use rayon::prelude::*;

use super::{Mask, Shape, window};
use crate::raster::disjoint::DisjointSlice;
use crate::raster::simd::{Isa, dispatch};
use crate::{Error, Result};
use tile::{Tile, scratch_len};

/// Rows and values along a row of a tile: fixed, so that sums are split equally for any number of threads.
const ROWS: usize = 100;
const COLUMNS: usize = 256;

/// The fused loss and its buffers, reused from call to call.
#[derive(Default)]
pub struct Loss {
    isa: Isa,
    sums: Vec<[f64; 2]>,
}

impl Loss {
    pub fn new(isa: Isa) -> Self {
        Self {
            isa,
            ..Self::default()
        }
    }

    /// The loss; `gradient` receives dloss/d(image), which is 0 outside the mask.
    pub fn l1_ssim(
        &mut self,
        image: &[f32],
        target: &[f32],
        shape: Shape,
        mask: Option<&Mask>,
        ssim_weight: f32,
        gradient: &mut [f32],
    ) -> Result<f64> {
        shape.check("image", image)?;
        shape.check("target", target)?;
        shape.check("gradient", gradient)?;
        let factors = mask.map(|mask| &mask.factors[..]);
        if let Some(factors) = factors {
            Error::unless_equal("mask", factors.len(), shape.values(), "values")?;
        }
        let (isa, row) = (self.isa, shape.row());
        let across = row.div_ceil(COLUMNS);
        self.sums
            .resize(shape.height.div_ceil(ROWS) * across, [0.0; 2]);
        let weights = window().map(|w| w as f32);
        let values = mask.map_or(shape.values(), |mask| mask.values(shape.channels));
        let count = values as f32;
        let scale = [(1.0 - ssim_weight) / count, -ssim_weight / count];
        let gradient = DisjointSlice::new(gradient);
        self.sums
            .par_iter_mut()
            .enumerate()
            .with_max_len(2)
            .for_each_init(
                || vec![0f32; scratch_len(shape, COLUMNS.min(row))],
                |scratch, (index, sums)| {
                    let (y, x) = (index / across * ROWS, index % across * COLUMNS);
                    let tile = Tile {
                        image,
                        target,
                        shape,
                        factors,
                        weights,
                        scale,
                        rows: y..shape.height.min(y + ROWS),
                        columns: x..row.min(x + COLUMNS),
                        scratch,
                        gradient,
                    };
                    *sums = dispatch(isa, tile);
                },
            );
        let total = self
            .sums
            .iter()
            .fold([0.0; 2], |t, s| [t[0] + s[0], t[1] + s[1]]);
        let (count, weight) = (values as f64, f64::from(ssim_weight));
        Ok((1.0 - weight) * total[0] / count + weight * total[1] / count)
    }
}
