//! The kernels over groups of rows that a run of simplification calls, and the CPU's.

use std::borrow::Cow;

use rayon::prelude::*;

use super::{Merged, color, coverage, merge};
use crate::linalg::affine_energy;
use crate::scene::Gaussian;
use crate::spatial::{Cells, RobustBounds};
use crate::{Control, Cpu, Result, Splats};

/// Writes the rows of group `i` into an empty list, its own first, and returns how many are its own; the rest support
/// it.
pub type Group<'a> = dyn Fn(usize, &mut Vec<u32>) -> usize + Sync + 'a;

/// Kernels over the rows of one run. An implementation may differ from [`Cpu`]'s within a stated tolerance.
pub trait GroupKernels: Sync {
    /// About `target` cells of the rows in `kept`, each there once; members count along `kept`.
    fn cells(&self, splats: &Splats, kept: &[u32], target: usize) -> Result<Cells>;

    /// The affine energy of each of `count` groups: see [`affine_energy`].
    fn energies(
        &self,
        splats: &Splats,
        count: usize,
        group: &Group<'_>,
        control: &Control,
    ) -> Result<Vec<f64>>;

    /// Each group merged into one, and the share of it that [`coverage`] finds covered.
    fn merges(
        &self,
        splats: &Splats,
        groups: &[&[u32]],
        support: f64,
        control: &Control,
    ) -> Result<Vec<(Merged, f64)>>;

    /// Announce that the next calls use new rows, which a device must be sent.
    fn rows_replaced(&self) {}
}

/// The means of the rows in `kept`; borrowed if those are all rows.
pub fn means_of<'a>(splats: &'a Splats, kept: &[u32]) -> Cow<'a, [[f64; 3]]> {
    let means = &splats.means;
    if kept.len() == means.len() && kept.is_sorted() {
        return Cow::Borrowed(means);
    }
    kept.iter().map(|&i| means[i as usize]).collect()
}

impl GroupKernels for Cpu {
    fn cells(&self, splats: &Splats, kept: &[u32], target: usize) -> Result<Cells> {
        let points = means_of(splats, kept);
        Ok(Cells::adaptive(&points, &RobustBounds::of(&points), target))
    }

    fn energies(
        &self,
        splats: &Splats,
        count: usize,
        group: &Group<'_>,
        control: &Control,
    ) -> Result<Vec<f64>> {
        let energies = in_chunks(count, control, |g| {
            let mut rows = Vec::new();
            let own = group(g, &mut rows);
            let points: Vec<_> = rows.iter().map(|&i| splats.means[i as usize]).collect();
            let colors: Vec<_> = rows.iter().map(|&i| color(splats, i as usize)).collect();
            affine_energy(&points, &colors, own)
        })?;
        Ok(energies.collect())
    }

    fn merges(
        &self,
        splats: &Splats,
        groups: &[&[u32]],
        support: f64,
        control: &Control,
    ) -> Result<Vec<(Merged, f64)>> {
        let merges = in_chunks(groups.len(), control, |g| {
            let merged = merge(splats, groups[g]);
            let members = groups[g].iter().map(|&i| Gaussian::of(splats, i as usize));
            let covered = coverage(&members.collect::<Vec<_>>(), &merged.gaussian, support);
            (merged, covered)
        })?;
        Ok(merges.collect())
    }
}

/// Groups between two checks of the control.
const CHUNK: usize = 256;

/// `make` of 0 … count − 1 on all threads, in order, unless the caller stops it.
pub(super) fn in_chunks<T: Send>(
    count: usize,
    control: &Control,
    make: impl Fn(usize) -> T + Sync,
) -> Result<impl Iterator<Item = T>> {
    let chunks: Vec<Vec<T>> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .with_max_len(1)
        .map(|c| {
            control.check()?;
            Ok((c * CHUNK..count.min((c + 1) * CHUNK)).map(&make).collect())
        })
        .collect::<Result<_>>()?;
    Ok(chunks.into_iter().flatten())
}
