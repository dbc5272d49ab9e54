//! GPU kernels for `g2ard_core::spatial::Cells::adaptive`. Cells are computed in integers, equal on every device;
//! points within rounding of a border may fall into the cell next to the CPU's.

use g2ard_core::simplify::means_of;
use g2ard_core::spatial::{BITS, Cells, OCTAVES, RobustBounds, octave_counts, search_size, unit};
use rayon::prelude::*;

use crate::rows::{POINTS, Run};
use crate::runtime::{Buffer, Gpu, Kernel, Result, Work};
use crate::scan;
use crate::sort::{Keyed, sort};
use crate::two::Frame;

const KEYS: Kernel = Kernel::new("voxels.keys", &[include_str!("voxels.wgsl")], "find_keys");
const NEIGHBOURS: &[&str] = &[include_str!("edges.wgsl")];
const APART: Kernel = Kernel::new("voxels.octaves", NEIGHBOURS, "octaves");
const EDGES: Kernel = Kernel::new("voxels.edges", NEIGHBOURS, "edges");
const COMPACT: Kernel = Kernel::new("voxels.compact", NEIGHBOURS, "compact");

/// Rows per workgroup: 64 threads with one row each, or 256 with four.
const THREADS: usize = 64;
const BLOCK: usize = 1024;

/// Words per position, and per key.
const POINT: usize = 6;
const KEY: usize = 2;

/// A point beyond the lattice.
const OUTSIDE: u64 = u64::MAX;

/// See [`g2ard_core::simplify::GroupKernels::cells`].
pub fn adaptive(run: Run<'_>, kept: &[u32], target: usize) -> Result<Cells> {
    let points = means_of(run.splats, kept);
    let bounds = RobustBounds::of(&points);
    let mut work = Work::new(run.gpu);
    let pieces = kept
        .chunks((run.gpu.max_words() / POINT).max(1))
        .map(|rows| run.gather(&mut work, POINTS, rows))
        .collect::<Result<_>>()?;
    work.submit(&[])?;
    let reach = |p: &[f64; 3]| {
        let from_corner = [0, 1, 2].map(|k| p[k] - bounds.origin[k] + bounds.radius);
        from_corner.into_iter().fold(0.0, f64::max)
    };
    let lattice = Lattice {
        gpu: run.gpu,
        frame: run.frame,
        bounds,
        reach: points.par_iter().map(reach).reduce(|| 0.0, f64::max),
        count: points.len(),
        pieces,
    };
    lattice.adaptive(target)
}

/// Positions on the device, in pieces. Their keys must fit into one buffer.
struct Lattice<'a> {
    gpu: &'a Gpu,
    frame: Frame,
    bounds: RobustBounds,
    /// The largest coordinate from the lattice's corner; floaters lie beyond the bounds.
    reach: f64,
    count: usize,
    pieces: Vec<Buffer>,
}

impl Lattice<'_> {
    /// Cells of which about `target` are occupied.
    fn adaptive(&self, target: usize) -> Result<Cells> {
        if self.count == 0 {
            return Ok(Cells::with_size(&[], &self.bounds, self.bounds.radius));
        }
        let octaves = octave_counts(&self.apart()?);
        let size = search_size(&self.bounds, &octaves, target, |size| self.occupied(size))?;
        self.cells(size)
    }

    /// The lattice's fields in voxels.wgsl, except for those of a piece. Rounded so that points on a border, such as
    /// those that define the bounds, fall into the upper cell.
    fn words(&self, size: f64) -> [u32; 8] {
        let RobustBounds { origin, radius } = self.bounds;
        let corner = self.frame.fixed(origin.map(|v| v - radius)).map(|v| v - 2);
        let [[xl, xh], [yl, yh], [zl, zh]] = corner.map(|v| [v as u32, (v >> 32) as u32]);
        let units = size / self.frame.unit(); // 2¹⁵ at least: the frame ends 2²⁴ radii out
        let shift = units.log2().floor() + 31.0;
        let per_unit = (shift.exp2() / units).ceil() as u32;
        [xl, xh, yl, yh, zl, zh, per_unit, shift as u32]
    }

    /// Sorted keys with their rows.
    fn sorted(&self, work: &mut Work, size: f64, clamped: bool) -> Result<Keyed> {
        let keyed = Keyed::new(self.gpu, self.count)?;
        let mut first = 0;
        for piece in &self.pieces {
            let rows = piece.words() / POINT;
            let mut lattice = self.words(size).to_vec();
            lattice.extend([first as u32, rows as u32, u32::from(clamped), u32::MAX]);
            let buffers = [piece, &keyed.keys, &keyed.words];
            work.run(&KEYS, rows.div_ceil(THREADS), &lattice, &buffers)?;
            first += rows;
        }
        sort(self.gpu, work, keyed, self.count, 0..self.bits(size))
    }

    /// Number of bits in which keys at this size differ, plus one that only points outside have.
    fn bits(&self, size: f64) -> usize {
        let cells = (self.reach / size).max(1.0).log2() as u32 + 1;
        (3 * cells.min(BITS) + 1) as usize
    }

    /// Number of neighbours in Morton order that first separate at each octave.
    fn apart(&self) -> Result<[usize; OCTAVES]> {
        let mut work = Work::new(self.gpu);
        let sorted = self.sorted(&mut work, unit(&self.bounds), true)?;
        let blocks = self.count.div_ceil(BLOCK);
        let counts = self.gpu.buffer("octaves", OCTAVES * blocks)?;
        let buffers = [&sorted.keys, &counts];
        work.run(&APART, blocks, &[self.count as u32], &buffers)?;
        let found = work.submit(&[(&counts, OCTAVES * blocks)])?.take()?;
        let mut apart = [0; OCTAVES];
        for block in found[0].chunks(OCTAVES) {
            let octaves = apart.iter_mut().zip(block);
            octaves.for_each(|(sum, &count)| *sum += count as usize);
        }
        Ok(apart)
    }

    /// Number of occupied cells of a size.
    fn occupied(&self, size: f64) -> Result<usize> {
        let mut work = Work::new(self.gpu);
        let (.., total) = self.edges(&mut work, size)?;
        Ok(work.submit(&[(&total, 1)])?.take()?[0][0] as usize)
    }

    /// Sorted keys, the number of cells before each, and the number of all cells.
    fn edges(&self, work: &mut Work, size: f64) -> Result<(Keyed, Buffer, Buffer)> {
        let sorted = self.sorted(work, size, false)?;
        let ranks = self.gpu.buffer("ranks", self.count)?;
        let groups = self.count.div_ceil(THREADS);
        // Bindings are numbered: `ranks` follows `counts`, which this kernel does not use.
        let bound = [(1, &sorted.keys), (3, &ranks)];
        work.run_at(&EDGES, groups, &[self.count as u32], &bound)?;
        let total = scan::exclusive(self.gpu, work, &ranks, self.count)?;
        Ok((sorted, ranks, total))
    }

    /// The cells of a size.
    fn cells(&self, size: f64) -> Result<Cells> {
        let rows = self.count;
        let mut work = Work::new(self.gpu);
        let (sorted, ranks, total) = self.edges(&mut work, size)?;
        let found = work.submit(&[(&total, 1), (&sorted.words, rows)])?;
        let [total, members] = <[_; 2]>::try_from(found.take()?).unwrap_or_default();
        let cells = total.first().map_or(0, |&t| t as usize);
        let starts = self.gpu.buffer("cells", cells)?;
        let codes = self.gpu.buffer("codes", KEY * cells)?;
        let mut work = Work::new(self.gpu);
        let bound = [(1, &sorted.keys), (3, &ranks), (4, &starts), (5, &codes)];
        let groups = rows.div_ceil(THREADS);
        work.run_at(&COMPACT, groups, &[rows as u32], &bound)?;
        let found = work.submit(&[(&starts, cells), (&codes, KEY * cells)])?;
        let [mut starts, codes] = <[_; 2]>::try_from(found.take()?).unwrap_or_default();
        starts.push(rows as u32);
        let code = |words: &[u32]| u64::from(words[1]) << 32 | u64::from(words[0]);
        let codes = codes.chunks(KEY).map(code);
        let inside = codes.map(|code| (code != OUTSIDE).then_some(code));
        Ok(Cells {
            size,
            starts,
            members,
            keys: inside.collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rows::Rows;
    use crate::testing::{WHOLE, compare_on_gpu, scenes};
    use std::collections::HashMap;

    /// Points nearer to a border than this share of a cell may fall into the next cell.
    const BORDER: f64 = 1e-6;

    /// Compare cells with the CPU's: cells of one size hold the same rows, except for rows on a border, and about as
    /// many cells are found.
    fn compare(gpu: &Gpu) {
        for (name, splats) in scenes(12_000) {
            let points = &splats.means;
            let bounds = RobustBounds::of(points);
            let all: Vec<u32> = (0..points.len() as u32).collect();
            let mut held = Rows::default();
            let run = held.of(gpu, &splats).unwrap();
            for target in [1, 3000] {
                let want = Cells::adaptive(points, &bounds, target);
                let got = adaptive(run, &all, target).unwrap();
                let off = (got.len() as f64 / want.len() as f64 - 1.0).abs();
                assert!(off < 0.04, "{name}: {} of {} cells", got.len(), want.len());
                let same = Cells::with_size(points, &bounds, got.size);
                let (mut moved, of_cpu) = (0, ids(&same, points.len()));
                let mut cells = HashMap::new();
                for (i, id) in ids(&got, points.len()).into_iter().enumerate() {
                    if on_border(points[i], &bounds, got.size) {
                        moved += 1;
                    } else {
                        assert_eq!(*cells.entry(id).or_insert(of_cpu[i]), of_cpu[i], "{name}");
                    }
                }
                eprintln!("{name}: {} cells, {moved} rows on borders", got.len());
                let few = moved * 1000 <= points.len() + 3000;
                assert!(few || name == "identical", "{name}: {moved} on borders");
            }
        }
    }

    fn ids(cells: &Cells, count: usize) -> Vec<usize> {
        let mut ids = vec![0; count];
        for c in 0..cells.len() {
            let members = cells.members_of(c);
            members.iter().for_each(|&i| ids[i as usize] = c);
        }
        ids
    }

    fn on_border(point: [f64; 3], bounds: &RobustBounds, size: f64) -> bool {
        (0..3).any(|k| {
            let at = (point[k] - bounds.origin[k] + bounds.radius) / size;
            (at - at.round()).abs() < BORDER
        })
    }

    #[test]
    fn cells_are_the_cpus_but_on_borders() {
        compare_on_gpu(&[WHOLE, 1 << 17], compare);
    }
}
