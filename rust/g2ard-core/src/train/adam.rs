//! One Adam step of every Gaussian that a view touched, sixteen at a time.

use super::Rates;
use super::anchors::{Anchors, Regularizers};
use super::store::{Block, Blocks, LOG_SCALE, LOGIT, QUAT, SH};
use crate::raster::bounds::GROUPS;
use crate::raster::gradients::collect;
use crate::raster::project::{RowGradients, unproject};
use crate::raster::rasterizer::ChunkSums;
use crate::raster::simd::{Kernel, LANES, Lanes, Lanes16, Mask};

pub const BETA2: f64 = 0.999;
/// Added to the root of the second moment; `SelectiveAdam` has the same.
pub const EPSILON: f32 = 1e-15;
/// Beyond this the square of a gradient leaves f32: such a row is skipped as not finite.
pub const GRADIENT_MAX: f32 = 1e18;

/// 1/(1 − β₁ᵗ) and 1/√(1 − β₂ᵗ) for each count of steps t, worked out in f64. β₁ is the rates' momentum.
#[derive(Debug, Default)]
pub struct Biases {
    momentum: f32,
    pairs: Vec<[f32; 2]>,
}

/// From this count on both are 1 in f32.
const UNBIASED: usize = 1 << 15;

impl Biases {
    pub fn extend_to(&mut self, momentum: f32, steps: usize) {
        if momentum != self.momentum {
            self.momentum = momentum;
            self.pairs.clear();
        }
        while self.pairs.len() <= steps.min(UNBIASED) {
            let t = self.pairs.len().max(1) as f64;
            let bias = |beta: f64| -(t * beta.ln()).exp_m1();
            self.pairs.push([
                (1.0 / bias(momentum.into())) as f32,
                (1.0 / bias(BETA2).sqrt()) as f32,
            ]);
        }
    }

    /// The second of every count of steps up to the last one that differs from 1, and one more.
    pub fn table() -> Vec<f32> {
        let mut biases = Self::default();
        biases.extend_to(0.0, UNBIASED);
        biases.pairs.iter().map(|pair| pair[1]).collect()
    }

    pub(super) fn of(&self, steps: usize) -> [f32; 2] {
        self.pairs[steps.min(UNBIASED)]
    }
}

/// Adds up a chunk's slots, goes back to the parameters, and steps.
pub struct Update<'a> {
    pub sums: &'a ChunkSums<'a>,
    pub blocks: Blocks<'a>,
    pub biases: &'a Biases,
    pub rates: &'a Rates,
    pub reach: Option<f32>,
    pub finest: f32,
    pub regularize: Option<(&'a Regularizers, &'a Anchors)>,
    /// One bit per row of a group, 0 if it is frozen; `None` freezes nothing.
    pub free: Option<&'a [u16]>,
}

impl Kernel for Update<'_> {
    /// (Gaussians stepped, Gaussians skipped).
    type Output = (usize, usize);

    #[inline(always)]
    fn run<F: Lanes>(self) -> (usize, usize) {
        let sums = self.sums;
        let (mut next, mut updated, mut skipped) = (0, 0, 0);
        for first in (sums.first_group..sums.last_group).step_by(GROUPS) {
            let last = sums.last_group.min(first + GROUPS);
            let before = updated;
            for group in first..last {
                // A bit for each row of the group; lanes of others hold meaningless values.
                let (mut active, screen) =
                    collect::<F>(sums.splats, &mut next, group, sums.slots, sums.written);
                let free = self.free.map_or(u16::MAX, |free| free[group]);
                active &= free;
                if free == 0 || (active == 0 && self.regularize.is_none()) {
                    continue;
                }
                // SAFETY: a group belongs to one chunk, a chunk to one thread, and the block of the group before was dropped.
                let mut block = unsafe { self.blocks.block(group) };
                let mut g = unproject(sums.view, &block.parameters(), group, &screen);
                if let Some((weights, anchors)) = self.regularize {
                    let seen = F::Mask::from_bits(active);
                    zero_unseen(&mut g, seen);
                    let rows = (self.blocks.rows - group * LANES).min(LANES);
                    let real = ((1u32 << rows) - 1) as u16 & free;
                    active |=
                        anchors.add_gradients(weights, &block.parameters(), group, &mut g) & real;
                    if active == 0 {
                        continue;
                    }
                }
                active &= !zero(&g).bits();
                let good = finite(&g).bits() & active;
                skipped += (active & !good).count_ones() as usize;
                updated += good.count_ones() as usize;
                if good != 0 {
                    self.step_group(&mut block, good, &g);
                }
            }
            if updated > before {
                // SAFETY: as above, and the last block was dropped.
                unsafe { self.blocks.find_bounds::<F>(first, last) };
            }
        }
        (updated, skipped)
    }
}

/// Lanes no pixel touched hold meaningless values: they become 0.
#[inline(always)]
fn zero_unseen<F: Lanes>(g: &mut RowGradients<F>, seen: F::Mask) {
    for k in 0..3 {
        g.mean[k] = g.mean[k].only(seen);
        g.log_scale[k] = g.log_scale[k].only(seen);
        g.rgb[k] = g.rgb[k].only(seen);
    }
    for k in 0..4 {
        g.quat[k] = g.quat[k].only(seen);
    }
    g.logit_opacity = g.logit_opacity.only(seen);
}

/// Lanes without a gradient, such as those behind a mask; they do not change either.
#[inline(always)]
fn zero<F: Lanes>(g: &RowGradients<F>) -> F::Mask {
    let none = F::splat(0.0);
    let mut all = none.ge(g.logit_opacity.abs());
    for k in 0..3 {
        all = all
            .and(none.ge(g.mean[k].abs()))
            .and(none.ge(g.log_scale[k].abs()))
            .and(none.ge(g.rgb[k].abs()));
    }
    for k in 0..4 {
        all = all.and(none.ge(g.quat[k].abs()));
    }
    all
}

/// Lanes whose every gradient can be squared.
#[inline(always)]
fn finite<F: Lanes>(g: &RowGradients<F>) -> F::Mask {
    let most = F::splat(GRADIENT_MAX);
    let mut ok = most.ge(g.logit_opacity.abs());
    for k in 0..3 {
        // Not the larger of them: max(NaN, x) is x.
        ok = ok
            .and(most.ge(g.mean[k].abs()))
            .and(most.ge(g.log_scale[k].abs()))
            .and(most.ge(g.rgb[k].abs()));
    }
    for k in 0..4 {
        ok = ok.and(most.ge(g.quat[k].abs()));
    }
    ok
}

/// Values that the attributes of one block share.
struct Step<F: Lanes> {
    good: F::Mask,
    /// 1 − β₁.
    new: F,
    bias1: F,
    bias2: F,
}

impl Update<'_> {
    #[inline(always)]
    fn step_group<F: Lanes>(&self, block: &mut Block, good: u16, g: &RowGradients<F>) {
        let mut bias = [Lanes16([1.0; LANES]); 2];
        for l in 0..LANES {
            if good >> l & 1 == 1 {
                block.steps[l] += 1;
                let pair = self.biases.of(block.steps[l] as usize);
                bias[0].0[l] = pair[0];
                bias[1].0[l] = pair[1];
            }
        }
        let step = Step {
            good: F::Mask::from_bits(good),
            new: F::splat(1.0 - self.rates.momentum),
            bias1: F::load(&bias[0]),
            bias2: F::load(&bias[1]),
        };
        let unit = F::load(block.units);
        let rates = self.rates;
        let share = self.share(g.extent.largest);
        for k in 0..3 {
            step.attribute(block, k, g.mean[k], share * unit * F::splat(rates.means));
            let own = self.share(g.extent.axes[k]);
            let rate = own * F::splat(rates.log_scales);
            step.attribute(block, LOG_SCALE + k, g.log_scale[k], rate);
            step.attribute(block, SH + k, g.basis[0] * g.rgb[k], F::splat(rates.sh0));
        }
        for k in 0..4 {
            step.attribute(block, QUAT + k, g.quat[k], share * F::splat(rates.quats));
        }
        step.attribute(
            block,
            LOGIT,
            g.logit_opacity,
            F::splat(rates.logit_opacities),
        );
        let rate = F::splat(rates.sh_n);
        for k in 1..block.sh_coeffs {
            for c in 0..3 {
                // The SH gradient has rank one: it is never written out.
                step.attribute(block, SH + 3 * k + c, g.basis[k] * g.rgb[c], rate);
            }
        }
    }

    /// σ²/(σ² + finest²) · 1/(1 + (σ/reach)¹⁶) from σ², where σ is a size in pixels.
    #[inline(always)]
    fn share<F: Lanes>(&self, variance: F) -> F {
        let one = F::splat(1.0);
        let least = F::splat(self.finest * self.finest);
        let seen = match self.finest > 0.0 {
            true => {
                let variance = variance.min(F::splat(1e12));
                variance * (variance + least).recip()
            }
            false => one,
        };
        let Some(reach) = self.reach else {
            return seen;
        };
        // Beyond ten times the reach nothing moves anyway, and the eighth power stays within f32.
        let shrink = F::splat(1.0 / reach);
        let ratio = (variance * shrink * shrink).min(F::splat(100.0));
        let square = ratio * ratio;
        let fourth = square * square;
        seen / fourth.fma(fourth, one)
    }
}

impl<F: Lanes> Step<F> {
    /// Adam on one attribute of a block.
    #[inline(always)]
    fn attribute(&self, block: &mut Block, attribute: usize, g: F, rate: F) {
        let (first, second) = (&mut block.first[attribute], &mut block.second[attribute]);
        let (m, v) = (F::load(first), F::load(second));
        let m_new = (g - m).fma(self.new, m);
        let v_new = v.fma(
            F::splat(BETA2 as f32),
            g * g * F::splat((1.0 - BETA2) as f32),
        );
        let denominator = v_new.sqrt().fma(self.bias2, F::splat(EPSILON));
        let value = F::load(&block.values[attribute]);
        let moved = (rate * self.bias1 * m_new).fnma(denominator.recip(), value);
        F::select(self.good, moved, value).store(&mut block.values[attribute]);
        F::select(self.good, m_new, m).store(first);
        F::select(self.good, v_new, v).store(second);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn biases_of_any_count_are_those_of_f64() {
        let mut biases = Biases::default();
        for momentum in [0.0, 0.6, 0.9] {
            let exact = |steps: usize| {
                let left = |beta: f64| 1.0 - beta.powf(steps as f64);
                [
                    (1.0 / left(momentum.into())) as f32,
                    (1.0 / left(BETA2).sqrt()) as f32,
                ]
            };
            biases.extend_to(momentum, usize::MAX);
            for steps in [
                1,
                2,
                100,
                9999,
                UNBIASED - 1,
                UNBIASED,
                UNBIASED + 1,
                1 << 40,
            ] {
                for (got, want) in biases.of(steps).iter().zip(exact(steps)) {
                    assert!((got - want).abs() <= 1e-6 * want, "{steps}: {got} {want}");
                }
            }
            assert_eq!(exact(UNBIASED), [1.0; 2]);
            assert_eq!(biases.of(UNBIASED - 1), [1.0; 2]);
        }
    }
}
