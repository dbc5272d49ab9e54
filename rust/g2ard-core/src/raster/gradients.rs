//! The sum of each Gaussian's slots in a fixed order, and where the gradient goes.

use super::backward::SUMS;
use super::disjoint::DisjointSlice;
use super::params::{Params, Source};
use super::project::{RowGradients, ScreenGradients, Splat, View, unproject};
use super::simd::{Kernel, LANES, Lanes, Lanes16};
use crate::{Error, Result};

/// Gradients in the torch layout, one slice per field of [`Params`]; rows that no pixel saw are not written.
#[derive(Debug)]
pub struct Gradients<'a> {
    pub means: &'a mut [f32],
    pub quats: &'a mut [f32],
    pub log_scales: &'a mut [f32],
    pub logit_opacities: &'a mut [f32],
    pub sh0: &'a mut [f32],
    pub sh_n: &'a mut [f32],
}

impl Gradients<'_> {
    pub(crate) fn validate(&self, params: &Params) -> Result<()> {
        for (name, got, expected) in [
            ("means", self.means.len(), params.means.len()),
            ("quats", self.quats.len(), params.quats.len()),
            ("log_scales", self.log_scales.len(), params.log_scales.len()),
            (
                "logit_opacities",
                self.logit_opacities.len(),
                params.logit_opacities.len(),
            ),
            ("sh0", self.sh0.len(), params.sh0.len()),
            ("shN", self.sh_n.len(), params.sh_n.len()),
        ] {
            Error::unless_equal(name, got, expected, "gradients")?;
        }
        Ok(())
    }

    pub(crate) fn row_major(&mut self, sh_coeffs: usize) -> RowMajor<'_> {
        RowMajor {
            means: DisjointSlice::new(self.means),
            quats: DisjointSlice::new(self.quats),
            log_scales: DisjointSlice::new(self.log_scales),
            logit_opacities: DisjointSlice::new(self.logit_opacities),
            sh0: DisjointSlice::new(self.sh0),
            sh_n: DisjointSlice::new(self.sh_n),
            sh_coeffs,
        }
    }
}

/// Writes rows out as torch holds them.
#[derive(Clone, Copy)]
pub(crate) struct RowMajor<'a> {
    means: DisjointSlice<'a, f32>,
    quats: DisjointSlice<'a, f32>,
    log_scales: DisjointSlice<'a, f32>,
    logit_opacities: DisjointSlice<'a, f32>,
    sh0: DisjointSlice<'a, f32>,
    sh_n: DisjointSlice<'a, f32>,
    sh_coeffs: usize,
}

/// Writes the `touched` lanes of a group's value to `offset` in its rows of `stride` values.
#[inline(always)]
fn scatter<F: Lanes>(
    out: DisjointSlice<'_, f32>,
    group: usize,
    touched: u16,
    stride: usize,
    offset: usize,
    value: F,
) {
    let mut row = Lanes16::default();
    value.store(&mut row);
    let mut bits = touched;
    while bits != 0 {
        let l = bits.trailing_zeros() as usize;
        bits &= bits - 1;
        // SAFETY: each group comes once, and touched lanes are rows of the arrays.
        unsafe { out.write((group * LANES + l) * stride + offset, row.0[l]) };
    }
}

impl RowMajor<'_> {
    /// Writes sixteen Gaussians' gradients. Only the lanes in `touched` have one; the others' values are meaningless.
    #[inline(always)]
    fn take<F: Lanes>(&self, group: usize, touched: u16, g: &RowGradients<F>) {
        for k in 0..3 {
            scatter(self.means, group, touched, 3, k, g.mean[k]);
            scatter(self.log_scales, group, touched, 3, k, g.log_scale[k]);
            scatter(self.sh0, group, touched, 3, k, g.basis[0] * g.rgb[k]);
        }
        for k in 0..4 {
            scatter(self.quats, group, touched, 4, k, g.quat[k]);
        }
        scatter(self.logit_opacities, group, touched, 1, 0, g.logit_opacity);
        let stride = 3 * (self.sh_coeffs - 1);
        for k in 1..self.sh_coeffs {
            for c in 0..3 {
                scatter(
                    self.sh_n,
                    group,
                    touched,
                    stride,
                    3 * (k - 1) + c,
                    g.basis[k] * g.rgb[c],
                );
            }
        }
    }
}

/// Adds up the slots of one chunk's splats and writes every touched group's gradients.
pub(crate) struct Gather<'a, S: Source> {
    pub view: &'a View,
    pub source: S,
    pub out: RowMajor<'a>,
    /// One chunk's visible splats, in row order.
    pub splats: &'a [Splat],
    pub slots: &'a [[f32; SUMS]],
    pub written: &'a [u8],
}

impl<S: Source> Kernel for Gather<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        let mut next = 0;
        while next < self.splats.len() {
            let group = self.splats[next].row as usize / LANES;
            let (touched, screen) =
                collect::<F>(self.splats, &mut next, group, self.slots, self.written);
            if touched == 0 {
                continue;
            }
            let gradients = unproject::<F, S>(self.view, &self.source, group, &screen);
            self.out.take(group, touched, &gradients);
        }
    }
}

/// Adds up the slots of the splats of one group, from `splats[*next]` on. Returns the lanes that any pixel touched.
#[inline(always)]
pub(crate) fn collect<F: Lanes>(
    splats: &[Splat],
    next: &mut usize,
    group: usize,
    slots: &[[f32; SUMS]],
    written: &[u8],
) -> (u16, ScreenGradients<F>) {
    let mut rows = [Lanes16::default(); SUMS];
    let mut touched = 0u16;
    while *next < splats.len() && splats[*next].row as usize / LANES == group {
        let splat = &splats[*next];
        *next += 1;
        let (from, to) = (splat.slot as usize, (splat.slot + splat.tiles) as usize);
        let mut sum = [0f32; SUMS];
        let mut any = 0;
        for slot in from..to {
            if written[slot] != 0 {
                any = 1;
                for k in 0..SUMS {
                    sum[k] += slots[slot][k];
                }
            }
        }
        let lane = splat.row as usize % LANES;
        touched |= any << lane;
        for k in 0..SUMS {
            rows[k].0[lane] = sum[k];
        }
    }
    let mut moments = [F::zero(); 6];
    for k in 0..6 {
        moments[k] = F::load(&rows[k]);
    }
    let rgb = [F::load(&rows[6]), F::load(&rows[7]), F::load(&rows[8])];
    (
        touched,
        ScreenGradients {
            moments,
            rgb,
            depth: F::load(&rows[9]),
        },
    )
}
