//! One tile from back to front, Gaussian by Gaussian: every pair's ten sums go to its own slot.

use super::forward::{BATCH, Place, Staged, alpha, block_coordinates, block_pixel, log2_alpha};
use super::order::Shared;
use super::project::Splat;
use super::simd::{Kernel, LANES, Lanes, Mask, Row};
use super::tiles::Pair;
use super::{ALPHA_MIN, BLOCKS, Settings};

/// Sums a pair leaves behind: Σ h·(1, u, v, u², uv, v²), Σ w·(dR, dG, dB), Σ w·dDepth; h = dL/d(ln α), w = αT.
pub const SUMS: usize = 10;

/// A tile's incoming gradients, a row of 16 lanes per block, and the state carried from back to front.
#[derive(Debug, Clone, Copy, Default)]
pub struct Incoming {
    pub rgb: [[Row; BLOCKS]; 3],
    pub alpha: [Row; BLOCKS],
    pub depth: [Row; BLOCKS],
    /// Transmittance in front of the pair last done.
    transmittance: [Row; BLOCKS],
    /// What lies behind, seen without the light lost in front and dotted with the gradient: R·g. Carrying it,
    /// dα = T(c·g − R·g) never divides by 1 − α.
    behind: [Row; BLOCKS],
}

impl Incoming {
    /// Copies one row-major plane of the image (`channels` interleaved) into block order; off the image it is 0.
    pub fn load(
        rows: &mut [Row; BLOCKS],
        image: &[f32],
        channel: usize,
        channels: usize,
        width: usize,
        place: &Place,
    ) {
        for block in 0..BLOCKS {
            for l in 0..LANES {
                let (x, y) = block_pixel(block, l);
                let on = x < place.columns && y < place.rows;
                let at = ((place.y + y) * width + place.x + x) * channels + channel;
                rows[block].0[l] = if on { image[at] } else { 0.0 };
            }
        }
    }
}

pub struct Backward<'a, const DEPTH: bool> {
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

impl<const DEPTH: bool> Kernel for Backward<'_, DEPTH> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let g = self.incoming;
        g.transmittance = *self.transmittance;
        for block in 0..BLOCKS {
            let mut behind = F::zero();
            for c in 0..3 {
                behind = F::splat(self.background[c]).fma(F::load(&g.rgb[c][block]), behind);
            }
            behind.store(&mut g.behind[block]);
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
                    let block = blocks.trailing_zeros() as usize;
                    blocks &= blocks - 1;
                    let (x, y) = block_coordinates::<F>(block);
                    let (u, v, log2) = log2_alpha(s, p, x, y);
                    let hit = log2.ge(minimum).and(F::load(&self.last[block]).ge(number));
                    let raw = alpha(log2);
                    let a = raw.min(clip).only(hit);
                    let t = F::load(&g.transmittance[block]) * (F::splat(1.0) - a).recip();
                    t.store(&mut g.transmittance[block]);
                    let w = a * t;
                    let mut seen = F::load(&g.alpha[block]);
                    for c in 0..3 {
                        let d = F::load(&g.rgb[c][block]);
                        seen = F::splat(s.rgb[c][p]).fma(d, seen);
                        sums[6 + c] = w.fma(d, sums[6 + c]);
                    }
                    if DEPTH {
                        let d = F::load(&g.depth[block]);
                        seen = F::splat(s.depth[p]).fma(d, seen);
                        sums[9] = w.fma(d, sums[9]);
                    }
                    let behind = F::load(&g.behind[block]);
                    let gain = seen - behind;
                    a.fma(gain, behind).store(&mut g.behind[block]);
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
