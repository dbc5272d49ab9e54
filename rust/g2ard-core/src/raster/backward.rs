//! One tile from back to front, Gaussian by Gaussian. Every pair's ten sums go to its own slot.

use super::BATCH;
use super::bins::Pair;
use super::blocks::{BlockMasks, MOST_BLOCKS, blocks, by_pair, row_and_part};
use super::disjoint::DisjointSlice;
use super::grid::TileRect;
use super::memory::prefetch;
use super::project::Splat;
use super::simd::{Kernel, Lanes, Lanes16, Mask, Real, Vector};
use super::tile_batch::{
    TileSplat, TileSplats, alpha, block_coordinates, for_stretches, load_batch, log2_alpha,
};
use super::{ALPHA_MIN, ROWS, Settings, TILE};

/// Sums per pair: Σ h·(1, u, v, u², uv, v²), Σ w·(dR, dG, dB), Σ w·dDepth; h = dL/d(ln α), w = αT.
pub const SUMS: usize = 10;

/// A tile's incoming gradients and the state carried from back to front. Values of one row of lanes are adjacent,
/// because loads and stores 4 KiB apart would alias.
#[derive(Debug, Clone, Copy, Default)]
pub struct Incoming([Row; ROWS]);

#[derive(Debug, Clone, Copy, Default)]
struct Row {
    /// Gradients of R, G, B, alpha and depth.
    given: [Lanes16; 5],
    /// Transmittance in front of the pair last done.
    transmittance: Lanes16,
    /// The colour behind, as if unoccluded, dotted with the gradient: R·g. Carrying it,
    /// dα = T(c·g − R·g) never divides by 1 − α.
    behind: Lanes16,
    last: Lanes16,
}

pub const RGB: usize = 0;
pub const ALPHA: usize = 3;
pub const DEPTH: usize = 4;

impl Incoming {
    /// Copies an image of `channels` interleaved values into the order of lanes, its first channel as gradient `from`; off
    /// the image it is 0.
    pub fn load(
        &mut self,
        from: usize,
        image: &[f32],
        channels: usize,
        width: usize,
        rect: &TileRect,
    ) {
        if rect.columns < TILE || rect.rows < TILE {
            for row in &mut self.0 {
                row.given[from..from + channels].fill(Lanes16::default());
            }
        }
        for y in 0..rect.rows {
            let first = ((rect.y + y) * width + rect.x) * channels;
            let line = &image[first..first + rect.columns * channels];
            for_stretches(y, rect.columns, |x, row, lane, count| {
                let given = &mut self.0[row].given[from..from + channels];
                // The usual stretch, four pixels of three channels, without inner loops.
                if let (Some(values), [r, g, b]) =
                    (line[x * channels..].first_chunk::<12>(), &mut *given)
                    && count == 4
                {
                    for i in 0..4 {
                        r.0[lane + i] = values[3 * i];
                        g.0[lane + i] = values[3 * i + 1];
                        b.0[lane + i] = values[3 * i + 2];
                    }
                    return;
                }
                let pixels = line[x * channels..].chunks_exact(channels).take(count);
                for (i, values) in pixels.enumerate() {
                    for (lanes, value) in given.iter_mut().zip(values) {
                        lanes.0[lane + i] = *value;
                    }
                }
            });
        }
    }
}

pub struct Backward<'a, const WITH_DEPTH: bool> {
    pub pairs: &'a [Pair],
    pub splats: &'a [Splat],
    pub rect: TileRect,
    pub settings: &'a Settings,
    pub background: [f32; 3],
    /// From the forward pass: one entry per batch it processed.
    pub block_masks: &'a [BlockMasks],
    /// Light left at each pixel.
    pub transmittance: &'a [Lanes16; ROWS],
    /// Number of each pixel's last pair, −1 for none.
    pub last: &'a [Lanes16; ROWS],
    pub incoming: &'a mut Incoming,
    pub batch: &'a mut TileSplats,
    /// Sums of each pair.
    pub slots: DisjointSlice<'a, [f32; SUMS]>,
    /// 1 if a slot was written; other slots hold stale values.
    pub written: DisjointSlice<'a, u8>,
}

impl<const WITH_DEPTH: bool> Kernel for Backward<'_, WITH_DEPTH> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let state = &mut self.incoming.0;
        for (row, g) in state.iter_mut().enumerate() {
            g.transmittance = self.transmittance[row];
            g.last = self.last[row];
            let mut behind = F::zero();
            for c in 0..3 {
                behind = F::splat(self.background[c]).fma(F::load(&g.given[c]), behind);
            }
            behind.store(&mut g.behind);
        }
        let minimum = F::Block::splat(ALPHA_MIN.log2());
        let clip = F::Block::splat(self.settings.alpha_max);
        let mut list = [0; BATCH * MOST_BLOCKS + 1];
        for (batch, block_masks) in self.block_masks.iter().enumerate().rev() {
            let mut union = 0;
            for block in 0..blocks::<F::Block>() {
                union |= block_masks[block];
            }
            if union == 0 {
                continue;
            }
            let first = batch * BATCH;
            let pairs = &self.pairs[first..self.pairs.len().min(first + BATCH)];
            load_batch(self.batch, self.pairs, first, self.splats, &self.rect);
            for pair in pairs {
                // SAFETY: only the address is used.
                unsafe { prefetch(&*self.slots.at(pair.slot as usize)) };
            }
            let s = &*self.batch;
            let count = list_items::<F::Block>(block_masks, &mut list);
            let evaluator = Evaluator {
                batch: s,
                minimum,
                clip,
            };
            let mut sums = [F::Block::zero(); SUMS];
            let mut ahead = evaluator.at(list[0], state);
            for i in 0..count {
                let (item, next) = (list[i], list[i + 1]);
                let now = ahead;
                // Evaluated one item ahead: nothing here depends on the other pairs of its block.
                ahead = evaluator.at(next, state);
                let (pair, block) = split::<F::Block>(item);
                let (row, part) = row_and_part::<F::Block>(block);
                now.blend::<WITH_DEPTH>(&s[pair], &mut state[row], part, &mut sums);
                if split::<F::Block>(next).0 != pair {
                    let slot = pairs[pair].slot as usize;
                    let total = F::Block::sums(&sums);
                    sums = [F::Block::zero(); SUMS];
                    // SAFETY: a slot belongs to one pair, and a pair to one tile.
                    unsafe {
                        let out = &mut self.slots.slice(slot, 1)[0];
                        out.copy_from_slice(&total.0[..SUMS]);
                        self.written.write(slot, 1);
                    }
                }
            }
        }
    }
}

/// One pair in one block: pair · blocks + block.
type Item = u16;

#[inline(always)]
fn split<B: Vector>(item: Item) -> (usize, usize) {
    let pair = item as usize / blocks::<B>();
    // A list ends with pair BATCH, the splat that reaches nothing. No item lies past it: `min` shows the compiler that
    // no index does.
    (pair.min(BATCH), item as usize % blocks::<B>())
}

/// The items of a batch from its last pair to its first, then one of the pair that reaches nothing. Return their number
/// without the latter.
#[inline(always)]
fn list_items<B: Vector>(
    block_masks: &BlockMasks,
    list: &mut [Item; BATCH * MOST_BLOCKS + 1],
) -> usize {
    let blocks = blocks::<B>();
    let pairs = u64::BITS as usize / blocks;
    let masks = by_pair::<B>(block_masks);
    let mut count = 0;
    for (word, masks) in masks.chunks_exact(pairs).enumerate().rev() {
        let mut bits = 0;
        for (i, mask) in masks.iter().enumerate() {
            bits |= u64::from(*mask) << (blocks * i);
        }
        while bits != 0 {
            let top = 63 - bits.leading_zeros();
            list[count % (BATCH * MOST_BLOCKS)] =
                (u64::BITS as usize * word + top as usize) as Item;
            count += 1;
            bits ^= 1 << top;
        }
    }
    list[count.min(BATCH * MOST_BLOCKS)] = (BATCH * blocks) as Item;
    count
}

/// Inputs for evaluating the items of a batch.
struct Evaluator<'a, B: Vector> {
    batch: &'a TileSplats,
    minimum: B,
    clip: B,
}

/// An item's values at its block's pixels.
#[derive(Clone, Copy)]
struct Evaluated<B: Vector> {
    u: B,
    v: B,
    /// α.
    a: B,
    /// 1/(1 − α).
    inverse_rest: B,
    /// Lanes in which α is not clipped and therefore depends on its arguments.
    free: B::Mask,
}

impl<B: Vector> Evaluator<'_, B> {
    #[inline(always)]
    fn at(&self, item: Item, state: &[Row; ROWS]) -> Evaluated<B> {
        let (p, block) = split::<B>(item);
        let (row, part) = row_and_part::<B>(block);
        let (x, y) = block_coordinates::<B>(block);
        let splat = &self.batch[p];
        let (u, v, log2) = log2_alpha(splat, x, y);
        let hit = log2
            .ge(self.minimum)
            .and(B::load_part(&state[row].last, part).ge(B::splat(splat.number)));
        let raw = alpha(log2);
        let a = raw.min(self.clip).only(hit);
        Evaluated {
            u,
            v,
            a,
            inverse_rest: (B::splat(1.0) - a).recip(),
            free: self.clip.ge(raw),
        }
    }
}

impl<B: Vector> Evaluated<B> {
    /// Steps the block's state to before the pair, and adds to the pair's sums.
    #[inline(always)]
    fn blend<const WITH_DEPTH: bool>(
        self,
        s: &TileSplat,
        g: &mut Row,
        part: usize,
        sums: &mut [B; SUMS],
    ) {
        let t = B::load_part(&g.transmittance, part) * self.inverse_rest;
        t.store_part(&mut g.transmittance, part);
        let w = self.a * t;
        let mut seen = B::load_part(&g.given[ALPHA], part);
        for c in 0..3 {
            let d = B::load_part(&g.given[c], part);
            seen = B::splat(s.rgb[c]).fma(d, seen);
            sums[6 + c] = w.fma(d, sums[6 + c]);
        }
        if WITH_DEPTH {
            let d = B::load_part(&g.given[DEPTH], part);
            seen = B::splat(s.depth).fma(d, seen);
            sums[9] = w.fma(d, sums[9]);
        }
        let behind = B::load_part(&g.behind, part);
        let gain = seen - behind;
        self.a.fma(gain, behind).store_part(&mut g.behind, part);
        // A clipped α does not depend on its arguments.
        let h = (w * gain).only(self.free);
        let (hu, hv) = (h * self.u, h * self.v);
        sums[0] = sums[0] + h;
        sums[1] = sums[1] + hu;
        sums[2] = sums[2] + hv;
        sums[3] = hu.fma(self.u, sums[3]);
        sums[4] = hu.fma(self.v, sums[4]);
        sums[5] = hv.fma(self.v, sums[5]);
    }
}
