//! Forward and backward pass of the fused loss over one band of rows.

use super::{BACK, FORWARD};
use crate::raster::simd::{Kernel, LANES, Lanes, Lanes16, Mask};
use crate::ssim::{C1, C2, RADIUS, Shape, TAPS};

/// Values of a scratch row: zeros on both sides for the window, whole lanes in between.
pub fn span(shape: Shape) -> usize {
    shape.row().next_multiple_of(LANES) + 2 * margin(shape)
}

fn margin(shape: Shape) -> usize {
    (RADIUS * shape.channels).next_multiple_of(LANES)
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

/// Loads 16 values of an image row; past its end they are 0.
#[inline(always)]
fn load<F: Lanes>(row: &[f32], at: usize) -> F {
    if at + LANES <= row.len() {
        // SAFETY: just checked.
        return unsafe { F::load_at(row.as_ptr().add(at)) };
    }
    let mut lanes = Lanes16::default();
    lanes.0[..row.len() - at].copy_from_slice(&row[at..]);
    F::load(&lanes)
}

pub struct Forward<'a> {
    pub image: &'a [f32],
    pub target: &'a [f32],
    pub shape: Shape,
    pub weights: [f32; TAPS],
    /// The band's first row.
    pub first: usize,
    pub maps: &'a mut [f32],
    /// Per row: Σ|e| and Σ(1 − SSIM).
    pub sums: &'a mut [[f64; 2]],
    pub scratch: &'a mut [f32],
}

impl Kernel for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let (row, span, margin) = (self.shape.row(), span(self.shape), margin(self.shape));
        let padded = row.next_multiple_of(LANES);
        let (products, rest) = self.scratch.split_at_mut(FORWARD * span);
        // `ring`: the last eleven rows' products, blurred along the row. Tap k of output row y lies in slot (y + k) % 11.
        let (ring, derivatives) = rest.split_at_mut(FORWARD * TAPS * span);
        let rows = self.sums.len();
        for ahead in 0..rows + 2 * RADIUS {
            // Rows outside the image are zero, as its columns are.
            let y = (self.first + ahead).wrapping_sub(RADIUS);
            let slot = ahead % TAPS;
            if y < self.shape.height {
                let image = &self.image[y * row..(y + 1) * row];
                let target = &self.target[y * row..(y + 1) * row];
                for at in (0..padded).step_by(LANES) {
                    let (p, q) = (load::<F>(image, at), load::<F>(target, at));
                    let e = p - q;
                    let values = [p, e, p.fma(p, q * q), e * e];
                    for m in 0..FORWARD {
                        // SAFETY: `at + 16 ≤ padded`, inside map m's span.
                        unsafe {
                            values[m].store_at(products.as_mut_ptr().add(m * span + margin + at))
                        };
                    }
                }
                for m in 0..FORWARD {
                    let to = &mut ring[(slot * FORWARD + m) * span..][..padded];
                    blur_row::<F>(&products[m * span..][..span], to, self.shape, &self.weights);
                }
            } else {
                ring[slot * FORWARD * span..(slot + 1) * FORWARD * span].fill(0.0);
            }
            if ahead < 2 * RADIUS {
                continue;
            }
            let out = ahead - 2 * RADIUS;
            let image = &self.image[(self.first + out) * row..(self.first + out + 1) * row];
            let target = &self.target[(self.first + out) * row..(self.first + out + 1) * row];
            let mut sums = [F::zero(); 2];
            for at in (0..padded).step_by(LANES) {
                let means = blurred_down::<F>(ring, span, out, at, &self.weights);
                let (loss, d) = derivatives_of(&means);
                let inside = tail_mask::<F>(row, at);
                let e = load::<F>(image, at) - load::<F>(target, at);
                sums[0] = sums[0] + e.abs();
                sums[1] = sums[1] + loss.only(inside);
                for m in 0..BACK {
                    // SAFETY: as above.
                    unsafe {
                        d[m].only(inside)
                            .store_at(derivatives.as_mut_ptr().add(m * span + margin + at))
                    };
                }
            }
            for m in 0..BACK {
                let to = &mut self.maps[(out * BACK + m) * padded..][..padded];
                blur_row::<F>(
                    &derivatives[m * span..][..span],
                    to,
                    self.shape,
                    &self.weights,
                );
            }
            for k in 0..2 {
                let mut lanes = Lanes16::default();
                sums[k].store(&mut lanes);
                self.sums[out][k] = lanes.0.iter().map(|v| f64::from(*v)).sum();
            }
        }
    }
}

/// Blurs a row, which lies between margins, along itself into `to`, a padded row.
#[inline(always)]
fn blur_row<F: Lanes>(from: &[f32], to: &mut [f32], shape: Shape, weights: &[f32; TAPS]) {
    let margin = margin(shape);
    assert!(from.len() >= to.len() + 2 * margin);
    for at in (0..to.len()).step_by(LANES) {
        // SAFETY: the margins hold the window's reach on both sides; `to` is whole lanes.
        unsafe {
            let blurred = taps::<F>(from.as_ptr().add(margin + at), shape.channels, weights);
            blurred.store_at(to.as_mut_ptr().add(at));
        }
    }
}

/// Sixteen values of output row `out`, blurred across the ring's rows, of every map.
#[inline(always)]
fn blurred_down<F: Lanes>(
    ring: &[f32],
    span: usize,
    out: usize,
    at: usize,
    weights: &[f32; TAPS],
) -> [F; FORWARD] {
    let mut means = [F::zero(); FORWARD];
    for m in 0..FORWARD {
        let mut sum = F::zero();
        for k in 0..=RADIUS {
            let up = ((out + RADIUS - k) % TAPS * FORWARD + m) * span + at;
            let down = ((out + RADIUS + k) % TAPS * FORWARD + m) * span + at;
            // SAFETY: both are whole lanes of ring rows.
            let pair = unsafe {
                let up = F::load_at(ring.as_ptr().add(up));
                if k == 0 {
                    up
                } else {
                    up + F::load_at(ring.as_ptr().add(down))
                }
            };
            sum = pair.fma(F::splat(weights[RADIUS + k]), sum);
        }
        means[m] = sum;
    }
    means
}

/// The lanes from `at` that belong to a row of `row` values.
#[inline(always)]
fn tail_mask<F: Lanes>(row: usize, at: usize) -> F::Mask {
    let left = row - at;
    F::Mask::from_bits(if left >= LANES {
        u16::MAX
    } else {
        (1 << left) - 1
    })
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

pub struct Backward<'a> {
    pub image: &'a [f32],
    pub target: &'a [f32],
    pub shape: Shape,
    pub weights: [f32; TAPS],
    pub first: usize,
    pub maps: &'a [f32],
    /// Weights of |e| and SSIM per value.
    pub scale: [f32; 2],
    pub out: &'a mut [f32],
}

impl Kernel for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let row = self.shape.row();
        let padded = row.next_multiple_of(LANES);
        let (two, l1, ssim) = (
            F::splat(2.0),
            F::splat(self.scale[0]),
            F::splat(self.scale[1]),
        );
        for (i, out) in self.out.chunks_exact_mut(row).enumerate() {
            let y = self.first + i;
            let (low, high) = (
                y.saturating_sub(RADIUS),
                (y + RADIUS + 1).min(self.shape.height),
            );
            let image = &self.image[y * row..(y + 1) * row];
            let target = &self.target[y * row..(y + 1) * row];
            for at in (0..padded).step_by(LANES) {
                let mut sums = [F::zero(); BACK];
                for yy in low..high {
                    let weight = F::splat(self.weights[yy + RADIUS - y]);
                    for m in 0..BACK {
                        // SAFETY: whole lanes of a padded row.
                        let value = unsafe {
                            F::load_at(self.maps.as_ptr().add((yy * BACK + m) * padded + at))
                        };
                        sums[m] = value.fma(weight, sums[m]);
                    }
                }
                let x = load::<F>(image, at);
                let e = x - load::<F>(target, at);
                let slope = sums[0] + two * (x * sums[1] + e * sums[2]);
                let sign = l1.only(e.gt(F::zero())) - l1.only(F::zero().gt(e));
                let value = slope.fma(ssim, sign);
                if at + LANES <= row {
                    // SAFETY: just checked.
                    unsafe { value.store_at(out.as_mut_ptr().add(at)) };
                } else {
                    let mut lanes = Lanes16::default();
                    value.store(&mut lanes);
                    out[at..].copy_from_slice(&lanes.0[..row - at]);
                }
            }
        }
    }
}
