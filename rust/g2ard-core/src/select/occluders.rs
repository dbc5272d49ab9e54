//! The Gaussians that can hide something, in blocks of neighbours, ready to be projected.

use rayon::prelude::*;

use super::Gaussians;
use super::pinhole::{Block, Occluder, Pinhole};
use crate::raster::ALPHA_MIN;
use crate::spatial::{RobustBounds, codes, order};

/// Rows per block: few enough that blocks are small, enough that testing blocks is cheap.
const BLOCK: usize = 64;

/// A scene's Gaussians in Morton order.
#[derive(Debug)]
pub struct Occluders {
    pub rows: Vec<Occluder>,
    pub(super) blocks: Vec<Block>,
}

impl Occluders {
    pub fn of(scene: &Gaussians<'_>) -> Self {
        let codes = codes(scene.means, &RobustBounds::of(scene.means));
        let order = order(&codes);
        let rows: Vec<Occluder> = order
            .into_par_iter()
            .filter(|&i| scene.opacities[i as usize] >= ALPHA_MIN)
            .map(|i| Occluder::of(scene, i as usize))
            .collect();
        let blocks = rows.par_chunks(BLOCK).map(Block::of).collect();
        Self { rows, blocks }
    }

    /// The rows that `view` may show, in order.
    pub(super) fn rows_in<'a>(&'a self, view: &'a Pinhole) -> impl Iterator<Item = &'a Occluder> {
        let chunks = self.rows.chunks(BLOCK).zip(&self.blocks);
        chunks
            .filter(|(_, block)| !view.misses(block))
            .flat_map(|(rows, _)| rows)
    }
}

impl Occluder {
    fn of(scene: &Gaussians<'_>, i: usize) -> Self {
        let covariance = scene.covariance(i).map(|v| v as f32);
        Self {
            mean: scene.means[i].map(|v| v as f32),
            opacity: scene.opacities[i],
            covariance,
            trace: covariance[0] + covariance[3] + covariance[5],
            reach: 2.0 * (scene.opacities[i] / ALPHA_MIN).ln(),
        }
    }
}

impl Block {
    fn of(rows: &[Occluder]) -> Self {
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for row in rows {
            for k in 0..3 {
                low[k] = low[k].min(row.mean[k]);
                high[k] = high[k].max(row.mean[k]);
            }
        }
        let most = |f: fn(&Occluder) -> f32| rows.iter().map(f).fold(0.0, f32::max);
        Self {
            center: [0, 1, 2].map(|k| 0.5 * low[k] + 0.5 * high[k]),
            half: [0, 1, 2].map(|k| 0.5 * high[k] - 0.5 * low[k]),
            spread: most(|r| r.trace * r.reach),
            reach: most(|r| r.reach),
        }
    }
}
