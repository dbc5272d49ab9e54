//! Sensitivity of a view to each Gaussian's mean and size: F = Σ over pixels and channels of g gᵀ, g = ∂C/∂(mean,
//! log scale), 6×6 a Gaussian. Pruning by sensitivity (PUP 3D-GS) ranks by it.
//!
//! At a pixel, g is linear in φ = (u, v, u², uv, v²): g = L·(h φ) + w·d, with h = ∂C/∂(ln α), w = αT, and L (6×5) and d
//! (by the viewing direction in SH) the same for every pixel of a view. So a pixel adds to moments of u and v only.

use super::blocks::{BlockMasks, blocks, row_and_part};
use super::disjoint::DisjointSlice;
use super::params::Source;
use super::project::{ScreenGradients, Splat, View, unproject};
use super::simd::{Kernel, LANES, Lanes, Lanes16, Mask, Real, Vector};
use super::tile_batch::{
    BATCH, TileRect, TileSplats, alpha, block_coordinates, load_batch, log2_alpha,
};
use super::tiles::Pair;
use super::{ALPHA_MIN, ROWS, Settings};

/// Values of the upper triangle of a 6×6 matrix.
pub const TRIANGLE: usize = 21;

/// A pair's sums: Σ h²·uⁱvʲ for 2 ≤ i + j ≤ 4, Σ h_c·w·φ for each channel, Σ w²; the rest is padding.
pub const MOMENTS: usize = 30;
const BY_CHANNEL: usize = 12;
const WEIGHT: usize = 27;

/// Positions of φᵢφⱼ among the first moments: u², uv, v², u³, u²v, uv², v³, u⁴, u³v, u²v², uv³, v⁴.
const PRODUCT: [[usize; 5]; 5] = [
    [0, 1, 3, 4, 5],
    [1, 2, 4, 5, 6],
    [3, 4, 7, 8, 9],
    [4, 5, 8, 9, 10],
    [5, 6, 9, 10, 11],
];

#[derive(Clone, Copy, Default)]
struct Row {
    transmittance: Lanes16,
    /// The colour behind, as if unoccluded.
    behind: [Lanes16; 3],
    last: Lanes16,
}

/// One tile from back to front; every pair's sums go to its own slot.
pub struct Sensitivity<'a> {
    pub pairs: &'a [Pair],
    pub splats: &'a [Splat],
    pub rect: TileRect,
    pub settings: &'a Settings,
    /// From the forward pass.
    pub block_masks: &'a [BlockMasks],
    pub transmittance: &'a [Lanes16; ROWS],
    pub last: &'a [Lanes16; ROWS],
    pub batch: &'a mut TileSplats,
    pub slots: DisjointSlice<[f32; MOMENTS]>,
    pub written: DisjointSlice<u8>,
}

impl Kernel for Sensitivity<'_> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let mut state = [Row::default(); ROWS];
        for (row, g) in state.iter_mut().enumerate() {
            g.transmittance = self.transmittance[row];
            g.last = self.last[row];
        }
        let minimum = F::Block::splat(ALPHA_MIN.log2());
        let clip = F::Block::splat(self.settings.alpha_max);
        for (batch, block_masks) in self.block_masks.iter().enumerate().rev() {
            let mut union = block_masks[..blocks::<F::Block>()]
                .iter()
                .fold(0, |all, word| all | word);
            if union == 0 {
                continue;
            }
            let first = batch * BATCH;
            let pairs = &self.pairs[first..self.pairs.len().min(first + BATCH)];
            load_batch(self.batch, self.pairs, first, self.splats, &self.rect);
            while union != 0 {
                let p = 63 - union.leading_zeros() as usize;
                union ^= 1 << p;
                let near = &self.batch[p];
                let number = F::Block::splat(near.number);
                let mut sums = [F::Block::zero(); MOMENTS];
                for block in 0..blocks::<F::Block>() {
                    if block_masks[block] >> p & 1 == 0 {
                        continue;
                    }
                    let (row, part) = row_and_part::<F::Block>(block);
                    let g = &mut state[row];
                    let on_image = self.rect.lanes(row) >> (part * F::Block::COUNT);
                    let on_image = <F::Block as Real>::Mask::from_bits(on_image);
                    let (x, y) = block_coordinates::<F::Block>(block);
                    let (u, v, log2) = log2_alpha(near, x, y);
                    let hit = log2
                        .ge(minimum)
                        .and(F::Block::load_part(&g.last, part).ge(number));
                    let raw = alpha(log2);
                    let a = raw.min(clip).only(hit.and(on_image));
                    let t = F::Block::load_part(&g.transmittance, part)
                        * (F::Block::splat(1.0) - a).recip();
                    t.store_part(&mut g.transmittance, part);
                    let w = a * t;
                    // A clipped α does not depend on its arguments.
                    let follows = w.only(clip.ge(raw));
                    let (uu, uv, vv) = (u * u, u * v, v * v);
                    let phi = [u, v, uu, uv, vv];
                    let mut square = F::Block::zero();
                    for c in 0..3 {
                        let behind = F::Block::load_part(&g.behind[c], part);
                        let gain = F::Block::splat(near.rgb[c]) - behind;
                        a.fma(gain, behind).store_part(&mut g.behind[c], part);
                        let h = follows * gain;
                        square = h.fma(h, square);
                        let hw = h * w;
                        for (k, value) in phi.iter().enumerate() {
                            let at = BY_CHANNEL + 5 * c + k;
                            sums[at] = hw.fma(*value, sums[at]);
                        }
                    }
                    for (sum, moment) in sums.iter_mut().zip(moments(square, u, v)) {
                        *sum = *sum + moment;
                    }
                    sums[WEIGHT] = w.fma(w, sums[WEIGHT]);
                }
                let slot = pairs[p].slot as usize;
                // SAFETY: a slot belongs to one pair, and a pair to one tile.
                unsafe {
                    let out = &mut self.slots.slice(slot, 1)[0];
                    for (part, sums) in out.chunks_exact_mut(10).zip(sums.as_chunks::<10>().0) {
                        part.copy_from_slice(&F::Block::sums(sums).0[..10]);
                    }
                    self.written.write(slot, 1);
                }
            }
        }
    }
}

/// h²·uⁱvʲ, in the order that [`PRODUCT`] names.
#[inline(always)]
fn moments<F: Vector>(square: F, u: F, v: F) -> [F; BY_CHANNEL] {
    let (uu, uv, vv) = (u * u, u * v, v * v);
    let (suu, svv) = (square * u * u, square * v * v);
    [
        suu,
        square * u * v,
        svv,
        suu * u,
        suu * v,
        svv * u,
        svv * v,
        suu * uu,
        suu * uv,
        suu * vv,
        svv * uv,
        svv * vv,
    ]
}

/// Adds up the slots of one chunk's splats and adds every row's F to `out`, 21 values a row.
pub struct GatherSensitivity<'a, S: Source> {
    pub view: &'a View,
    pub source: S,
    /// One chunk's visible splats, in row order, and their slots.
    pub splats: &'a [Splat],
    pub slots: &'a [[f32; MOMENTS]],
    pub written: &'a [u8],
    pub out: DisjointSlice<f64>,
}

impl<S: Source> Kernel for GatherSensitivity<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        for splats in self
            .splats
            .chunk_by(|a, b| a.row as usize / LANES == b.row as usize / LANES)
        {
            let group = splats[0].row as usize / LANES;
            let mut found = None;
            for splat in splats {
                let Some(moments) = total(splat, self.slots, self.written) else {
                    continue;
                };
                // Most groups of a small image touch no pixel.
                let columns =
                    found.get_or_insert_with(|| columns::<F, S>(self.view, &self.source, group));
                let row = splat.row as usize;
                // SAFETY: rows belong to one chunk each.
                let out = unsafe { self.out.slice(row * TRIANGLE, TRIANGLE) };
                add(&moments, columns, row % LANES, out);
            }
        }
    }
}

fn total(splat: &Splat, slots: &[[f32; MOMENTS]], written: &[u8]) -> Option<[f64; MOMENTS]> {
    let mut sum = [0.0; MOMENTS];
    let mut any = false;
    for slot in splat.slot as usize..(splat.slot + splat.tiles) as usize {
        if written[slot] != 0 {
            any = true;
            for k in 0..MOMENTS {
                sum[k] += f64::from(slots[slot][k]);
            }
        }
    }
    any.then_some(sum)
}

/// Sixteen Gaussians' L, column by column, then their d of each channel: where a unit of each would push the
/// parameters. `[column][parameter]`.
#[inline(always)]
fn columns<F: Lanes, S: Source>(view: &View, source: &S, group: usize) -> [[Lanes16; 6]; 8] {
    let mut out = [[Lanes16::default(); 6]; 8];
    // Without higher bands colour does not follow the direction: the last three stay zero.
    let lively = if source.sh_coeffs() > 1 { 8 } else { 5 };
    for (k, column) in out.iter_mut().enumerate().take(lively) {
        let mut unit = ScreenGradients {
            moments: [F::zero(); 6],
            rgb: [F::zero(); 3],
            depth: F::zero(),
        };
        if k < 5 {
            unit.moments[k + 1] = F::splat(1.0);
        } else {
            unit.rgb[k - 5] = F::splat(1.0);
        }
        let g = unproject::<F, S>(view, source, group, &unit);
        for i in 0..3 {
            g.mean[i].store(&mut column[i]);
            g.log_scale[i].store(&mut column[i + 3]);
        }
    }
    out
}

/// F += L M Lᵀ + Σ_c (L k_c d_cᵀ + d_c k_cᵀ Lᵀ) + Σ w²·Σ_c d_c d_cᵀ.
fn add(moments: &[f64; MOMENTS], columns: &[[Lanes16; 6]; 8], lane: usize, out: &mut [f64]) {
    let mut weights = [[0.0; 8]; 8];
    for i in 0..5 {
        for j in 0..5 {
            weights[i][j] = moments[PRODUCT[i][j]];
        }
        for c in 0..3 {
            weights[i][5 + c] = moments[BY_CHANNEL + 5 * c + i];
            weights[5 + c][i] = weights[i][5 + c];
        }
    }
    for c in 5..8 {
        weights[c][c] = moments[WEIGHT];
    }
    let l = columns.map(|column| column.map(|row| f64::from(row.0[lane])));
    let mut at = 0;
    for a in 0..6 {
        let mut left = [0.0; 8];
        for (j, left) in left.iter_mut().enumerate() {
            for i in 0..8 {
                *left += l[i][a] * weights[i][j];
            }
        }
        for b in a..6 {
            for j in 0..8 {
                out[at] += left[j] * l[j][b];
            }
            at += 1;
        }
    }
}
