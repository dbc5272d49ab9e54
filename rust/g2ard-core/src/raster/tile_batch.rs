//! Sixty-four of a tile's pairs in the tile's own coordinates, and the blocks of pixels each of them reaches.

use super::bins::Pair;
use super::blocks::{BlockMasks, blocks, row_and_part};
use super::grid::{TileRect, pixel_of};
use super::memory::prefetch;
use super::project::Splat;
use super::simd::{LANES, Lanes, Lanes16, Mask, Vector};
use super::{ALPHA_MIN, BATCH, ROWS, TILE};

/// A tile's splats lie scattered in memory: each is prefetched this many pairs before it is needed.
const AHEAD: usize = 24;

/// A pair's splat relative to the tile's first pixel centre, in one cache line for the loops over pixels.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct TileSplat {
    pub u: f32,
    pub v: f32,
    pub a: f32,
    pub b: f32,
    pub c: f32,
    pub log2_opacity: f32,
    pub rgb: [f32; 3],
    pub depth: f32,
    /// The pair's number within the tile.
    pub number: f32,
}

/// A splat that reaches nothing.
const NOTHING: TileSplat = TileSplat {
    u: 0.0,
    v: 0.0,
    a: 0.0,
    b: 0.0,
    c: 0.0,
    log2_opacity: f32::MIN,
    rgb: [0.0; 3],
    depth: 0.0,
    number: 0.0,
};

impl TileSplat {
    #[inline(always)]
    pub fn new(s: &Splat, rect: &TileRect, number: usize) -> Self {
        // In f64: far from the centre of a needle u is a small difference of large numbers.
        let (dx, dy) = (rect.x as f64 + 0.5 - s.x, rect.y as f64 + 0.5 - s.y);
        Self {
            u: (f64::from(s.a) * dx + f64::from(s.b) * dy) as f32,
            v: (f64::from(s.c) * dy) as f32,
            a: s.a,
            b: s.b,
            c: s.c,
            log2_opacity: s.log2_opacity,
            rgb: s.rgb,
            depth: s.depth,
            number: number as f32,
        }
    }
}

/// A batch's splats, and one more that reaches nothing.
pub type TileSplats = [TileSplat; BATCH + 1];

/// A batch, and its splats' ellipses one field after another.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct TileBatch {
    pub splats: TileSplats,
    a: [f32; BATCH],
    b: [f32; BATCH],
    c: [f32; BATCH],
    log2_opacity: [f32; BATCH],
    centre_x: [f32; BATCH],
    centre_y: [f32; BATCH],
}

impl Default for TileBatch {
    fn default() -> Self {
        let zero = [0.0; BATCH];
        Self {
            splats: [NOTHING; BATCH + 1],
            a: zero,
            b: zero,
            c: zero,
            log2_opacity: zero,
            centre_x: zero,
            centre_y: zero,
        }
    }
}

/// The pixels' coordinates within the tile, row by row.
static COORDINATES: [[Lanes16; 2]; ROWS] = {
    let mut rows = [[Lanes16([0.0; LANES]); 2]; ROWS];
    let mut row = 0;
    while row < ROWS {
        let mut l = 0;
        while l < LANES {
            let (x, y) = pixel_of(row, l);
            rows[row][0].0[l] = x as f32;
            rows[row][1].0[l] = y as f32;
            l += 1;
        }
        row += 1;
    }
    rows
};

/// Calls `visit(pixel, row, lane, how many)` for each stretch of a tile's line that lies in one row of lanes: 4 pixels,
/// but perhaps the last.
#[inline(always)]
pub fn for_stretches(y: usize, columns: usize, mut visit: impl FnMut(usize, usize, usize, usize)) {
    for x in (0..columns).step_by(4) {
        visit(x, y / 4 * 4 + x / 4, y % 4 * 4, (columns - x).min(4));
    }
}

/// The lanes' pixel coordinates within the tile.
#[inline(always)]
pub fn block_coordinates<B: Vector>(block: usize) -> (B, B) {
    let (row, part) = row_and_part::<B>(block);
    let [x, y] = &COORDINATES[row];
    (B::load_part(x, part), B::load_part(y, part))
}

/// Loads a tile's pairs from the `first` on, 64 at most.
#[inline(always)]
pub fn load_batch(
    batch: &mut TileSplats,
    pairs: &[Pair],
    first: usize,
    splats: &[Splat],
    rect: &TileRect,
) {
    let places = batch.iter_mut().take(BATCH);
    for (i, (place, pair)) in (first..).zip(places.zip(&pairs[first..])) {
        if let Some(ahead) = pairs.get(i + AHEAD) {
            prefetch(&splats[ahead.splat as usize]);
        }
        *place = TileSplat::new(&splats[pair.splat as usize], rect, i);
    }
}

impl TileBatch {
    /// Loads a tile's pairs from the `first` on, 64 at most.
    #[inline(always)]
    pub fn load(&mut self, pairs: &[Pair], first: usize, splats: &[Splat], rect: &TileRect) {
        let (x0, y0) = (rect.x as f64 + 0.5, rect.y as f64 + 0.5);
        for (i, pair) in pairs[first..].iter().take(BATCH).enumerate() {
            if let Some(ahead) = pairs.get(first + i + AHEAD) {
                prefetch(&splats[ahead.splat as usize]);
            }
            let s = &splats[pair.splat as usize];
            self.splats[i] = TileSplat::new(s, rect, first + i);
            self.a[i] = s.a;
            self.b[i] = s.b;
            self.c[i] = s.c;
            self.log2_opacity[i] = s.log2_opacity;
            self.centre_x[i] = (s.x - x0) as f32;
            self.centre_y[i] = (s.y - y0) as f32;
        }
    }

    /// Bit p of mask b: whether pair p reaches α = 1/255 anywhere in block b's rectangle of pixel centres. The minimum
    /// of the quadratic over a rectangle lies on one of the two sides nearest to the centre (or is the centre).
    #[inline(always)]
    pub fn reachable<F: Lanes>(&self, count: usize, block_masks: &mut BlockMasks) {
        block_masks[..blocks::<F::Block>()].fill(0);
        let height = F::Block::COUNT / 4;
        let parts = LANES / F::Block::COUNT;
        for first in (0..count).step_by(LANES) {
            // SAFETY: `first` is at most 48 and each array holds 64.
            let [a, b, c, cx, cy, log2_opacity] = unsafe {
                [
                    F::load_at(self.a.as_ptr().add(first)),
                    F::load_at(self.b.as_ptr().add(first)),
                    F::load_at(self.c.as_ptr().add(first)),
                    F::load_at(self.centre_x.as_ptr().add(first)),
                    F::load_at(self.centre_y.as_ptr().add(first)),
                    F::load_at(self.log2_opacity.as_ptr().add(first)),
                ]
            };
            // What an earlier batch left past the end reaches nothing.
            let real = F::Mask::from_bits(((1u32 << (count - first).min(LANES)) - 1) as u16);
            // Slack for the rounding of what follows: too much costs time, never correctness.
            let size = a.fma(cx.abs(), (b.abs() + c) * cy.abs());
            let level = log2_opacity - F::splat(ALPHA_MIN.log2() - 0.01);
            let level = F::select(real, size.fma(F::splat(2e-6), level), F::splat(-1.0));
            // For fixed dx the best dy is dx·down; for fixed dy the best dx is dy·across.
            let down = -(a * b) / b.fma(b, c * c);
            let across = -b / a;
            for line in 0..TILE / height {
                let top = F::splat((height * line) as f32) - cy;
                let bottom = top + F::splat((height - 1) as f32);
                let near_y = top.max(F::zero().min(bottom));
                for column in 0..4 {
                    let left = F::splat((4 * column) as f32) - cx;
                    let right = left + F::splat(3.0);
                    let near_x = left.max(F::zero().min(right));
                    let dy = (near_x * down).max(top).min(bottom);
                    let dx = (near_y * across).max(left).min(right);
                    let (u1, v1) = (a.fma(near_x, b * dy), c * dy);
                    let (u2, v2) = (a.fma(dx, b * near_y), c * near_y);
                    let least = u1.fma(u1, v1 * v1).min(u2.fma(u2, v2 * v2));
                    let hit = level.ge(least).bits();
                    let block = (line / parts * 4 + column) * parts + line % parts;
                    block_masks[block] |= u64::from(hit) << first;
                }
            }
        }
    }
}

/// log2 α before clipping, for the pixels (x, y) of a block.
#[inline(always)]
pub fn log2_alpha<F: Vector>(s: &TileSplat, x: F, y: F) -> (F, F, F) {
    let u = F::splat(s.a).fma(x, F::splat(s.b).fma(y, F::splat(s.u)));
    let v = F::splat(s.c).fma(y, F::splat(s.v));
    (u, v, u.fnma(u, v.fnma(v, F::splat(s.log2_opacity))))
}

/// α before clipping where its log2 is above the minimum; elsewhere any value, even NaN, to be masked.
#[inline(always)]
pub fn alpha<F: Vector>(log2: F) -> F {
    log2.exp2()
}

#[cfg(test)]
mod tests {
    use super::super::simd::{Isa, Kernel, dispatch};
    use super::*;
    use crate::random::Lcg;

    struct Reachable<'a>(&'a TileBatch, usize);

    impl Kernel for Reachable<'_> {
        /// The masks, and the lines of a block's pixels.
        type Output = (BlockMasks, usize);
        #[inline(always)]
        fn run<F: Lanes>(self) -> Self::Output {
            let mut block_masks = BlockMasks::default();
            self.0.reachable::<F>(self.1, &mut block_masks);
            (block_masks, F::Block::COUNT / 4)
        }
    }

    #[test]
    #[cfg_attr(
        miri,
        ignore = "tens of millions of points; holds no unsafe code of its own"
    )]
    fn block_masks_miss_no_pixel_and_little_else() {
        let mut source = Lcg(3);
        let mut random = || source.uniform_f32();
        let rect = TileRect {
            x: 32,
            y: 16,
            columns: 16,
            rows: 16,
        };
        for isa in Isa::available() {
            let (mut hit, mut extra) = (0, 0);
            for _ in 0..50 {
                let splats: Vec<Splat> = (0..50)
                    .map(|_| {
                        let a = 0.05 * 30f32.powf(random());
                        Splat {
                            x: f64::from(random() * 40.0 + 20.0),
                            y: f64::from(random() * 40.0 + 4.0),
                            a,
                            b: a * (random() - 0.5) * 4.0,
                            c: 0.05 * 30f32.powf(random()),
                            log2_opacity: -random() * 7.0,
                            ..Splat::default()
                        }
                    })
                    .collect();
                let pairs: Vec<Pair> = (0..50).map(|splat| Pair { splat, slot: 0 }).collect();
                let mut tile_batch = TileBatch::default();
                tile_batch.load(&pairs, 0, &splats, &rect);
                let (masks, height) = dispatch(isa, Reachable(&tile_batch, pairs.len()));
                let parts = 4 / height;
                for (p, s) in splats.iter().enumerate() {
                    for (block, word) in masks.iter().take(ROWS * parts).enumerate() {
                        let (x, y) = pixel_of(block / parts, block % parts * 4 * height);
                        // Twenty points to a pixel: the rectangle of pixel centres, not only the centres.
                        let touched = (0..=60).any(|i| {
                            (0..=20 * (height - 1)).any(|j| {
                                let x = 32.5 + x as f64 + 0.05 * f64::from(i);
                                let y = 16.5 + y as f64 + 0.05 * j as f64;
                                let u = f64::from(s.a) * (x - s.x) + f64::from(s.b) * (y - s.y);
                                let v = f64::from(s.c) * (y - s.y);
                                f64::from(s.log2_opacity) - u * u - v * v
                                    >= f64::from(ALPHA_MIN.log2())
                            })
                        });
                        let got = word >> p & 1 == 1;
                        assert!(got || !touched, "{s:?} block {block}");
                        hit += usize::from(touched);
                        extra += usize::from(got && !touched);
                    }
                }
                assert!(masks.iter().all(|w| w >> 50 == 0));
            }
            assert!(
                hit > 2_500 && extra * 50 < hit,
                "{extra} blocks too many of {hit}"
            );
        }
    }
}
