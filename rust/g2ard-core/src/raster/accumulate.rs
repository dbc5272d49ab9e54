//! What each Gaussian contributes to a view: the sums that visibility, pruning and counting are made of.

use super::backward::SUMS;
use super::forward::{BATCH, Place, Staged, alpha, block_coordinates, log2_alpha};
use super::order::Shared;
use super::project::Splat;
use super::simd::{Kernel, LANES, Lanes, Mask, Row};
use super::tiles::Pair;
use super::{ALPHA_MIN, BLOCKS, Settings};

/// Per-Gaussian sums over the pixels of the views added so far.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Accumulated {
    /// Σ αT.
    pub weight: Vec<f64>,
    /// Σ T over the pixels hit.
    pub transmittance: Vec<f64>,
    /// Pixels hit: α ≥ 1/255 and not behind a stopped pixel.
    pub hits: Vec<u64>,
    /// Pixels where no other Gaussian has a larger αT (the nearer wins a tie).
    pub dominant: Vec<u64>,
    /// The largest αT.
    pub peak: Vec<f32>,
    /// The smallest depth / focal length over the views with the mean inside the image: the size of a pixel there,
    /// scene units. Infinite where no view has it.
    pub pixel_size: Vec<f32>,
}

impl Accumulated {
    pub fn new(rows: usize) -> Self {
        Self {
            weight: vec![0.0; rows],
            transmittance: vec![0.0; rows],
            hits: vec![0; rows],
            dominant: vec![0; rows],
            peak: vec![0.0; rows],
            pixel_size: vec![f32::INFINITY; rows],
        }
    }
}

/// One tile's sums, pair by pair, in the slots: weight, transmittance, hits, peak, dominant.
pub struct Accumulate<'a> {
    pub pairs: &'a [Pair],
    pub splats: &'a [Splat],
    pub place: Place,
    pub settings: &'a Settings,
    /// What the forward pass left: one entry per batch it looked at.
    pub words: &'a [[u64; BLOCKS]],
    pub last: &'a [Row; BLOCKS],
    pub staged: &'a mut Staged,
    pub slots: Shared<[f32; SUMS]>,
    pub written: Shared<u8>,
}

impl Kernel for Accumulate<'_> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let minimum = F::splat(ALPHA_MIN.log2());
        let clip = F::splat(self.settings.alpha_max);
        let mut transmittance = [Row([1.0; LANES]); BLOCKS];
        let mut best = [Row::default(); BLOCKS];
        let mut winner = [Row([-1.0; LANES]); BLOCKS];
        for (batch, words) in self.words.iter().enumerate() {
            let first = batch * BATCH;
            let pairs = &self.pairs[first..self.pairs.len().min(first + BATCH)];
            self.staged.load(pairs, self.splats, &self.place);
            let mut sums = [[0f32; SUMS]; BATCH];
            for block in 0..BLOCKS {
                let (x, y) = block_coordinates::<F>(block);
                let last = F::load(&self.last[block]);
                let mut t = F::load(&transmittance[block]);
                let mut most = F::load(&best[block]);
                let mut who = F::load(&winner[block]);
                let mut todo = words[block];
                while todo != 0 {
                    let p = todo.trailing_zeros() as usize;
                    todo &= todo - 1;
                    let number = F::splat((first + p) as f32);
                    let (_, _, log2) = log2_alpha(self.staged, p, x, y);
                    let hit = log2.ge(minimum).and(last.ge(number));
                    let a = alpha(log2).min(clip).only(hit);
                    let w = a * t;
                    let wins = w.gt(most);
                    who = F::select(wins, number, who);
                    most = most.max(w);
                    let mut row = [Row::default(); 2];
                    w.store(&mut row[0]);
                    t.only(hit).store(&mut row[1]);
                    let sum = &mut sums[p];
                    for l in 0..LANES {
                        sum[0] += row[0].0[l];
                        sum[1] += row[1].0[l];
                        sum[3] = sum[3].max(row[0].0[l]);
                    }
                    sum[2] += hit.bits().count_ones() as f32;
                    t = a.fnma(t, t);
                }
                t.store(&mut transmittance[block]);
                most.store(&mut best[block]);
                who.store(&mut winner[block]);
            }
            for (pair, sum) in pairs.iter().zip(&sums) {
                if sum[2] > 0.0 {
                    // SAFETY: a slot belongs to one pair, and a pair to one tile.
                    unsafe {
                        self.slots.write(pair.slot as usize, *sum);
                        self.written.write(pair.slot as usize, 1);
                    }
                }
            }
        }
        for number in winner.iter().flat_map(|row| row.0) {
            if number >= 0.0 {
                let slot = self.pairs[number as usize].slot as usize;
                // SAFETY: as above.
                unsafe { self.slots.slice(slot, 1)[0][4] += 1.0 };
            }
        }
    }
}

/// Adds one splat's slots to its row, in slot order. Returns (weight, transmittance, hits, dominant, peak).
pub fn total(splat: &Splat, slots: &[[f32; SUMS]], written: &[u8]) -> (f64, f64, u64, u64, f32) {
    let mut sum = (0.0, 0.0, 0, 0, 0f32);
    for slot in splat.slot as usize..(splat.slot + splat.tiles) as usize {
        if written[slot] != 0 {
            let s = &slots[slot];
            sum.0 += f64::from(s[0]);
            sum.1 += f64::from(s[1]);
            sum.2 += s[2] as u64;
            sum.3 += s[4] as u64;
            sum.4 = sum.4.max(s[3]);
        }
    }
    sum
}
