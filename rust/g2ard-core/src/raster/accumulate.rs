//! The contribution of each Gaussian to a view: sums for visibility, pruning and counting.

use rayon::prelude::*;

use super::BATCH;
use super::bins::Pair;
use super::blocks::{MOST_BLOCKS, blocks, by_pair, row_and_part};
use super::disjoint::DisjointSlice;
use super::grid::TileRect;
use super::params::Params;
use super::project::Splat;
use super::simd::{Kernel, LANES, Lanes, Lanes16, Mask, Real, Vector};
use super::tile_batch::{TileBatch, alpha, block_coordinates, log2_alpha};
use super::{ALPHA_MIN, Camera, ROWS, Settings};

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

/// Sums that threads add to, each to its own rows.
#[derive(Clone, Copy)]
pub(super) struct SharedSums<'a> {
    weight: DisjointSlice<'a, f64>,
    transmittance: DisjointSlice<'a, f64>,
    hits: DisjointSlice<'a, u64>,
    dominant: DisjointSlice<'a, u64>,
    peak: DisjointSlice<'a, f32>,
}

impl<'a> SharedSums<'a> {
    pub fn new(sums: &'a mut Accumulated) -> Self {
        Self {
            weight: DisjointSlice::new(&mut sums.weight),
            transmittance: DisjointSlice::new(&mut sums.transmittance),
            hits: DisjointSlice::new(&mut sums.hits),
            dominant: DisjointSlice::new(&mut sums.dominant),
            peak: DisjointSlice::new(&mut sums.peak),
        }
    }

    /// # Safety
    /// The sums are still there, have the row, and no other thread touches it meanwhile.
    pub unsafe fn add(self, row: usize, total: &Total) {
        // SAFETY: the caller's promise.
        unsafe {
            *self.weight.at(row) += total.weight;
            *self.transmittance.at(row) += total.transmittance;
            *self.hits.at(row) += total.hits;
            *self.dominant.at(row) += total.dominant;
            let peak = self.peak.at(row);
            *peak = (*peak).max(total.peak);
        }
    }
}

/// Number of sums per pair: only Σ αT², as its weight, or Σ αT with transmittance, hits, dominant and peak.
pub const SQUARED: usize = 1;
pub const ALL: usize = 5;

/// A row of lanes' state from front to back; values of one pair are adjacent.
#[derive(Clone, Copy)]
struct Row {
    /// The light that would remain if no pixel ever stopped: see the forward kernel.
    unstopped: Lanes16,
    /// The largest αT so far, and the number of its pair, −1 for none.
    most: Lanes16,
    winner: Lanes16,
}

/// Blends one tile from front to back without an image: only every pair's `KINDS` sums, each in its own slot.
pub struct Accumulate<'a, const KINDS: usize> {
    pub pairs: &'a [Pair],
    pub splats: &'a [Splat],
    pub rect: TileRect,
    pub settings: &'a Settings,
    pub tile_batch: &'a mut TileBatch,
    pub slots: DisjointSlice<'a, [f32; KINDS]>,
    pub written: DisjointSlice<'a, u8>,
}

impl<const KINDS: usize> Kernel for Accumulate<'_, KINDS> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let minimum = F::Block::splat(ALPHA_MIN.log2());
        let clip = F::Block::splat(self.settings.alpha_max);
        let stop = F::Block::splat(self.settings.transmittance_min);
        let mut rows = [Row {
            unstopped: Lanes16::default(),
            most: Lanes16::default(),
            winner: Lanes16([-1.0; LANES]),
        }; ROWS];
        for (row, light) in rows.iter_mut().zip(self.rect.light()) {
            row.unstopped = light;
        }
        let mut block_masks = [0; MOST_BLOCKS];
        let mut lit = (u64::MAX >> (64 - blocks::<F::Block>())) as u32;
        for first in (0..self.pairs.len()).step_by(BATCH) {
            let pairs = &self.pairs[first..self.pairs.len().min(first + BATCH)];
            self.tile_batch
                .load(self.pairs, first, self.splats, &self.rect);
            let s = &*self.tile_batch;
            s.reachable::<F>(pairs.len(), &mut block_masks);
            let masks = by_pair::<F::Block>(&block_masks);
            for (p, pair) in pairs.iter().enumerate() {
                let mut todo = masks[p] & lit;
                let number = F::Block::splat(s.splats[p].number);
                let [mut weight, mut light, mut peak] = [F::Block::zero(); 3];
                let mut hits = 0;
                while todo != 0 {
                    let b = todo.trailing_zeros() as usize;
                    todo &= todo - 1;
                    let (b_row, part) = row_and_part::<F::Block>(b);
                    let row = &mut rows[b_row];
                    let (x, y) = block_coordinates::<F::Block>(b);
                    let (_, _, log2) = log2_alpha(&s.splats[p], x, y);
                    let hit = log2.ge(minimum);
                    let a = alpha(log2).min(clip).only(hit);
                    let t = F::Block::load_part(&row.unstopped, part);
                    let next = a.fnma(t, t);
                    next.store_part(&mut row.unstopped, part);
                    let going = next.gt(stop); // pixels that the splat does not stop
                    if !going.any() {
                        lit &= !(1 << b);
                        continue;
                    }
                    let shown = hit.and(going);
                    let w = (a * t).only(shown);
                    hits += shown.bits().count_ones();
                    if KINDS == SQUARED {
                        weight = w.fma(t, weight);
                    } else {
                        weight = weight + w;
                        let most = F::Block::load_part(&row.most, part);
                        let winner = F::Block::load_part(&row.winner, part);
                        F::Block::select(w.gt(most), number, winner)
                            .store_part(&mut row.winner, part);
                        most.max(w).store_part(&mut row.most, part);
                        light = light + t.only(shown);
                        peak = peak.max(w);
                    }
                }
                if hits > 0 {
                    let share = share(weight, light, hits, peak);
                    // SAFETY: a slot belongs to one pair, and a pair to one tile.
                    unsafe {
                        self.slots.write(pair.slot as usize, share);
                        self.written.write(pair.slot as usize, 1);
                    }
                }
            }
            if lit == 0 {
                break;
            }
        }
        for number in rows.iter().flat_map(|row| row.winner.0) {
            if KINDS == ALL && number >= 0.0 {
                let slot = self.pairs[number as usize].slot as usize;
                // SAFETY: as above.
                unsafe { self.slots.slice(slot, 1)[0][3] += 1.0 };
            }
        }
    }
}

/// A pair's sums; those of `dominant` come last.
#[inline(always)]
fn share<const KINDS: usize, B: Vector>(weight: B, light: B, hits: u32, peak: B) -> [f32; KINDS] {
    let mut share = [folded(weight, add); KINDS];
    if KINDS == ALL {
        share[1] = folded(light, add);
        share[2] = hits as f32;
        share[3] = 0.0;
        share[4] = folded(peak, larger);
    }
    share
}

#[inline(always)]
fn add(a: f32, b: f32) -> f32 {
    a + b
}

#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// All lanes as one value, halves first.
#[inline(always)]
fn folded<B: Vector>(lanes: B, with: impl Fn(f32, f32) -> f32) -> f32 {
    let mut row = Lanes16::default();
    lanes.store_part(&mut row, 0);
    let mut half = B::COUNT / 2;
    while half > 0 {
        for l in 0..half {
            row.0[l] = with(row.0[l], row.0[l + half]);
        }
        half /= 2;
    }
    row.0[0]
}

/// One Gaussian's sums over a view: see [`Accumulated`]. Sums that were not requested are zero.
#[derive(Debug, Clone, Copy, Default)]
pub struct Total {
    pub weight: f64,
    pub transmittance: f64,
    pub hits: u64,
    pub dominant: u64,
    pub peak: f32,
}

impl Total {
    /// Adds up one splat's slots, in slot order.
    pub fn of<const KINDS: usize>(splat: &Splat, slots: &[[f32; KINDS]], written: &[u8]) -> Self {
        let mut sum = Self::default();
        for slot in splat.slot as usize..(splat.slot + splat.tiles) as usize {
            if written[slot] != 0 {
                let s = &slots[slot];
                sum.weight += f64::from(s[0]);
                if KINDS == ALL {
                    sum.transmittance += f64::from(s[1]);
                    sum.hits += s[2] as u64;
                    sum.dominant += s[3] as u64;
                    sum.peak = sum.peak.max(s[4]);
                }
            }
        }
        sum
    }
}

/// Lowers each row's pixel size to that of this view.
pub fn smallest_pixels(params: &Params, camera: &Camera, sizes: &mut [f32]) {
    let means = params.means.as_chunks::<3>().0;
    sizes.par_iter_mut().zip(means).for_each(|(size, mean)| {
        camera.lower_pixel_size(mean.map(f64::from), size);
    });
}
