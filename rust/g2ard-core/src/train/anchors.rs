//! L_anchor and L_shape (`eq:anchor`, `eq:shape`) and their gradients, sixteen Gaussians at a time.

use super::store::ParameterView;
use crate::constants::constants;
use crate::raster::params::Source;
use crate::raster::project::{RowGradients, quaternion_gradient, rotation, unit_quaternion};
use crate::raster::simd::{LANES, LN_2, Lanes, Lanes16, Mask};
use crate::{Error, Result};

constants! {
    /// Weights of the two terms.
    pub struct Regularizers {
        /// λ_a of (1/N) Σ log(1 + [D² − 1]₊).
        pub anchor: f32 = 0.0,
        /// λ_s of (1/N) Σ max(0, −log(r_eff − 1 + ε)) + β[log s⊥ − log s̄⊥]₊.
        pub shape: f32 = 0.0,
        /// Whether L_shape has its first term.
        pub effective_rank: bool = false,
        /// β.
        pub thickness: f32 = 1.0,
        /// ε.
        pub rank_offset: f32 = 1e-6,
    }
}

/// First places of an anchor's values: the mean, the frame row by row, 1/r∥ and 1/r⊥; and their number.
const MEAN: usize = 0;
const FRAME: usize = 3;
const PARALLEL: usize = 12;
const PERP: usize = 13;
const ROWS: usize = 14;

/// The values of each anchor: its mean, its frame row by row, 1/r∥ and 1/r⊥. `order[i]` is the caller's row of row i.
pub fn anchor_rows(
    order: &[u32],
    means: &[f32],
    frames: &[f32],
    r_parallel: &[f32],
    r_perp: &[f32],
) -> Result<Vec<[f32; ROWS]>> {
    let n = order.len();
    for (name, got, expected) in [
        ("anchor means", means.len(), 3 * n),
        ("anchor frames", frames.len(), 9 * n),
        ("r_parallel", r_parallel.len(), n),
        ("r_perp", r_perp.len(), n),
    ] {
        Error::unless_equal(name, got, expected, "values")?;
    }
    let row = |&from: &u32| {
        let from = from as usize;
        let mut values = [0.0; ROWS];
        values[MEAN..FRAME].copy_from_slice(&means[3 * from..][..3]);
        values[FRAME..PARALLEL].copy_from_slice(&frames[9 * from..][..9]);
        // The reciprocal, not its square: 1/r² of a 1e-20 thin disc leaves f32.
        values[PARALLEL] = 1.0 / r_parallel[from];
        values[PERP] = 1.0 / r_perp[from];
        values
    };
    Ok(order.iter().map(row).collect())
}

/// Frozen geometry of N Gaussians in the trainer's order.
#[derive(Debug, Clone)]
pub struct Anchors {
    blocks: Vec<Lanes16>,
    count: f32,
}

impl Anchors {
    /// `frames`: N × 3 × 3 row-major, columns t₁, t₂, n. `order[i]` is the caller's row of row i.
    pub(crate) fn new(
        order: &[u32],
        means: &[f32],
        frames: &[f32],
        r_parallel: &[f32],
        r_perp: &[f32],
    ) -> Result<Self> {
        let rows = anchor_rows(order, means, frames, r_parallel, r_perp)?;
        let mut blocks = vec![Lanes16::default(); rows.len().div_ceil(LANES) * ROWS];
        for (row, values) in rows.iter().enumerate() {
            let block = &mut blocks[row / LANES * ROWS..][..ROWS];
            for (lanes, value) in block.iter_mut().zip(values) {
                lanes.0[row % LANES] = *value;
            }
        }
        Ok(Self {
            blocks,
            count: rows.len() as f32,
        })
    }

    /// Adds the terms' gradients to a block's; returns the lanes where either term is not flat.
    #[inline(always)]
    pub(crate) fn add_gradients<F: Lanes>(
        &self,
        weights: &Regularizers,
        parameters: &ParameterView,
        group: usize,
        g: &mut RowGradients<F>,
    ) -> u16 {
        let block = &self.blocks[group * ROWS..][..ROWS];
        let mut active = 0;
        if weights.anchor > 0.0 {
            active |= anchor(
                block,
                F::splat(weights.anchor / self.count),
                parameters,
                group,
                g,
            );
        }
        if weights.shape > 0.0 {
            let weight = F::splat(weights.shape / self.count);
            if weights.thickness > 0.0 {
                let weight = weight * F::splat(weights.thickness);
                active |= thickness(block, weight, parameters, group, g);
            }
            if weights.effective_rank {
                let offset = F::splat(weights.rank_offset);
                active |= effective_rank(weight, offset, parameters, group, g);
            }
        }
        active
    }
}

/// Adds `weight` times the gradient of log(1 + [D² − 1]₊), D² = Σ (δ̃ᵢ/rᵢ)², and returns the lanes outside the trust
/// region. There the term is 2·log D, whose slope in D² is 1/D².
#[inline(always)]
fn anchor<F: Lanes>(
    block: &[Lanes16],
    weight: F,
    parameters: &ParameterView,
    group: usize,
    g: &mut RowGradients<F>,
) -> u16 {
    let mut offset = [F::zero(); 3];
    for k in 0..3 {
        offset[k] = parameters.mean::<F>(group, k) - F::load(&block[MEAN + k]);
    }
    let reciprocal_radius = [PARALLEL, PARALLEL, PERP].map(|row| F::load(&block[row]));
    let mut local = [F::zero(); 3];
    let mut d2 = F::zero();
    for i in 0..3 {
        for j in 0..3 {
            local[i] = F::load(&block[FRAME + 3 * j + i]).fma(offset[j], local[i]);
        }
        local[i] = local[i] * reciprocal_radius[i];
        d2 = local[i].fma(local[i], d2);
    }
    let outside = d2.gt(F::splat(1.0));
    let slope = (weight * F::splat(2.0) / d2).only(outside);
    for j in 0..3 {
        for i in 0..3 {
            let pull = slope * local[i] * reciprocal_radius[i];
            g.mean[j] = pull.fma(F::load(&block[FRAME + 3 * j + i]), g.mean[j]);
        }
    }
    outside.bits()
}

/// Adds `weight` times the gradient of [log s⊥ − log s̄⊥]₊, s⊥ = |S Rᵀ n̄|, and returns the lanes where it is not flat.
#[inline(always)]
fn thickness<F: Lanes>(
    block: &[Lanes16],
    weight: F,
    parameters: &ParameterView,
    group: usize,
    g: &mut RowGradients<F>,
) -> u16 {
    let (q, rq) = unit_quaternion::<F, ParameterView<'_>>(parameters, group);
    let r = rotation(&q);
    let normal = [0, 1, 2].map(|axis| F::load(&block[FRAME + 3 * axis + 2]));
    let mut scale = [F::zero(); 3];
    let mut extent = [F::zero(); 3];
    let mut square = F::zero();
    for k in 0..3 {
        // In units of s̄⊥, whose square may not fit f32.
        scale[k] = parameters.scale::<F>(group, k) * F::load(&block[PERP]);
        extent[k] = (r[0][k] * normal[0] + r[1][k] * normal[1] + r[2][k] * normal[2]) * scale[k];
        square = extent[k].fma(extent[k], square);
    }
    let over = square.gt(F::splat(1.0));
    let slope = (weight / square).only(over);
    let mut dr = [[F::zero(); 3]; 3];
    for k in 0..3 {
        let pull = slope * extent[k];
        g.log_scale[k] = pull.fma(extent[k], g.log_scale[k]);
        for a in 0..3 {
            dr[a][k] = normal[a] * pull * scale[k];
        }
    }
    let dq = quaternion_gradient(&q, rq, &dr);
    for k in 0..4 {
        g.quat[k] = g.quat[k] + dq[k];
    }
    over.bits()
}

/// Adds `weight` times the gradient of max(0, −log(r_eff − 1 + ε)), r_eff = exp(H), H = −Σ q log q, q = s/Σs, and returns
/// the lanes where it is not flat: r_eff below 2 − ε.
#[inline(always)]
fn effective_rank<F: Lanes>(
    weight: F,
    offset: F,
    parameters: &ParameterView,
    group: usize,
    g: &mut RowGradients<F>,
) -> u16 {
    let (zero, one) = (F::zero(), F::splat(1.0));
    let mut below = [zero; 3];
    for k in 0..3 {
        below[k] = parameters.log_scale::<F>(group, k);
    }
    let largest = below[0].max(below[1]).max(below[2]);
    let mut share = [zero; 3];
    let mut taken = F::Mask::from_bits(0);
    // Σs over the largest is 1 + rest; the 1 is left out, for on a needle it would swallow the rest.
    let mut rest = zero;
    for k in 0..3 {
        let first = below[k].ge(largest).and_not(taken);
        taken = taken.or(first);
        below[k] = below[k] - largest;
        share[k] = below[k].exp();
        rest = rest + F::select(first, zero, share[k]);
    }
    let r_sum = one / (one + rest);
    // Past rest = 1 the rank is above 2 and the term is 0: log2_1p need not hold there.
    let log_sum = rest.min(one).log2_1p() * F::splat(LN_2);
    let mut entropy = log_sum;
    for k in 0..3 {
        share[k] = share[k] * r_sum;
        entropy = share[k].fnma(below[k], entropy);
    }
    // exp(H) − 1 by its series: exact where H is small, good enough up to log 2.
    let mut series = F::splat(1.0 / 40_320.0);
    for c in [
        1.0 / 5040.0,
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
        1.0,
    ] {
        series = series.fma(entropy, F::splat(c));
    }
    let rank_less_1 = series * entropy;
    let low = (one - offset).gt(rank_less_1).and(one.ge(rest));
    let slope = (weight * (rank_less_1 + one) / (rank_less_1 + offset)).only(low);
    for k in 0..3 {
        let log_share = below[k] - log_sum;
        g.log_scale[k] = (slope * share[k]).fma(log_share + entropy, g.log_scale[k]);
    }
    low.bits()
}
