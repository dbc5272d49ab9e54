//! The raster: rows that a view may show, sorted by depth, distributed over tiles and drawn front to back.

use super::scene::Scene;
use super::view::View;
use crate::runtime::{Buffer, Error, Gpu, Kernel, Pending, Result, Work};
use crate::scan;
use crate::sort::{Keyed, sort};

const PINHOLE: &str = include_str!("pinhole.wgsl");
const PROJECTION: &[&str] = &[PINHOLE, include_str!("mark.wgsl")];
const TILES: &[&str] = &[PINHOLE, include_str!("tiles.wgsl")];
const DRAW: &[&str] = &[PINHOLE, include_str!("draw.wgsl")];

const MARK: Kernel = Kernel::new("visibility.mark", PROJECTION, "mark");
const GATHER: Kernel = Kernel::new("visibility.gather", PROJECTION, "gather");
const COUNT: Kernel = Kernel::new("visibility.count", TILES, "count");
const EXPAND: Kernel = Kernel::new("visibility.expand", TILES, "expand");
const RANGES: Kernel = Kernel::new("visibility.ranges", TILES, "ranges");
const COLLECT: Kernel = Kernel::new("visibility.collect", TILES, "collect");
const DEPTHS: Kernel = Kernel::new("visibility.depths", DRAW, "depths");
const WEIGH: Kernel = Kernel::new("visibility.weigh", DRAW, "weigh");

/// Rows per workgroup of the projection, and threads per workgroup of all other kernels.
const BLOCK: usize = 256;
pub const THREADS: usize = 64;
/// Words of a splat.
const SPLAT: usize = 10;
/// Pixels along a side of a tile.
const TILE: usize = 16;
/// Depths are positive floats, so their bits sort like their values.
const DEPTH_BITS: usize = 32;
/// Most pairs of splat and tile that prefix sums can count.
const MAX_PAIRS: u64 = 1 << 31;
/// Loop iterations of `weigh` per pair.
const WEIGH_ROUNDS: usize = 7;

/// Result of drawing.
#[derive(Clone, Copy)]
pub enum Goal<'a> {
    /// The median depth of each pixel.
    Depths(&'a Buffer),
    /// Σ αT², added to each row's.
    Weights(&'a Buffer),
}

/// A view whose rows are being marked: those that it may show.
pub struct Marked<'a> {
    gpu: &'a Gpu,
    scene: &'a Scene,
    pub view: View,
    /// Light left at each pixel.
    light: Buffer,
    sums: Buffer,
    pending: Pending<'a>,
}

impl<'a> Marked<'a> {
    /// Start to mark the rows of a scene.
    pub fn begin(
        gpu: &'a Gpu,
        mut work: Work<'a>,
        scene: &'a Scene,
        view: View,
        light: Buffer,
    ) -> Result<Self> {
        let blocks = scene.count.div_ceil(BLOCK);
        let sums = gpu.buffer("marks", scene.count + 1)?;
        let tiles = gpu.buffer("tiles", blocks)?;
        let rows = view.over(scene.count);
        let buffers = [&scene.rows, &sums, &tiles];
        work.run(&MARK, blocks, rows.words(), &buffers)?;
        let total = scan::exclusive(gpu, &mut work, &sums, scene.count + 1)?;
        let pending = work.submit(&[(&total, 1), (&tiles, blocks)])?;
        Ok(Self {
            gpu,
            scene,
            view,
            light,
            sums,
            pending,
        })
    }

    /// Draw the marked rows onto the light. Pairs that do not fit at once are drawn in several passes, nearer ones
    /// first.
    pub fn draw(self, work: &mut Work<'_>, goal: Goal<'_>) -> Result<()> {
        let Self { gpu, scene, .. } = self;
        let found = self.pending.take()?;
        let count = found[0][0] as usize;
        if count == 0 {
            return Ok(());
        }
        let pairs: u64 = found[1].iter().map(|&t| u64::from(t)).sum();
        if pairs >= MAX_PAIRS {
            return Err(Error::TooMany {
                what: "pairs of splat and tile of a view",
                count: pairs,
                limit: MAX_PAIRS - 1,
            });
        }
        let records = gpu.buffer("splats", SPLAT * count)?;
        let keyed = Keyed::new(gpu, count)?;
        let bound = [
            (1, &scene.rows),
            (2, &self.sums),
            (4, &records),
            (5, &keyed.keys),
            (6, &keyed.words),
        ];
        let rows = self.view.over(scene.count);
        let blocks = scene.count.div_ceil(BLOCK);
        work.run_at(&GATHER, blocks, rows.words(), &bound)?;
        let order = sort(gpu, work, keyed, count, 0..DEPTH_BITS)?.words;
        let before = gpu.buffer("tiles before", count)?;
        let splats = self.view.over(count);
        let groups = count.div_ceil(THREADS);
        let buffers = [&records, &order, &before];
        work.run(&COUNT, groups, splats.words(), &buffers)?;
        scan::exclusive(gpu, work, &before, count)?;
        let drawing = Drawing {
            gpu,
            view: View {
                all_pairs: pairs as u32,
                ..splats
            },
            light: &self.light,
            records,
            order,
            before,
            bounds: gpu.buffer("tile bounds", 2 * splats.tiles(TILE))?,
        };
        let turn = gpu.max_words() / 2;
        for first in (0..pairs as usize).step_by(turn) {
            drawing.pass(work, goal, first, turn.min(pairs as usize - first))?;
        }
        Ok(())
    }
}

/// Splats of a view, nearest first, with the number of pairs of splat and tile before each.
struct Drawing<'a> {
    gpu: &'a Gpu,
    view: View,
    light: &'a Buffer,
    records: Buffer,
    order: Buffer,
    before: Buffer,
    /// Where each tile's pairs lie.
    bounds: Buffer,
}

impl Drawing<'_> {
    /// Draw `pairs` pairs from the `first` on.
    fn pass(&self, work: &mut Work<'_>, goal: Goal<'_>, first: usize, pairs: usize) -> Result<()> {
        let Self { gpu, records, .. } = self;
        let view = View {
            first: first as u32,
            pairs: pairs as u32,
            ..self.view
        };
        let keyed = Keyed::new(gpu, pairs)?;
        let drawn = gpu.buffer("pairs", pairs)?;
        let (keys, words) = (&keyed.keys, &keyed.words);
        let bound = [records, &self.order, &self.before, keys, words, &drawn];
        let groups = pairs.div_ceil(THREADS);
        work.run(&EXPAND, groups, view.words(), &bound)?;
        let tiles = view.tiles(TILE);
        let bits = (usize::BITS - tiles.leading_zeros()) as usize;
        let keyed = sort(gpu, work, keyed, pairs, 0..bits)?;
        work.clear(&self.bounds);
        let bound = [(4, &keyed.keys), (7, &self.bounds)];
        work.run_at(&RANGES, groups, view.words(), &bound)?;
        let draw = |work: &mut Work<'_>, kernel: &Kernel, found: &Buffer, rounds: usize| {
            let numbers = &keyed.words;
            let bound = [records, numbers, &drawn, &self.bounds, self.light, found];
            let rounds = rounds.min(pairs);
            (0..pairs).step_by(rounds).try_for_each(|first| {
                let view = View {
                    first: first as u32,
                    pairs: rounds as u32,
                    ..view
                };
                work.run(kernel, tiles, view.words(), &bound)
            })
        };
        match goal {
            Goal::Depths(depths) => draw(work, &DEPTHS, depths, gpu.max_rounds()),
            Goal::Weights(weights) => {
                let shares = gpu.buffer("shares", pairs)?;
                draw(work, &WEIGH, &shares, gpu.max_rounds() / WEIGH_ROUNDS)?;
                let bound = [
                    (1, records),
                    (2, &self.order),
                    (3, &self.before),
                    (8, &shares),
                    (9, weights),
                ];
                let groups = (view.count as usize).div_ceil(THREADS);
                work.run_at(&COLLECT, groups, view.words(), &bound)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use bytemuck::Zeroable;

    use super::*;
    use crate::testing::gpu;

    #[test]
    fn pairs_beyond_a_splats_tiles_go_to_none() {
        let Some(gpu) = gpu() else { return };
        // One splat on two of four tiles, then one that ends up on none; `mark` counted five tiles.
        let splat = |[columns, rows]: [u32; 2]| [0, 0, 0, 0, 0, 0, 0, columns, rows, 0];
        let splats = [[20 << 16, 10 << 16], [0, 0]].map(splat);
        let view = View {
            size: [32, 32],
            count: 2,
            all_pairs: 5,
            ..View::zeroed()
        };
        let mut work = Work::new(&gpu);
        let records = gpu.upload("splats", &splats).unwrap();
        let order = gpu.upload("order", &[0u32, 1]).unwrap();
        let before = gpu.buffer("tiles before", 2).unwrap();
        let buffers = [&records, &order, &before];
        work.run(&COUNT, 1, view.words(), &buffers).unwrap();
        scan::exclusive(&gpu, &mut work, &before, 2).unwrap();
        let light = gpu.buffer("light", view.pixels()).unwrap();
        let depths = gpu.buffer("depth", view.pixels()).unwrap();
        let drawing = Drawing {
            gpu: &gpu,
            view,
            light: &light,
            records,
            order,
            before,
            bounds: gpu.buffer("tile bounds", 2 * view.tiles(TILE)).unwrap(),
        };
        let goal = Goal::Depths(&depths);
        drawing.pass(&mut work, goal, 0, 5).unwrap();
        let reads = [(&drawing.before, 2), (&drawing.bounds, 8)];
        let found = work.submit(&reads).unwrap().take().unwrap();
        assert_eq!(found, [vec![0, 2], vec![0, 1, 1, 2, 0, 0, 0, 0]]);
    }
}
