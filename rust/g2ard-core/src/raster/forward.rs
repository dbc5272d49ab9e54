//! Blending one tile from front to back: per batch of 64 pairs, per 4×4 block, the block's state in registers.

use super::project::Splat;
use super::simd::{Kernel, LANES, Lanes, Lanes16, Mask};
use super::tile_batch::{BATCH, TileBatch, TileRect, alpha, block_coordinates, log2_alpha};
use super::tiles::Pair;
use super::{ALPHA_MIN, BLOCKS, Settings};

/// One tile's pixels, a row of 16 lanes per block.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pixels {
    pub rgb: [[Lanes16; BLOCKS]; 3],
    pub depth: [Lanes16; BLOCKS],
    /// Depth of the first splat behind which less than half the light is left; 0 if there is none.
    pub median: [Lanes16; BLOCKS],
}

/// Blends a tile. `block_masks` holds the pairs that contributed to each block afterwards.
pub struct Forward<'a, const DEPTH: bool> {
    pub pairs: &'a [Pair],
    pub splats: &'a [Splat],
    pub rect: TileRect,
    pub settings: &'a Settings,
    /// 16 block_masks for each batch.
    pub block_masks: &'a mut [[u64; BLOCKS]],
    pub transmittance: &'a mut [Lanes16; BLOCKS],
    /// Number within the tile of each pixel's last pair, −1 for none.
    pub last: &'a mut [Lanes16; BLOCKS],
    pub pixels: &'a mut Pixels,
    pub tile_batch: &'a mut TileBatch,
}

impl<const DEPTH: bool> Kernel for Forward<'_, DEPTH> {
    /// Batches processed before every pixel had stopped.
    type Output = usize;

    #[inline(always)]
    fn run<F: Lanes>(self) -> usize {
        *self.pixels = Pixels::default();
        *self.transmittance = [Lanes16([1.0; LANES]); BLOCKS];
        *self.last = [Lanes16([-1.0; LANES]); BLOCKS];
        // The light that would be left if nothing ever stopped. A stopped pixel's only falls further below the
        // minimum, so whether it would stop here needs no state, and the loop below depends on one product alone.
        let mut unstopped = self.rect.light::<F>();
        let minimum = F::splat(ALPHA_MIN.log2());
        let stop = F::splat(self.settings.transmittance_min);
        let (clip, half) = (F::splat(self.settings.alpha_max), F::splat(0.5));
        for (batch, block_masks) in self.block_masks.iter_mut().enumerate() {
            let first = batch * BATCH;
            let pairs = &self.pairs[first..self.pairs.len().min(first + BATCH)];
            self.tile_batch
                .load(self.pairs, first, self.splats, &self.rect);
            let s = &*self.tile_batch;
            s.reachable::<F>(pairs.len(), block_masks);
            let mut any = false;
            for block in 0..BLOCKS {
                let mut todo = block_masks[block];
                let mut t = F::load(&unstopped[block]);
                if todo == 0 || !t.gt(stop).any() {
                    any |= t.gt(stop).any();
                    block_masks[block] = 0;
                    continue;
                }
                let mut kept = 0u64;
                let (x, y) = block_coordinates::<F>(block);
                let mut left = F::load(&self.transmittance[block]);
                let mut last = F::load(&self.last[block]);
                let px = &mut *self.pixels;
                let [r, g, b] = &px.rgb;
                let mut rgb = [F::load(&r[block]), F::load(&g[block]), F::load(&b[block])];
                let mut depth = F::load(&px.depth[block]);
                let mut median = F::load(&px.median[block]);
                let mut light = true;
                while todo != 0 && light {
                    let p = todo.trailing_zeros() as usize;
                    todo &= todo - 1;
                    let splat = &s.splats[p];
                    let (_, _, log2) = log2_alpha(splat, x, y);
                    let hit = log2.ge(minimum);
                    let a = alpha(log2).min(clip).only(hit);
                    let next = a.fnma(t, t);
                    let going = next.gt(stop);
                    let w = (a * t).only(going);
                    for c in 0..3 {
                        rgb[c] = F::splat(splat.rgb[c]).fma(w, rgb[c]);
                    }
                    let go = hit.and(going);
                    if DEPTH {
                        let z = F::splat(splat.depth);
                        depth = z.fma(w, depth);
                        median = F::select(go.and(t.ge(half)).and(half.gt(next)), z, median);
                    }
                    t = next;
                    left = F::select(going, next, left);
                    last = F::select(go, F::splat(splat.number), last);
                    kept |= u64::from(go.any()) << p;
                    light = going.any();
                }
                block_masks[block] = kept;
                any |= light;
                t.store(&mut unstopped[block]);
                left.store(&mut self.transmittance[block]);
                last.store(&mut self.last[block]);
                for c in 0..3 {
                    rgb[c].store(&mut px.rgb[c][block]);
                }
                if DEPTH {
                    depth.store(&mut px.depth[block]);
                    median.store(&mut px.median[block]);
                }
            }
            if !any {
                return batch + 1;
            }
        }
        self.block_masks.len()
    }
}
