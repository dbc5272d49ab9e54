//! One tile from back to front, Gaussian by Gaussian: every pair's ten sums go to its own slot.

use super::forward::{BATCH, Place, Staged, alpha, block_coordinates, log2_alpha};
use super::order::Shared;
use super::project::Splat;
use super::simd::{Kernel, Lanes, Mask, Row};
use super::tiles::Pair;
use super::{ALPHA_MIN, BLOCKS, Settings, TILE};

/// Sums a pair leaves behind: Σ h·(1, u, v, u², uv, v²), Σ w·(dR, dG, dB), Σ w·dDepth; h = dL/d(ln α), w = αT.
pub const SUMS: usize = 10;

/// A tile's incoming gradients and the state carried from back to front, block by block: what a block needs lies side
/// by side, for rows 4 KiB apart would wait for each other's stores.
#[derive(Debug, Clone, Copy, Default)]
pub struct Incoming([Block; BLOCKS]);

#[derive(Debug, Clone, Copy, Default)]
struct Block {
    /// Gradients of R, G, B, alpha and depth.
    given: [Row; 5],
    /// Transmittance in front of the pair last done.
    transmittance: Row,
    /// What lies behind, seen without the light lost in front and dotted with the gradient: R·g. Carrying it,
    /// dα = T(c·g − R·g) never divides by 1 − α.
    behind: Row,
    last: Row,
}

pub const RGB: usize = 0;
pub const ALPHA: usize = 3;
pub const DEPTH: usize = 4;

impl Incoming {
    /// Copies an image of `channels` interleaved values into block order, its first channel as gradient `from`; off
    /// the image it is 0.
    pub fn load(
        &mut self,
        from: usize,
        image: &[f32],
        channels: usize,
        width: usize,
        place: &Place,
    ) {
        if place.columns < TILE || place.rows < TILE {
            for block in &mut self.0 {
                block.given[from..from + channels].fill(Row::default());
            }
        }
        for y in 0..place.rows {
            let first = ((place.y + y) * width + place.x) * channels;
            let row = &image[first..first + place.columns * channels];
            for (x, values) in row.chunks_exact(channels).enumerate() {
                let block = &mut self.0[y / 4 * 4 + x / 4];
                for (row, value) in block.given[from..].iter_mut().zip(values) {
                    row.0[y % 4 * 4 + x % 4] = *value;
                }
            }
        }
    }
}

pub struct Backward<'a, const WITH_DEPTH: bool> {
    pub pairs: &'a [Pair],
    pub splats: &'a [Splat],
    pub place: Place,
    pub settings: &'a Settings,
    pub background: [f32; 3],
    /// What the forward pass left: one entry per batch it looked at.
    pub words: &'a [[u64; BLOCKS]],
    pub transmittance: &'a [Row; BLOCKS],
    pub last: &'a [Row; BLOCKS],
    pub incoming: &'a mut Incoming,
    pub staged: &'a mut Staged,
    pub slots: Shared<[f32; SUMS]>,
    pub written: Shared<u8>,
}

impl<const WITH_DEPTH: bool> Kernel for Backward<'_, WITH_DEPTH> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let state = &mut self.incoming.0;
        for (block, g) in state.iter_mut().enumerate() {
            g.transmittance = self.transmittance[block];
            g.last = self.last[block];
            let mut behind = F::zero();
            for c in 0..3 {
                behind = F::splat(self.background[c]).fma(F::load(&g.given[c]), behind);
            }
            behind.store(&mut g.behind);
        }
        let minimum = F::splat(ALPHA_MIN.log2());
        let clip = F::splat(self.settings.alpha_max);
        for (batch, words) in self.words.iter().enumerate().rev() {
            let mut union = 0;
            for block in 0..BLOCKS {
                union |= words[block];
            }
            if union == 0 {
                continue;
            }
            let first = batch * BATCH;
            let pairs = &self.pairs[first..self.pairs.len().min(first + BATCH)];
            self.staged.load(pairs, self.splats, &self.place);
            let s = &*self.staged;
            let mut masks = [0u16; BATCH];
            for block in 0..BLOCKS {
                let mut word = words[block];
                while word != 0 {
                    masks[word.trailing_zeros() as usize] |= 1 << block;
                    word &= word - 1;
                }
            }
            while union != 0 {
                let p = 63 - union.leading_zeros() as usize;
                union ^= 1 << p;
                let mut blocks = u32::from(masks[p]);
                let number = F::splat((first + p) as f32);
                let mut sums = [F::zero(); SUMS];
                while blocks != 0 {
                    let block = blocks.trailing_zeros() as usize % BLOCKS;
                    blocks &= blocks - 1;
                    let g = &mut state[block];
                    let (x, y) = block_coordinates::<F>(block);
                    let (u, v, log2) = log2_alpha(s, p, x, y);
                    let hit = log2.ge(minimum).and(F::load(&g.last).ge(number));
                    let raw = alpha(log2);
                    let a = raw.min(clip).only(hit);
                    let t = F::load(&g.transmittance) * (F::splat(1.0) - a).recip();
                    t.store(&mut g.transmittance);
                    let w = a * t;
                    let mut seen = F::load(&g.given[ALPHA]);
                    for c in 0..3 {
                        let d = F::load(&g.given[c]);
                        seen = F::splat(s.rgb[c][p]).fma(d, seen);
                        sums[6 + c] = w.fma(d, sums[6 + c]);
                    }
                    if WITH_DEPTH {
                        let d = F::load(&g.given[DEPTH]);
                        seen = F::splat(s.depth[p]).fma(d, seen);
                        sums[9] = w.fma(d, sums[9]);
                    }
                    let behind = F::load(&g.behind);
                    let gain = seen - behind;
                    a.fma(gain, behind).store(&mut g.behind);
                    // Where α is clipped it does not follow its arguments.
                    let h = (w * gain).only(clip.ge(raw));
                    let (hu, hv) = (h * u, h * v);
                    sums[0] = sums[0] + h;
                    sums[1] = sums[1] + hu;
                    sums[2] = sums[2] + hv;
                    sums[3] = hu.fma(u, sums[3]);
                    sums[4] = hu.fma(v, sums[4]);
                    sums[5] = hv.fma(v, sums[5]);
                }
                let total = F::sums(&sums);
                let slot = pairs[p].slot as usize;
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
