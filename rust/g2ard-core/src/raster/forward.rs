//! Blending one tile from front to back: per batch of 64 pairs, per 4×4 block, the block's state in registers.

use super::project::Splat;
use super::simd::{Kernel, LANES, Lanes, Mask, Row};
use super::tiles::Pair;
use super::{ALPHA_MIN, BLOCKS, Settings, TILE};

/// Pairs looked at together: a bit each in a block's word.
pub const BATCH: usize = 64;

/// A tile's splats lie scattered in memory: each is asked for this many pairs before it is needed.
const AHEAD: usize = 24;

#[inline(always)]
fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a prefetch of a valid address has no effect but on the cache.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

/// A batch's splats relative to the tile's first pixel centre, one field after another.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct Staged {
    pub u: [f32; BATCH],
    pub v: [f32; BATCH],
    pub a: [f32; BATCH],
    pub b: [f32; BATCH],
    pub c: [f32; BATCH],
    pub log2_opacity: [f32; BATCH],
    pub rgb: [[f32; BATCH]; 3],
    pub depth: [f32; BATCH],
    centre_x: [f32; BATCH],
    centre_y: [f32; BATCH],
    level: [f32; BATCH],
}

impl Default for Staged {
    fn default() -> Self {
        let zero = [0.0; BATCH];
        Self {
            u: zero,
            v: zero,
            a: zero,
            b: zero,
            c: zero,
            log2_opacity: zero,
            rgb: [zero; 3],
            depth: zero,
            centre_x: zero,
            centre_y: zero,
            level: [-1.0; BATCH],
        }
    }
}

/// A tile's place in the image.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// Its first pixel.
    pub x: usize,
    pub y: usize,
    /// How many of its 16 columns and rows are on the image.
    pub columns: usize,
    pub rows: usize,
}

impl Place {
    pub fn of(tile: usize, tiles_x: usize, width: usize, height: usize) -> Self {
        let (x, y) = (tile % tiles_x * TILE, tile / tiles_x * TILE);
        Self {
            x,
            y,
            columns: (width - x).min(TILE),
            rows: (height - y).min(TILE),
        }
    }

    /// The lanes of a block that are on the image.
    pub fn lanes(&self, block: usize) -> u16 {
        let mut bits = 0;
        for l in 0..LANES {
            let (x, y) = block_pixel(block, l);
            bits |= u16::from(x < self.columns && y < self.rows) << l;
        }
        bits
    }
}

/// The pixel of a block's lane, relative to the tile.
#[inline(always)]
pub fn block_pixel(block: usize, lane: usize) -> (usize, usize) {
    (block % 4 * 4 + lane % 4, block / 4 * 4 + lane / 4)
}

/// The pixels' coordinates within the tile, block by block.
static COORDINATES: [[Row; 2]; BLOCKS] = {
    let mut rows = [[Row([0.0; LANES]); 2]; BLOCKS];
    let mut block = 0;
    while block < BLOCKS {
        let mut l = 0;
        while l < LANES {
            rows[block][0].0[l] = (block % 4 * 4 + l % 4) as f32;
            rows[block][1].0[l] = (block / 4 * 4 + l / 4) as f32;
            l += 1;
        }
        block += 1;
    }
    rows
};

/// The lanes' pixel coordinates within the tile.
#[inline(always)]
pub fn block_coordinates<F: Lanes>(block: usize) -> (F, F) {
    let [x, y] = &COORDINATES[block];
    (F::load(x), F::load(y))
}

impl Staged {
    /// Loads the first 64 pairs; if there are fewer, the rest of the batch is made unreachable.
    pub fn load(&mut self, pairs: &[Pair], splats: &[Splat], place: &Place) {
        let (x0, y0) = (place.x as f64 + 0.5, place.y as f64 + 0.5);
        for (i, pair) in pairs.iter().take(BATCH).enumerate() {
            if let Some(ahead) = pairs.get(i + AHEAD) {
                prefetch(&splats[ahead.splat as usize]);
            }
            let s = &splats[pair.splat as usize];
            let (dx, dy) = (x0 - s.x, y0 - s.y);
            // In f64: far from the centre of a needle u is a small difference of large numbers.
            self.u[i] = (f64::from(s.a) * dx + f64::from(s.b) * dy) as f32;
            self.v[i] = (f64::from(s.c) * dy) as f32;
            self.a[i] = s.a;
            self.b[i] = s.b;
            self.c[i] = s.c;
            self.log2_opacity[i] = s.log2_opacity;
            self.rgb[0][i] = s.rgb[0];
            self.rgb[1][i] = s.rgb[1];
            self.rgb[2][i] = s.rgb[2];
            self.depth[i] = s.depth;
            let (cx, cy) = (-dx as f32, -dy as f32);
            self.centre_x[i] = cx;
            self.centre_y[i] = cy;
            // Room for the rounding of what `reachable` computes: more than enough costs time, never correctness.
            let size = s.a * cx.abs() + (s.b.abs() + s.c) * cy.abs();
            self.level[i] = s.log2_opacity - ALPHA_MIN.log2() + 0.01 + 2e-6 * size;
        }
        for i in pairs.len().min(BATCH)..BATCH {
            self.level[i] = -1.0;
        }
    }

    /// Bit p of word b: whether pair p reaches α = 1/255 anywhere in block b's rectangle of pixel centres. The minimum
    /// of the quadratic over a rectangle lies on one of the two sides nearest to the centre (or is the centre).
    #[inline(always)]
    pub fn reachable<F: Lanes>(&self, count: usize, words: &mut [u64; BLOCKS]) {
        *words = [0; BLOCKS];
        for first in (0..count).step_by(LANES) {
            // SAFETY: `first` is at most 48 and each array holds 64.
            let [a, b, c, cx, cy, level] = unsafe {
                [
                    F::load_at(self.a.as_ptr().add(first)),
                    F::load_at(self.b.as_ptr().add(first)),
                    F::load_at(self.c.as_ptr().add(first)),
                    F::load_at(self.centre_x.as_ptr().add(first)),
                    F::load_at(self.centre_y.as_ptr().add(first)),
                    F::load_at(self.level.as_ptr().add(first)),
                ]
            };
            // For fixed dx the best dy is dx·down; for fixed dy the best dx is dy·across.
            let down = -(a * b) / b.fma(b, c * c);
            let across = -b / a;
            for row in 0..4 {
                let top = F::splat((4 * row) as f32) - cy;
                let bottom = top + F::splat(3.0);
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
                    words[row * 4 + column] |= u64::from(hit) << first;
                }
            }
        }
    }
}

/// log2 α before clipping, for the pixels (x, y) of a block.
#[inline(always)]
pub fn log2_alpha<F: Lanes>(s: &Staged, p: usize, x: F, y: F) -> (F, F, F) {
    let u = F::splat(s.a[p]).fma(x, F::splat(s.b[p]).fma(y, F::splat(s.u[p])));
    let v = F::splat(s.c[p]).fma(y, F::splat(s.v[p]));
    (u, v, u.fnma(u, v.fnma(v, F::splat(s.log2_opacity[p]))))
}

/// α before clipping, where its log2 is above the minimum; elsewhere anything, even NaN: to be masked.
#[inline(always)]
pub fn alpha<F: Lanes>(log2: F) -> F {
    log2.exp2()
}

/// One tile's pixels, a row of 16 lanes per block.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pixels {
    pub rgb: [[Row; BLOCKS]; 3],
    pub depth: [Row; BLOCKS],
    /// Depth of the first splat behind which less than half the light is left; 0 if there is none.
    pub median: [Row; BLOCKS],
}

/// Blends a tile. Leaves in `words` the pairs that really contributed, block by block.
pub struct Forward<'a, const DEPTH: bool> {
    pub pairs: &'a [Pair],
    pub splats: &'a [Splat],
    pub place: Place,
    pub settings: &'a Settings,
    /// 16 words for each batch.
    pub words: &'a mut [[u64; BLOCKS]],
    pub transmittance: &'a mut [Row; BLOCKS],
    /// Number within the tile of each pixel's last pair, −1 for none.
    pub last: &'a mut [Row; BLOCKS],
    pub pixels: &'a mut Pixels,
    pub staged: &'a mut Staged,
}

impl<const DEPTH: bool> Kernel for Forward<'_, DEPTH> {
    /// Batches looked at before every pixel had stopped.
    type Output = usize;

    #[inline(always)]
    fn run<F: Lanes>(self) -> usize {
        *self.pixels = Pixels::default();
        *self.transmittance = [Row([1.0; LANES]); BLOCKS];
        *self.last = [Row([-1.0; LANES]); BLOCKS];
        // The light that would be left if nothing ever stopped. A stopped pixel's only falls further below the
        // minimum, so "would it stop here" needs no memory, and the loop below waits for nothing but one product.
        // Pixels off the image start without light.
        let mut unstopped = [Row::default(); BLOCKS];
        for b in 0..BLOCKS {
            F::splat(1.0)
                .only(F::Mask::from_bits(self.place.lanes(b)))
                .store(&mut unstopped[b]);
        }
        let minimum = F::splat(ALPHA_MIN.log2());
        let clip = F::splat(self.settings.alpha_max);
        let stop = F::splat(self.settings.transmittance_min);
        let half = F::splat(0.5);
        for (batch, words) in self.words.iter_mut().enumerate() {
            let first = batch * BATCH;
            let pairs = &self.pairs[first..self.pairs.len().min(first + BATCH)];
            self.staged
                .load(&self.pairs[first..], self.splats, &self.place);
            let s = &*self.staged;
            s.reachable::<F>(pairs.len(), words);
            let mut any = false;
            for block in 0..BLOCKS {
                let mut todo = words[block];
                let mut t = F::load(&unstopped[block]);
                if todo == 0 || !t.gt(stop).any() {
                    any |= t.gt(stop).any();
                    words[block] = 0;
                    continue;
                }
                let mut kept = 0u64;
                let (x, y) = block_coordinates::<F>(block);
                let mut left = F::load(&self.transmittance[block]);
                let mut last = F::load(&self.last[block]);
                let px = &mut *self.pixels;
                let mut rgb = [
                    F::load(&px.rgb[0][block]),
                    F::load(&px.rgb[1][block]),
                    F::load(&px.rgb[2][block]),
                ];
                let mut depth = F::load(&px.depth[block]);
                let mut median = F::load(&px.median[block]);
                let mut light = true;
                while todo != 0 && light {
                    let p = todo.trailing_zeros() as usize;
                    todo &= todo - 1;
                    let (_, _, log2) = log2_alpha(s, p, x, y);
                    let hit = log2.ge(minimum);
                    let a = alpha(log2).min(clip).only(hit);
                    let next = a.fnma(t, t);
                    let going = next.gt(stop);
                    let w = (a * t).only(going);
                    for c in 0..3 {
                        rgb[c] = F::splat(s.rgb[c][p]).fma(w, rgb[c]);
                    }
                    let go = hit.and(going);
                    if DEPTH {
                        let z = F::splat(s.depth[p]);
                        depth = z.fma(w, depth);
                        median = F::select(go.and(t.ge(half)).and(half.gt(next)), z, median);
                    }
                    t = next;
                    left = F::select(going, next, left);
                    last = F::select(go, F::splat((first + p) as f32), last);
                    kept |= u64::from(go.any()) << p;
                    light = going.any();
                }
                words[block] = kept;
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
        self.words.len()
    }
}

#[cfg(test)]
mod tests {
    use super::super::simd::{Isa, dispatch};
    use super::*;

    struct Reachable<'a>(&'a Staged, usize);

    impl Kernel for Reachable<'_> {
        type Output = [u64; BLOCKS];
        #[inline(always)]
        fn run<F: Lanes>(self) -> [u64; BLOCKS] {
            let mut words = [0; BLOCKS];
            self.0.reachable::<F>(self.1, &mut words);
            words
        }
    }

    #[test]
    fn block_masks_miss_no_pixel_and_little_else() {
        let mut state = 3u64;
        let mut random = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 24) as f32
        };
        let place = Place {
            x: 32,
            y: 16,
            columns: 16,
            rows: 16,
        };
        let (mut hit, mut extra) = (0, 0);
        for _ in 0..100 {
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
            let mut staged = Staged::default();
            staged.load(&pairs, &splats, &place);
            let words = dispatch(Isa::detect(), Reachable(&staged, pairs.len()));
            for (p, s) in splats.iter().enumerate() {
                for (block, word) in words.iter().enumerate() {
                    // Twenty points to a pixel: the rectangle of pixel centres, not only the centres.
                    let touched = (0..=60).any(|i| {
                        (0..=60).any(|j| {
                            let x = 32.5 + (block % 4 * 4) as f64 + 0.05 * f64::from(i);
                            let y = 16.5 + (block / 4 * 4) as f64 + 0.05 * f64::from(j);
                            let u = f64::from(s.a) * (x - s.x) + f64::from(s.b) * (y - s.y);
                            let v = f64::from(s.c) * (y - s.y);
                            f64::from(s.log2_opacity) - u * u - v * v >= f64::from(ALPHA_MIN.log2())
                        })
                    });
                    let got = word >> p & 1 == 1;
                    assert!(got || !touched, "{s:?} block {block}");
                    hit += usize::from(touched);
                    extra += usize::from(got && !touched);
                }
            }
            assert!(words.iter().all(|w| w >> 50 == 0));
        }
        assert!(
            hit > 5_000 && extra * 50 < hit,
            "{extra} blocks too many of {hit}"
        );
    }
}
