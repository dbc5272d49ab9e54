//! Access to the Gaussians' stored values, sixteen rows at a time.

use super::bounds::{Bounds, GROUPS};
use super::simd::{LANES, Lanes, Lanes16};
use crate::{Error, Result};

/// N Gaussians in the torch layout: row-major borrowed slices, each in its stored (not activated) space.
#[derive(Debug, Clone, Copy)]
pub struct Params<'a> {
    /// N × 3.
    pub means: &'a [f32],
    /// N × 4, wxyz, any length; zero means no rotation.
    pub quats: &'a [f32],
    /// N × 3.
    pub log_scales: &'a [f32],
    /// N.
    pub logit_opacities: &'a [f32],
    /// N × 3.
    pub sh0: &'a [f32],
    /// N × (K−1) × 3.
    pub sh_n: &'a [f32],
    /// K: 1, 4, 9 or 16.
    pub sh_coeffs: usize,
    /// What [`Params::find_bounds`] returned for these rows; with it, rows that a view cannot see cost nothing.
    pub bounds: Option<&'a [Bounds]>,
}

impl Params<'_> {
    pub fn len(&self) -> usize {
        self.logit_opacities.len()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Every slice has N rows and K is that of a degree from 0 to 3.
    pub fn validate(&self) -> Result<()> {
        refuse!(![1, 4, 9, 16].contains(&self.sh_coeffs) => "sh", "1, 4, 9 or 16 coefficients", self.sh_coeffs);
        let n = self.len();
        check_count(n)?;
        for (name, slice, width) in [
            ("means", self.means, 3),
            ("quats", self.quats, 4),
            ("log_scales", self.log_scales, 3),
            ("sh0", self.sh0, 3),
            ("shN", self.sh_n, 3 * (self.sh_coeffs - 1)),
        ] {
            refuse!(slice.len() != n * width =>
                name, format!("{n} rows of {width}"), format!("{} values", slice.len()));
        }
        let bounds = n.div_ceil(LANES).div_ceil(GROUPS);
        Error::unless_equal(
            "bounds",
            self.bounds.map_or(bounds, <[_]>::len),
            bounds,
            "bounds",
        )?;
        Ok(())
    }
}

/// Rows and their slots are numbered in 32 bits.
pub(crate) fn check_count(rows: usize) -> Result<()> {
    refuse!(rows > u32::MAX as usize / 64 => "means", "at most 67 million rows", rows);
    Ok(())
}

/// Sixteen Gaussians' values by attribute. Lanes past the end repeat the last row.
pub(crate) trait Source: Copy + Sync {
    /// Whether there are colours; without, splats are black.
    const COLOURED: bool = true;

    fn len(&self) -> usize;
    /// Bounds of every [`GROUPS`] groups, if they are known.
    fn bounds(&self) -> Option<&[Bounds]> {
        None
    }
    fn sh_coeffs(&self) -> usize;
    fn mean<F: Lanes>(&self, group: usize, axis: usize) -> F;
    fn quat<F: Lanes>(&self, group: usize, part: usize) -> F;
    fn scale<F: Lanes>(&self, group: usize, axis: usize) -> F;
    fn logit_opacity<F: Lanes>(&self, group: usize) -> F;
    /// Coefficient `k` (0 is the base colour) of channel `c`.
    fn sh<F: Lanes>(&self, group: usize, k: usize, c: usize) -> F;
}

/// Every `stride`-th value from a row-major array, `offset` into the row.
#[inline(always)]
fn strided<F: Lanes>(values: &[f32], group: usize, stride: usize, offset: usize) -> F {
    let mut row = Lanes16::default();
    let first = group * LANES;
    let start = first * stride + offset;
    if values.len() >= (first + LANES) * stride {
        for l in 0..LANES {
            row.0[l] = values[start + l * stride];
        }
    } else {
        let last = values.len() / stride - 1 - first;
        for l in 0..LANES {
            row.0[l] = values[start + l.min(last) * stride];
        }
    }
    F::load(&row)
}

impl Source for Params<'_> {
    #[inline(always)]
    fn len(&self) -> usize {
        self.logit_opacities.len()
    }
    fn bounds(&self) -> Option<&[Bounds]> {
        self.bounds
    }
    #[inline(always)]
    fn sh_coeffs(&self) -> usize {
        self.sh_coeffs
    }
    #[inline(always)]
    fn mean<F: Lanes>(&self, group: usize, axis: usize) -> F {
        strided(self.means, group, 3, axis)
    }
    #[inline(always)]
    fn quat<F: Lanes>(&self, group: usize, part: usize) -> F {
        strided(self.quats, group, 4, part)
    }
    #[inline(always)]
    fn scale<F: Lanes>(&self, group: usize, axis: usize) -> F {
        strided::<F>(self.log_scales, group, 3, axis).exp()
    }
    #[inline(always)]
    fn logit_opacity<F: Lanes>(&self, group: usize) -> F {
        strided(self.logit_opacities, group, 1, 0)
    }
    #[inline(always)]
    fn sh<F: Lanes>(&self, group: usize, k: usize, c: usize) -> F {
        if k == 0 {
            strided(self.sh0, group, 3, c)
        } else {
            strided(self.sh_n, group, 3 * (self.sh_coeffs - 1), 3 * (k - 1) + c)
        }
    }
}
