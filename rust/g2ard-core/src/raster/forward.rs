//! Blending one tile from front to back: per batch of 64 pairs, per block of pixels, the block's state in registers.

use super::BATCH;
use super::bins::Pair;
use super::blocks::{BlockMasks, blocks, row_and_part};
use super::grid::TileRect;
use super::project::Splat;
use super::region::Within;
use super::simd::{Kernel, Lanes, Lanes16, Mask, Real, Vector};
use super::tile_batch::{TileBatch, alpha, block_coordinates, log2_alpha};
use super::{ALPHA_MIN, ROWS, Settings};

/// One tile's pixels, a row of 16 lanes for every 4×4 of them.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pixels {
    pub rgb: [[Lanes16; ROWS]; 3],
    pub depth: [Lanes16; ROWS],
    /// Depth of the splat at which transmittance falls below one half; 0 if it never does.
    pub median: [Lanes16; ROWS],
}

impl Pixels {
    #[inline(always)]
    fn colours<B: Vector>(&self, row: usize, part: usize) -> [B; 3] {
        let [r, g, b] = &self.rgb;
        [
            B::load_part(&r[row], part),
            B::load_part(&g[row], part),
            B::load_part(&b[row], part),
        ]
    }
}

/// Blends a tile's pairs behind what its pixels show already. `block_masks` holds the pairs that contributed to each block
/// afterwards.
pub struct Forward<'a, W: Within, const DEPTH: bool> {
    pub pairs: &'a [Pair],
    pub splats: &'a [Splat],
    pub rect: TileRect,
    pub settings: &'a Settings,
    /// Masks of each batch.
    pub block_masks: &'a mut [BlockMasks],
    /// The light that would remain if no pixel ever stopped. A stopped pixel's light only falls further below the
    /// minimum, so stopping needs no state, and the loop over pairs depends on one product alone.
    pub light: &'a mut [Lanes16; ROWS],
    pub transmittance: &'a mut [Lanes16; ROWS],
    /// Number within the tile of each pixel's last pair, −1 for none.
    pub last: &'a mut [Lanes16; ROWS],
    pub pixels: &'a mut Pixels,
    pub tile_batch: &'a mut TileBatch,
    pub within: W,
}

impl<W: Within, const DEPTH: bool> Kernel for Forward<'_, W, DEPTH> {
    /// Batches processed before every pixel had stopped.
    type Output = usize;

    #[inline(always)]
    fn run<F: Lanes>(self) -> usize {
        let minimum = F::Block::splat(ALPHA_MIN.log2());
        let stop = F::Block::splat(self.settings.transmittance_min);
        let clip = F::Block::splat(self.settings.alpha_max);
        let half = F::Block::splat(0.5);
        for (batch, block_masks) in self.block_masks.iter_mut().enumerate() {
            let first = batch * BATCH;
            let pairs = &self.pairs[first..self.pairs.len().min(first + BATCH)];
            let s = &mut *self.tile_batch;
            s.load(self.pairs, first, self.splats, &self.rect);
            s.reachable::<F>(pairs.len(), block_masks);
            let mut any = false;
            for block in 0..blocks::<F::Block>() {
                let (row, part) = row_and_part::<F::Block>(block);
                let mut todo = block_masks[block];
                let mut t = F::Block::load_part(&self.light[row], part);
                if todo == 0 || !t.gt(stop).any() {
                    any |= t.gt(stop).any();
                    block_masks[block] = 0;
                    continue;
                }
                let mut kept = 0u64;
                let (x, y) = block_coordinates::<F::Block>(block);
                let mut left = F::Block::load_part(&self.transmittance[row], part);
                let mut last = F::Block::load_part(&self.last[row], part);
                let px = &mut *self.pixels;
                let mut rgb = px.colours::<F::Block>(row, part);
                let mut depth = F::Block::load_part(&px.depth[row], part);
                let mut median = F::Block::load_part(&px.median[row], part);
                let mut light = true;
                while todo != 0 && light {
                    let p = todo.trailing_zeros() as usize;
                    todo &= todo - 1;
                    let splat = &s.splats[p];
                    let (_, _, log2) = log2_alpha(splat, x, y);
                    let hit = self
                        .within
                        .at::<F::Block>(log2.ge(minimum), splat.depth, row, part);
                    let a = alpha(log2).min(clip).only(hit);
                    let next = a.fnma(t, t);
                    let going = next.gt(stop); // pixels that the splat does not stop
                    let w = (a * t).only(going);
                    for c in 0..3 {
                        rgb[c] = F::Block::splat(splat.rgb[c]).fma(w, rgb[c]);
                    }
                    let shown = hit.and(going);
                    if DEPTH {
                        let z = F::Block::splat(splat.depth);
                        depth = z.fma(w, depth);
                        median =
                            F::Block::select(shown.and(t.ge(half)).and(half.gt(next)), z, median);
                    }
                    t = next;
                    left = F::Block::select(going, next, left);
                    last = F::Block::select(shown, F::Block::splat(splat.number), last);
                    kept |= u64::from(shown.any()) << p;
                    light = going.any();
                }
                block_masks[block] = kept;
                any |= light;
                t.store_part(&mut self.light[row], part);
                left.store_part(&mut self.transmittance[row], part);
                last.store_part(&mut self.last[row], part);
                for c in 0..3 {
                    rgb[c].store_part(&mut px.rgb[c][row], part);
                }
                if DEPTH {
                    depth.store_part(&mut px.depth[row], part);
                    median.store_part(&mut px.median[row], part);
                }
            }
            if !any {
                return batch + 1;
            }
        }
        self.block_masks.len()
    }
}
