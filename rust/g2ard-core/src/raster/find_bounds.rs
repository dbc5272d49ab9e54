//! The bounds of a scene's rows.

use std::ops::Range;

use rayon::prelude::*;

use super::bounds::{Bounds, GROUPS};
use super::params::{Params, Source};
use super::simd::{Isa, Kernel, LANES, Lanes, Lanes16, Mask, dispatch};

impl Params<'_> {
    /// Bounds of neighbouring rows, which are close if the scene is ordered in space.
    pub fn find_bounds(&self) -> Vec<Bounds> {
        bounds_of(self)
    }
}

impl Bounds {
    /// Bounds of rows in consecutive groups.
    #[inline(always)]
    pub(crate) fn of_groups<F: Lanes, S: Source>(source: &S, groups: Range<usize>) -> Self {
        let (lowest, highest) = (F::splat(f32::NEG_INFINITY), F::splat(f32::INFINITY));
        let (mut low, mut high, mut scale) = ([highest; 3], [lowest; 3], F::zero());
        for group in groups {
            let rows = (source.len() - group * LANES).min(LANES);
            let real = F::Mask::from_bits(((1u32 << rows) - 1) as u16);
            for k in 0..3 {
                let mean = source.mean::<F>(group, k);
                low[k] = low[k].min(F::select(real, mean, highest));
                high[k] = high[k].max(F::select(real, mean, lowest));
                scale = scale.max(source.scale::<F>(group, k).only(real));
            }
        }
        let mut ends = [[0.0; 3]; 2];
        for k in 0..3 {
            ends[0][k] = values(low[k]).into_iter().fold(f32::INFINITY, f32::min);
            ends[1][k] = values(high[k])
                .into_iter()
                .fold(f32::NEG_INFINITY, f32::max);
        }
        let scale = values(scale).into_iter().fold(0.0, f32::max);
        Self::of_box(ends[0], ends[1], scale)
    }
}

/// The bounds of every [`GROUPS`] groups.
pub(crate) fn bounds_of<S: Source>(source: &S) -> Vec<Bounds> {
    let groups = source.len().div_ceil(LANES);
    let starts = (0..groups).into_par_iter().step_by(GROUPS);
    starts
        .map(|first| {
            let groups = first..groups.min(first + GROUPS);
            dispatch(Isa::detect(), FindBounds { source, groups })
        })
        .collect()
}

struct FindBounds<'a, S: Source> {
    source: &'a S,
    groups: Range<usize>,
}

impl<S: Source> Kernel for FindBounds<'_, S> {
    type Output = Bounds;

    #[inline(always)]
    fn run<F: Lanes>(self) -> Bounds {
        Bounds::of_groups::<F, _>(self.source, self.groups)
    }
}

fn values<F: Lanes>(lanes: F) -> [f32; LANES] {
    let mut row = Lanes16::default();
    lanes.store(&mut row);
    row.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::small::Small;

    #[test]
    fn bounds_hold_the_means_and_the_largest_scale_of_any_axis() {
        let scene = Small::new();
        for axis in 0..3 {
            let params = scene.params();
            let mut log_scales = params.log_scales.to_vec();
            log_scales[3 * 20 + axis] = 0.0;
            let first = Params {
                log_scales: &log_scales,
                ..params
            }
            .find_bounds()[0];
            let rows = &params.means.as_chunks::<3>().0[..(LANES * GROUPS).min(params.len())];
            let ends = |of: fn(f32, f32) -> f32, from: f32| {
                [0, 1, 2].map(|k| rows.iter().fold(from, |end, mean| of(end, mean[k])))
            };
            let (low, high) = (ends(f32::min, f32::MAX), ends(f32::max, f32::MIN));
            assert_eq!(first, Bounds::of_box(low, high, 1.0));
        }
    }
}
