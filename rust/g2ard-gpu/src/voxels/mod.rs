//! Twin of `g2ard_core::spatial::Cells::adaptive`: the same cells, bit for bit.

use g2ard_core::simplify::means_of;
use g2ard_core::spatial::{
    BITS, Cells, OCTAVES, RobustBounds, first_apart, octave_counts, search_size, unit,
};
use rayon::prelude::*;

use crate::rows::{Numbered, POINTS, Rows};
use crate::runtime::{Buffer, Gpu, Kernel, Result, Work};
use crate::soft64::SOFT64;
use crate::sort::{Keyed, sort};
use crate::{scan, words};

const KEYS: Kernel = Kernel {
    name: "voxels.keys",
    sources: &[SOFT64, include_str!("voxels.wgsl")],
    entry: "find_keys",
};
const NEIGHBOURS: &[&str] = &[include_str!("edges.wgsl")];
const APART: Kernel = Kernel {
    name: "voxels.octaves",
    sources: NEIGHBOURS,
    entry: "octaves",
};
const EDGES: Kernel = Kernel {
    name: "voxels.edges",
    sources: NEIGHBOURS,
    entry: "edges",
};
const COMPACT: Kernel = Kernel {
    name: "voxels.compact",
    sources: NEIGHBOURS,
    entry: "compact",
};

/// Rows a workgroup of 64 threads, or of 256 with four each, takes.
const THREADS: usize = 64;
const BLOCK: usize = 1024;

/// Words that a position takes, and a key.
const POINT: usize = 6;
const KEY: usize = 2;

/// A point beyond the lattice.
const OUTSIDE: u64 = u64::MAX;

/// See [`Cells::adaptive`].
pub fn adaptive(
    gpu: &Gpu,
    points: &[[f64; 3]],
    bounds: &RobustBounds,
    target: usize,
) -> Result<Cells> {
    let pieces = points
        .chunks(most_points(gpu))
        .map(|piece| gpu.upload("positions", piece));
    let pieces = pieces.collect::<Result<_>>()?;
    cells(gpu, pieces, points, bounds, target)
}

/// See [`g2ard_core::simplify::GroupKernels::cells`].
pub fn of_rows(
    gpu: &Gpu,
    held: &Rows,
    rows: Numbered<'_>,
    kept: &[u32],
    target: usize,
) -> Result<Cells> {
    let points = means_of(rows.splats, kept);
    let numbers: Vec<u32> = kept.iter().map(|&i| rows.numbers[i as usize]).collect();
    let pieces = match held.all_means(&numbers) {
        Some(pieces) => pieces,
        None => {
            let mut work = Work::new(gpu);
            let pieces = numbers
                .chunks(most_points(gpu))
                .map(|numbers| held.gather(gpu, &mut work, &POINTS, numbers))
                .collect::<Result<_>>()?;
            work.submit(&[])?;
            pieces
        }
    };
    cells(gpu, pieces, &points, &RobustBounds::of(&points), target)
}

/// Points that one buffer may hold.
fn most_points(gpu: &Gpu) -> usize {
    (gpu.max_words() / POINT).max(1)
}

/// The cells of points that the device has.
fn cells(
    gpu: &Gpu,
    pieces: Vec<Buffer>,
    points: &[[f64; 3]],
    bounds: &RobustBounds,
    target: usize,
) -> Result<Cells> {
    if points.is_empty() {
        return Ok(Cells::with_size(points, bounds, bounds.radius));
    }
    let lattice = Lattice::new(gpu, pieces, points, *bounds);
    let octaves = octave_counts(&lattice.apart()?);
    let size = search_size(bounds, &octaves, target, |size| lattice.count(size))?;
    lattice.cells(size)
}

/// Positions on the device: in runs of rows whose keys fit into one buffer, each run in pieces that do.
struct Lattice<'a> {
    gpu: &'a Gpu,
    bounds: RobustBounds,
    /// The largest coordinate from the lattice's corner; floaters lie beyond the bounds.
    reach: f64,
    runs: Vec<Run>,
}

struct Run {
    /// Its first row among all.
    first: usize,
    count: usize,
    pieces: Vec<Buffer>,
}

impl<'a> Lattice<'a> {
    fn new(gpu: &'a Gpu, pieces: Vec<Buffer>, points: &[[f64; 3]], bounds: RobustBounds) -> Self {
        let mut runs: Vec<Run> = Vec::new();
        let mut first = 0;
        for piece in pieces {
            let count = piece.words() / POINT;
            match runs.last_mut() {
                Some(run) if KEY * (run.count + count) <= gpu.max_words() => {
                    run.count += count;
                    run.pieces.push(piece);
                }
                _ => runs.push(Run {
                    first,
                    count,
                    pieces: vec![piece],
                }),
            }
            first += count;
        }
        let reach = |p: &[f64; 3]| {
            let from_corner = [0, 1, 2].map(|k| p[k] - bounds.origin[k] + bounds.radius);
            from_corner.into_iter().fold(0.0, f64::max)
        };
        Self {
            gpu,
            bounds,
            reach: points.par_iter().map(reach).reduce(|| 0.0, f64::max),
            runs,
        }
    }

    /// A run's keys, sorted, with its rows (counted from the run's first).
    fn sorted(&self, work: &mut Work, run: &Run, size: f64, clamped: bool) -> Result<Keyed> {
        let keyed = Keyed::new(self.gpu, run.count)?;
        let mut first = 0;
        for piece in &run.pieces {
            let rows = piece.words() / POINT;
            let [x, y, z] = self.bounds.origin;
            let mut lattice = words(&[x, y, z, self.bounds.radius, size]);
            lattice.extend([first as u32, rows as u32, u32::from(clamped), u32::MAX]);
            let buffers = [piece, &keyed.keys, &keyed.words];
            work.run(&KEYS, rows.div_ceil(THREADS), &lattice, &buffers)?;
            first += rows;
        }
        sort(self.gpu, work, keyed, run.count, 0..self.bits(size))
    }

    /// Bits in which keys at this size differ, and one more, which only the outside has.
    fn bits(&self, size: f64) -> usize {
        let cells = (self.reach / size).max(1.0).log2() as u32 + 1;
        (3 * cells.min(BITS) + 1) as usize
    }

    /// How many neighbours in Morton order first fall apart at each octave.
    fn apart(&self) -> Result<[usize; OCTAVES]> {
        let size = unit(&self.bounds);
        let mut apart = [0; OCTAVES];
        if let [run] = &self.runs[..] {
            let mut work = Work::new(self.gpu);
            let sorted = self.sorted(&mut work, run, size, true)?;
            let blocks = run.count.div_ceil(BLOCK);
            let counts = self.gpu.buffer("octaves", OCTAVES * blocks)?;
            let constants = [run.count as u32, 0, 0, 0];
            work.run(&APART, blocks, &constants, &[&sorted.keys, &counts])?;
            let found = work.submit(&[(&counts, OCTAVES * blocks)])?.take()?;
            for block in found[0].chunks(OCTAVES) {
                apart
                    .iter_mut()
                    .zip(block)
                    .for_each(|(a, &b)| *a += b as usize);
            }
            return Ok(apart);
        }
        let merged = self.merged(size, true)?;
        for w in merged.windows(2).filter(|w| w[0].0 != w[1].0) {
            apart[first_apart(w[0].0, w[1].0)] += 1;
        }
        Ok(apart)
    }

    /// Occupied cells of a size.
    fn count(&self, size: f64) -> Result<usize> {
        if let [run] = &self.runs[..] {
            let mut work = Work::new(self.gpu);
            let (.., total) = self.edges(&mut work, run, size)?;
            return Ok(work.submit(&[(&total, 1)])?.take()?[0][0] as usize);
        }
        let merged = self.merged(size, false)?;
        Ok(begins(&merged).count())
    }

    /// Sorted keys, the number of cells before each, and the number of all.
    fn edges(&self, work: &mut Work, run: &Run, size: f64) -> Result<(Keyed, Buffer, Buffer)> {
        let sorted = self.sorted(work, run, size, false)?;
        let ranks = self.gpu.buffer("ranks", run.count)?;
        let constants = [run.count as u32, 0, 0, 0];
        let groups = run.count.div_ceil(THREADS);
        // Bindings are numbered: `ranks` stands behind `counts`, which this kernel does not use.
        work.run_at(
            &EDGES,
            groups,
            &constants,
            &[(1, &sorted.keys), (3, &ranks)],
        )?;
        let total = scan::exclusive(self.gpu, work, &ranks, run.count)?;
        Ok((sorted, ranks, total))
    }

    /// The cells of a size.
    fn cells(&self, size: f64) -> Result<Cells> {
        let rows: usize = self.runs.iter().map(|r| r.count).sum();
        if let [run] = &self.runs[..] {
            let mut work = Work::new(self.gpu);
            let (sorted, ranks, total) = self.edges(&mut work, run, size)?;
            let found = work.submit(&[(&total, 1), (&sorted.words, rows)])?;
            let [total, members] = <[_; 2]>::try_from(found.take()?).unwrap_or_default();
            let cells = total.first().map_or(0, |&t| t as usize);
            let starts = self.gpu.buffer("cells", cells)?;
            let codes = self.gpu.buffer("codes", KEY * cells)?;
            let mut work = Work::new(self.gpu);
            let bound = [(1, &sorted.keys), (3, &ranks), (4, &starts), (5, &codes)];
            let groups = rows.div_ceil(THREADS);
            work.run_at(&COMPACT, groups, &[rows as u32, 0, 0, 0], &bound)?;
            let found = work.submit(&[(&starts, cells), (&codes, KEY * cells)])?;
            let [mut starts, codes] = <[_; 2]>::try_from(found.take()?).unwrap_or_default();
            starts.push(rows as u32);
            let codes = codes
                .chunks(KEY)
                .map(|w| u64::from(w[1]) << 32 | u64::from(w[0]));
            return Ok(Cells::from_parts(
                size,
                starts,
                members,
                codes.map(inside).collect(),
            ));
        }
        let merged = self.merged(size, false)?;
        let mut starts: Vec<u32> = begins(&merged).map(|i| i as u32).collect();
        let keys = starts
            .iter()
            .map(|&i| inside(merged[i as usize].0))
            .collect();
        starts.push(rows as u32);
        let members = merged.into_par_iter().map(|(_, row)| row).collect();
        Ok(Cells::from_parts(size, starts, members, keys))
    }

    /// The keys of all runs in one order, with their rows.
    fn merged(&self, size: f64, clamped: bool) -> Result<Vec<(u64, u32)>> {
        let mut all = Vec::with_capacity(self.runs.iter().map(|r| r.count).sum());
        for run in &self.runs {
            let mut work = Work::new(self.gpu);
            let sorted = self.sorted(&mut work, run, size, clamped)?;
            let reads = [(&sorted.keys, KEY * run.count), (&sorted.words, run.count)];
            let found = work.submit(&reads)?.take()?;
            let keys = found[0]
                .chunks(KEY)
                .map(|w| u64::from(w[1]) << 32 | u64::from(w[0]));
            all.extend(keys.zip(found[1].iter().map(|&row| run.first as u32 + row)));
        }
        all.par_sort(); // runs are found and merged, not sorted anew
        Ok(all)
    }
}

fn inside(key: u64) -> Option<u64> {
    (key != OUTSIDE).then_some(key)
}

/// Where cells begin in sorted order.
fn begins(sorted: &[(u64, u32)]) -> impl Iterator<Item = usize> + '_ {
    (0..sorted.len())
        .filter(|&i| i == 0 || sorted[i].0 != sorted[i - 1].0 || sorted[i].0 == OUTSIDE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::Options;
    use crate::testing::{gpu_with, scenes, share};

    fn compare(gpu: &Gpu, what: &str) {
        for (name, splats) in scenes(12_000) {
            let points = &splats.means;
            let bounds = RobustBounds::of(points);
            for target in [1, 3000] {
                let want = Cells::adaptive(points, &bounds, target);
                let got = adaptive(gpu, points, &bounds, target).unwrap();
                let ids = |cells: &Cells| {
                    let mut ids = vec![0; points.len()];
                    for c in 0..cells.len() {
                        cells
                            .members_of(c)
                            .iter()
                            .for_each(|&i| ids[i as usize] = c);
                    }
                    ids
                };
                let equal = share(&ids(&want), &ids(&got));
                eprintln!(
                    "{what} {name}, {target} cells: {:.4} % of ids equal",
                    100.0 * equal
                );
                assert_eq!(got, want, "{name}");
            }
        }
    }

    #[test]
    fn cells_are_the_cpus() {
        let Some(gpu) = gpu_with("voxels", Options::default()) else {
            return;
        };
        compare(&gpu, "voxels");
    }

    #[test]
    fn cells_are_the_cpus_in_pieces() {
        let max_binding = Some(1 << 17);
        let Some(gpu) = gpu_with(
            "voxels in pieces",
            Options {
                max_binding,
                ..Options::default()
            },
        ) else {
            return;
        };
        compare(&gpu, "voxels in pieces");
    }
}
