//! The fused loss on one tile of the image.

use std::ops::Range;

use crate::raster::disjoint::DisjointSlice;
use crate::raster::simd::{Kernel, LANES, Lanes, Lanes16, Mask};
use crate::ssim::{C1, C2, RADIUS, Shape, TAPS};

/// Rows computed together: a window reaches one group up and one down, so that two groups of rows blur down to one.
const GROUP: usize = 2 * RADIUS;
/// x, e, x² + y² and e² are blurred going forward; three derivatives going back.
const FORWARD: usize = 4;
const BACK: usize = 3;

/// Reach of the window along a row, in whole lanes.
fn margin(shape: Shape) -> usize {
    (RADIUS * shape.channels).next_multiple_of(LANES)
}

/// Length of the scratch memory, in values, of a tile of `columns`.
pub fn scratch_len(shape: Shape, columns: usize) -> usize {
    let (columns, margin) = (columns.next_multiple_of(LANES), margin(shape));
    let derived = columns + 2 * margin;
    FORWARD * (derived + 2 * margin)
        + BACK * GROUP * derived
        + 2 * GROUP * (FORWARD * derived + BACK * columns)
}

/// Σₖ weights[k]·at[k·stride − RADIUS·stride], folded about the middle.
///
/// # Safety
/// All taps' 16 values must be readable.
#[inline(always)]
unsafe fn taps<F: Lanes>(at: *const f32, stride: usize, w: &[f32; TAPS]) -> F {
    // SAFETY: the caller's promise.
    unsafe {
        let mut sum = F::load_at(at) * F::splat(w[RADIUS]);
        for k in 1..=RADIUS {
            let pair = F::load_at(at.sub(k * stride)) + F::load_at(at.add(k * stride));
            sum = pair.fma(F::splat(w[RADIUS + k]), sum);
        }
        sum
    }
}

/// Loads 16 values of an image row from `at`, a multiple of 16; outside it they are 0.
#[inline(always)]
fn load<F: Lanes>(row: &[f32], at: isize) -> F {
    if at < 0 || at as usize >= row.len() {
        return F::zero();
    }
    let at = at as usize;
    if at + LANES <= row.len() {
        // SAFETY: just checked.
        return unsafe { F::load_at(row.as_ptr().add(at)) };
    }
    let mut lanes = Lanes16::default();
    lanes.0[..row.len() - at].copy_from_slice(&row[at..]);
    F::load(&lanes)
}

/// The lanes from `at` that belong to a row of `row` values.
#[inline(always)]
fn inside<F: Lanes>(row: usize, at: isize) -> F::Mask {
    let left = row as isize - at;
    F::Mask::from_bits(match at {
        0.. if left >= LANES as isize => u16::MAX,
        0.. if left > 0 => (1 << left) - 1,
        _ => 0,
    })
}

/// Blurs a row of scratch along itself; it is longer than `to` by a margin on each side.
#[inline(always)]
fn blur_row<F: Lanes>(from: &[f32], to: &mut [f32], shape: Shape, weights: &[f32; TAPS]) {
    let margin = margin(shape);
    assert!(from.len() >= to.len() + 2 * margin && to.len().is_multiple_of(LANES));
    for at in (0..to.len()).step_by(LANES) {
        // SAFETY: the margins hold the window's reach on both sides; `to` is whole lanes.
        unsafe {
            let blurred = taps::<F>(from.as_ptr().add(margin + at), shape.channels, weights);
            blurred.store_at(to.as_mut_ptr().add(at));
        }
    }
}

/// Two groups of rows of some maps, blurred along the rows; group g lies in half g % 2.
struct Ring<'a, const MAPS: usize> {
    values: &'a mut [f32],
    width: usize,
}

impl<const MAPS: usize> Ring<'_, MAPS> {
    #[inline(always)]
    fn row(&mut self, group: usize, row: usize, map: usize) -> &mut [f32] {
        let at = ((group % 2 * GROUP + row) * MAPS + map) * self.width;
        &mut self.values[at..at + self.width]
    }

    fn clear(&mut self, group: usize) {
        let half = GROUP * MAPS * self.width;
        self.values[group % 2 * half..][..half].fill(0.0);
    }

    /// Blurs sixteen columns of a map down: GROUP rows, centred on those from row RADIUS of group `first`.
    #[inline(always)]
    fn blurred_down<F: Lanes>(
        &self,
        first: usize,
        map: usize,
        at: usize,
        weights: &[f32; TAPS],
    ) -> [F; GROUP] {
        assert!(at + LANES <= self.width && self.values.len() >= 2 * GROUP * MAPS * self.width);
        let mut column = [F::zero(); 2 * GROUP];
        for half in 0..2 {
            let first = ((first + half) % 2 * GROUP * MAPS + map) * self.width + at;
            for i in 0..GROUP {
                // SAFETY: a row of the ring, which the assertion holds.
                column[half * GROUP + i] =
                    unsafe { F::load_at(self.values.as_ptr().add(first + i * MAPS * self.width)) };
            }
        }
        let mut blurred = [F::zero(); GROUP];
        for i in 0..GROUP {
            let middle = i + RADIUS;
            let mut sum = column[middle] * F::splat(weights[RADIUS]);
            for k in 1..=RADIUS {
                let pair = column[middle - k] + column[middle + k];
                sum = pair.fma(F::splat(weights[RADIUS + k]), sum);
            }
            blurred[i] = sum;
        }
        blurred
    }
}

/// 1 − SSIM, and dSSIM with respect to ⟨x⟩ (at fixed y, so ⟨e⟩ too), ⟨x² + y²⟩ and ⟨e²⟩.
#[inline(always)]
fn derivatives_of<F: Lanes>(means: &[F; FORWARD]) -> (F, [F; BACK]) {
    let [x, d, squares, e2] = *means;
    let y = x - d;
    let (one, two, zero) = (F::splat(1.0), F::splat(2.0), F::zero());
    let power = x.fma(x, y * y);
    let r_p = one / (power + F::splat(C1 as f32));
    let variance = squares - power;
    let r_q = one / (variance.max(zero) + F::splat(C2 as f32));
    let difference = d.fnma(d, e2);
    let ratio = difference.max(zero) * r_q;
    let d_p = d * r_p;
    let (luminance, contrast) = (d.fnma(d_p, one), one - ratio);
    // Where rounding made a variance negative it is held at 0 and passes no gradient.
    let on_variance = (ratio * r_q).only(variance.gt(zero)) * luminance;
    let on_difference = (r_q * luminance).only(difference.ge(zero));
    let on_mean = two * (contrast * (x * d_p).fma(d_p, -d_p) + d * on_difference - x * on_variance);
    // l·c = 1 − d²/P − E/Q + …: the loss is summed as what is missing from 1, to keep its digits.
    let loss = (d * d_p) + ratio - d * d_p * ratio;
    (loss, [on_mean, on_variance, -on_difference])
}

/// One tile: its rows and columns (values, not pixels) of the gradient, and its part of the loss.
pub struct Tile<'a> {
    pub image: &'a [f32],
    pub target: &'a [f32],
    pub shape: Shape,
    /// Those of a [`Mask`](crate::ssim::Mask).
    pub factors: Option<&'a [f32]>,
    pub weights: [f32; TAPS],
    /// Weights of |e| and SSIM per value.
    pub scale: [f32; 2],
    pub rows: Range<usize>,
    /// Starts at a multiple of sixteen.
    pub columns: Range<usize>,
    /// At least [`scratch_len`] values, of any content.
    pub scratch: &'a mut [f32],
    /// The gradient of the whole image.
    pub gradient: DisjointSlice<'a, f32>,
}

/// What a tile's steps leave for the next, in scratch memory.
struct Rows<'a> {
    /// Columns of the tile, with a margin on both sides, and with two.
    width: usize,
    derived: usize,
    span: usize,
    /// One row of each map, of `span` values.
    products: &'a mut [f32],
    /// A group of rows of each map, of `derived` values.
    derivatives: &'a mut [f32],
    means: Ring<'a, FORWARD>,
    slopes: Ring<'a, BACK>,
}

impl Kernel for Tile<'_> {
    /// Σ|e| and Σ(1 − SSIM).
    type Output = [f64; 2];

    /// Group g of products begins 2·RADIUS rows above row g·GROUP of the tile, that of derivatives RADIUS rows.
    #[inline(always)]
    fn run<F: Lanes>(mut self) -> [f64; 2] {
        let scratch = std::mem::take(&mut self.scratch);
        let margin = margin(self.shape);
        let width = self.columns.len().next_multiple_of(LANES);
        let (derived, span) = (width + 2 * margin, width + 4 * margin);
        let (products, rest) = scratch.split_at_mut(FORWARD * span);
        let (derivatives, rest) = rest.split_at_mut(BACK * GROUP * derived);
        let (means, slopes) = rest.split_at_mut(2 * GROUP * FORWARD * derived);
        let mut rows = Rows {
            width,
            derived,
            span,
            products,
            derivatives,
            means: Ring {
                values: means,
                width: derived,
            },
            slopes: Ring {
                values: slopes,
                width,
            },
        };
        let groups = self.rows.len().div_ceil(GROUP) + 2;
        let mut differ = 0u64;
        for group in 0..groups {
            differ |= u64::from(self.differs::<F>(group)) << group;
        }
        // Where the images agree as far as the windows reach, loss and gradient are 0 and nothing is blurred.
        let differs = |group: usize, count: usize| differ >> group & ((1 << count) - 1) != 0;
        let mut sums = [0.0; 2];
        for group in 0..groups {
            if differs(group.saturating_sub(1), 3) {
                self.blur_products::<F>(group, &mut rows);
            }
            let Some(group) = group.checked_sub(1) else {
                continue;
            };
            if differs(group, 2) {
                sums[1] += self.blur_derivatives::<F>(group, &mut rows);
            } else {
                rows.slopes.clear(group);
            }
            let Some(group) = group.checked_sub(1) else {
                continue;
            };
            if differs(group, 3) {
                sums[0] += self.write_gradient::<F>(group, &rows);
            } else {
                self.clear_gradient(group);
            }
        }
        sums
    }
}

impl Tile<'_> {
    /// Whether the images differ in a group of products.
    #[inline(always)]
    fn differs<F: Lanes>(&self, group: usize) -> bool {
        let reach = 2 * margin(self.shape);
        let last = self.shape.row().min(self.columns.end + reach);
        let first = self.rows.start + group * GROUP;
        for y in first.saturating_sub(GROUP)..self.shape.height.min(first) {
            for at in (self.columns.start.saturating_sub(reach)..last).step_by(LANES) {
                let (p, q) = self.images::<F>(y, at as isize);
                if p.ge(q).and(q.ge(p)).bits() != u16::MAX {
                    return true;
                }
            }
        }
        false
    }

    /// Sixteen values of row y of the image and of the target; 0 outside the mask.
    #[inline(always)]
    fn images<F: Lanes>(&self, y: usize, at: isize) -> (F, F) {
        let row = y * self.shape.row()..(y + 1) * self.shape.row();
        let image = load::<F>(&self.image[row.clone()], at);
        let target = load::<F>(&self.target[row], at);
        match self.factors::<F>(y, at) {
            None => (image, target),
            Some(factors) => {
                let counts = factors.gt(F::zero());
                (image.only(counts), target.only(counts))
            }
        }
    }

    /// The mask's factors of sixteen values of row y.
    #[inline(always)]
    fn factors<F: Lanes>(&self, y: usize, at: isize) -> Option<F> {
        let row = y * self.shape.row()..(y + 1) * self.shape.row();
        self.factors.map(|factors| load::<F>(&factors[row], at))
    }

    /// Blurs a group of products along their rows.
    #[inline(always)]
    fn blur_products<F: Lanes>(&self, group: usize, rows: &mut Rows) {
        let left = self.columns.start as isize - 2 * margin(self.shape) as isize;
        for i in 0..GROUP {
            let y = (self.rows.start + group * GROUP + i).wrapping_sub(2 * RADIUS);
            // Rows outside the image are zero, as its columns are.
            if y >= self.shape.height {
                for m in 0..FORWARD {
                    rows.means.row(group, i, m).fill(0.0);
                }
                continue;
            }
            for at in (0..rows.span).step_by(LANES) {
                let (p, q) = self.images::<F>(y, left + at as isize);
                let e = p - q;
                let values = [p, e, p.fma(p, q * q), e * e];
                for m in 0..FORWARD {
                    let to = m * rows.span + at;
                    // SAFETY: whole lanes of map m's row.
                    unsafe { values[m].store_at(rows.products.as_mut_ptr().add(to)) };
                }
            }
            for m in 0..FORWARD {
                let from = &rows.products[m * rows.span..][..rows.span];
                let to = rows.means.row(group, i, m);
                blur_row::<F>(from, to, self.shape, &self.weights);
            }
        }
    }

    /// Blurs a group of products down, and the derivatives there along their rows; returns the tile's Σ(1 − SSIM).
    #[inline(always)]
    fn blur_derivatives<F: Lanes>(&self, group: usize, rows: &mut Rows) -> f64 {
        let margin = margin(self.shape);
        let left = self.columns.start as isize - margin as isize;
        let mut lost = F::zero();
        for at in (0..rows.derived).step_by(LANES) {
            let mut blurred = [[F::zero(); GROUP]; FORWARD];
            for m in 0..FORWARD {
                blurred[m] = rows.means.blurred_down(group, m, at, &self.weights);
            }
            let columns = inside::<F>(self.shape.row(), left + at as isize);
            let mine = (margin..margin + rows.width).contains(&at);
            for i in 0..GROUP {
                let y = (self.rows.start + group * GROUP + i).wrapping_sub(RADIUS);
                let (mut loss, mut d) = (F::zero(), [F::zero(); BACK]);
                if y < self.shape.height {
                    let mut means = [blurred[0][i], blurred[1][i], blurred[2][i], blurred[3][i]];
                    let factors = self.factors::<F>(y, left + at as isize);
                    if let Some(factors) = factors {
                        means = means.map(|mean| mean * factors);
                    }
                    (loss, d) = derivatives_of(&means);
                    if let Some(factors) = factors {
                        d = d.map(|slope| slope * factors);
                    }
                }
                if mine && self.rows.contains(&y) {
                    lost = lost + loss.only(columns);
                }
                for m in 0..BACK {
                    let to = (i * BACK + m) * rows.derived + at;
                    let d = d[m].only(columns);
                    // SAFETY: whole lanes of a row of derivatives.
                    unsafe { d.store_at(rows.derivatives.as_mut_ptr().add(to)) };
                }
            }
        }
        for i in 0..GROUP {
            for m in 0..BACK {
                let from = &rows.derivatives[(i * BACK + m) * rows.derived..][..rows.derived];
                let to = rows.slopes.row(group, i, m);
                blur_row::<F>(from, to, self.shape, &self.weights);
            }
        }
        sum(lost)
    }

    /// Blurs a group of derivatives down and writes the gradient there; returns its Σ|e|.
    #[inline(always)]
    fn write_gradient<F: Lanes>(&self, group: usize, rows: &Rows) -> f64 {
        let (two, l1) = (F::splat(2.0), F::splat(self.scale[0]));
        let mut differences = F::zero();
        for at in (0..rows.width).step_by(LANES) {
            let mut blurred = [[F::zero(); GROUP]; BACK];
            for m in 0..BACK {
                blurred[m] = rows.slopes.blurred_down(group, m, at, &self.weights);
            }
            let x = self.columns.start + at;
            let count = LANES.min(self.columns.end - x);
            for (i, y) in self.rows_of(group).enumerate() {
                let (p, q) = self.images::<F>(y, x as isize);
                let e = p - q;
                differences = differences + e.abs();
                let slope = blurred[0][i] + two * (p * blurred[1][i] + e * blurred[2][i]);
                let sign = l1.only(e.gt(F::zero())) - l1.only(F::zero().gt(e));
                let mut lanes = Lanes16::default();
                let mut slope = slope.fma(F::splat(self.scale[1]), sign);
                if let Some(factors) = self.factors::<F>(y, x as isize) {
                    slope = slope.only(factors.gt(F::zero()));
                }
                slope.store(&mut lanes);
                // SAFETY: these values are the tile's own.
                let out = unsafe { self.gradient.slice(y * self.shape.row() + x, count) };
                match out.first_chunk_mut() {
                    Some(all) if count == LANES => *all = lanes.0,
                    _ => out.copy_from_slice(&lanes.0[..count]),
                }
            }
        }
        sum(differences)
    }

    fn clear_gradient(&self, group: usize) {
        for y in self.rows_of(group) {
            let first = y * self.shape.row() + self.columns.start;
            // SAFETY: these values are the tile's own.
            unsafe { self.gradient.slice(first, self.columns.len()) }.fill(0.0);
        }
    }

    /// A group of the tile's own rows.
    #[inline(always)]
    fn rows_of(&self, group: usize) -> Range<usize> {
        let first = self.rows.start + group * GROUP;
        first..self.rows.end.min(first + GROUP)
    }
}

#[inline(always)]
fn sum<F: Lanes>(values: F) -> f64 {
    let mut lanes = Lanes16::default();
    values.store(&mut lanes);
    lanes.0.iter().map(|v| f64::from(*v)).sum()
}
