//! Where the heavy kernels of simplification and selection run: here, or on a device that computes the same.

use std::borrow::Cow;

use rayon::prelude::*;

use crate::linalg::affine_energy;
use crate::raster::Camera;
use crate::select::{self, Gaussians, Opaque, Surface};
use crate::simplify::{Gaussian, Merged, color, coverage, merge};
use crate::spatial::{Cells, Frame};
use crate::{Control, Result, Splats};

/// Writes the rows of a group into an empty list, its own first, and says how many are its own; the rest support it.
pub type Group<'a> = dyn Fn(usize, &mut Vec<u32>) -> usize + Sync + 'a;

/// Rows with numbers: whenever a run makes a row it gives it the next, and a copy keeps its own. By them a device
/// knows which rows it has been sent.
#[derive(Debug, Clone, Copy)]
pub struct Numbered<'a> {
    pub splats: &'a Splats,
    pub numbers: &'a [u32],
}

impl<'a> Numbered<'a> {
    /// The means of the rows in `kept`; all rows' need no copy.
    pub fn points(&self, kept: &[u32]) -> Cow<'a, [[f64; 3]]> {
        let means = &self.splats.means;
        if kept.len() == means.len() && kept.is_sorted() {
            return Cow::Borrowed(means);
        }
        kept.iter().map(|&i| means[i as usize]).collect()
    }
}

/// The kernels that policies call. An implementation may be faster than [`Cpu`]; it may not differ from it.
pub trait Backend: Sync {
    /// See [`Cells::adaptive`].
    fn cells(&self, points: &[[f64; 3]], frame: &Frame, target: usize) -> Result<Cells>;

    /// The kernels for the rows of one run of simplification.
    fn run(&self) -> Box<dyn Run + '_>;

    /// See [`select::looks`].
    fn looks(
        &self,
        scene: &Gaussians<'_>,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<[f32; 2]>>;

    /// See [`select::visible`].
    fn visible(
        &self,
        scene: &Gaussians<'_>,
        surface: &Surface,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<Vec<u32>>>;
}

/// Kernels for rows that have numbers.
pub trait Run: Sync {
    /// About `target` cells of the rows in `kept`, each there once; members count along `kept`.
    fn cells(&self, rows: Numbered<'_>, kept: &[u32], target: usize) -> Result<Cells>;

    /// The affine energy of each of `count` groups: see [`affine_energy`].
    fn energies(
        &self,
        rows: Numbered<'_>,
        count: usize,
        group: &Group<'_>,
        control: &Control,
    ) -> Result<Vec<f64>>;

    /// Each group merged into one, and how much of it that [`coverage`] finds covered.
    fn merges(
        &self,
        rows: Numbered<'_>,
        groups: &[&[u32]],
        support: f64,
        control: &Control,
    ) -> Result<Vec<(Merged, f64)>>;
}

/// The kernels of this crate.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cpu;

/// Groups between two looks at the control.
const CHUNK: usize = 256;

impl Backend for Cpu {
    fn cells(&self, points: &[[f64; 3]], frame: &Frame, target: usize) -> Result<Cells> {
        Ok(Cells::adaptive(points, frame, target))
    }

    fn run(&self) -> Box<dyn Run + '_> {
        Box::new(*self)
    }

    fn looks(
        &self,
        scene: &Gaussians<'_>,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<[f32; 2]>> {
        select::looks(&Opaque::of(scene), cameras, control)
    }

    fn visible(
        &self,
        scene: &Gaussians<'_>,
        surface: &Surface,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<Vec<u32>>> {
        select::visible(&Opaque::of(scene), surface, cameras, control)
    }
}

impl Run for Cpu {
    fn cells(&self, rows: Numbered<'_>, kept: &[u32], target: usize) -> Result<Cells> {
        let points = rows.points(kept);
        Ok(Cells::adaptive(&points, &Frame::of(&points), target))
    }

    fn energies(
        &self,
        Numbered { splats, .. }: Numbered<'_>,
        count: usize,
        group: &Group<'_>,
        control: &Control,
    ) -> Result<Vec<f64>> {
        in_chunks(count, control, |g| {
            let mut rows = Vec::new();
            let own = group(g, &mut rows);
            let points: Vec<_> = rows.iter().map(|&i| splats.means[i as usize]).collect();
            let colors: Vec<_> = rows.iter().map(|&i| color(splats, i as usize)).collect();
            affine_energy(&points, &colors, own)
        })
    }

    fn merges(
        &self,
        Numbered { splats, .. }: Numbered<'_>,
        groups: &[&[u32]],
        support: f64,
        control: &Control,
    ) -> Result<Vec<(Merged, f64)>> {
        in_chunks(groups.len(), control, |g| {
            let merged = merge(splats, groups[g]);
            let members = groups[g].iter().map(|&i| Gaussian::of(splats, i as usize));
            let covered = coverage(&members.collect::<Vec<_>>(), &merged.gaussian, support);
            (merged, covered)
        })
    }
}

/// `each` of 0 … count − 1, in order, unless the caller stops it.
fn in_chunks<T: Send>(
    count: usize,
    control: &Control,
    each: impl Fn(usize) -> T + Sync,
) -> Result<Vec<T>> {
    let chunks: Vec<Vec<T>> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .map(|c| {
            control.check()?;
            Ok((c * CHUNK..count.min((c + 1) * CHUNK)).map(&each).collect())
        })
        .collect::<Result<_>>()?;
    Ok(chunks.into_iter().flatten().collect())
}
