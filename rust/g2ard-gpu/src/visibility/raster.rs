//! The raster: rows that a view may show, sorted by depth, distributed over tiles and drawn front to back.

use super::scene::Scene;
use super::view::{Constants, View};
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

/// Marked rows of a view, which it may show.
pub struct Marked<'a> {
    sums: Buffer,
    pending: Pending<'a>,
}

impl Marked<'_> {
    /// Start to mark the rows of a scene.
    pub fn begin<'a>(
        gpu: &'a Gpu,
        mut work: Work<'a>,
        scene: &Scene,
        view: &View,
    ) -> Result<Marked<'a>> {
        let blocks = scene.count.div_ceil(BLOCK);
        let marks = gpu.buffer("marks", scene.count + 1)?;
        let tiles = gpu.buffer("tiles", blocks)?;
        let constants = Constants::of(scene.count).words(view);
        work.run(&MARK, blocks, &constants, &[&scene.rows, &marks, &tiles])?;
        let total = scan::exclusive(gpu, &mut work, &marks, scene.count + 1)?;
        let pending = work.submit(&[(&total, 1), (&tiles, blocks)])?;
        Ok(Marked {
            sums: marks,
            pending,
        })
    }

    /// Draw the marked rows onto the remaining light. Pairs that do not fit at once are drawn in several passes, nearer
    /// ones first.
    pub fn draw(
        self,
        gpu: &Gpu,
        work: &mut Work<'_>,
        scene: &Scene,
        view: &View,
        light: &Buffer,
        goal: Goal<'_>,
    ) -> Result<()> {
        let found = self.pending.take()?;
        let splats = found[0][0] as usize;
        if splats == 0 {
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
        let records = gpu.buffer("splats", SPLAT * splats)?;
        let keyed = Keyed::new(gpu, splats)?;
        let constants = Constants::of(scene.count).words(view);
        let bound = [
            (1, &scene.rows),
            (2, &self.sums),
            (4, &records),
            (5, &keyed.keys),
            (6, &keyed.words),
        ];
        work.run_at(&GATHER, scene.count.div_ceil(BLOCK), &constants, &bound)?;
        let order = sort(gpu, work, keyed, splats, 0..DEPTH_BITS)?.words;
        let before = gpu.buffer("tiles before", splats)?;
        let constants = Constants::of(splats).words(view);
        let per_splat = splats.div_ceil(THREADS);
        work.run(&COUNT, per_splat, &constants, &[&records, &order, &before])?;
        scan::exclusive(gpu, work, &before, splats)?;
        let tiles = view.tiles(TILE);
        let bounds = gpu.buffer("tile bounds", 2 * tiles)?;
        let bits = (usize::BITS - tiles.leading_zeros()) as usize;
        let (turn, all_pairs) = (gpu.max_words() / 2, pairs as usize);
        for first in (0..all_pairs).step_by(turn) {
            let pairs = turn.min(all_pairs - first);
            let constants = Constants {
                count: splats,
                first,
                pairs,
                all_pairs,
                ..Constants::default()
            }
            .words(view);
            let keyed = Keyed::new(gpu, pairs)?;
            let drawn = gpu.buffer("pairs", pairs)?;
            let bound = [&records, &order, &before, &keyed.keys, &keyed.words, &drawn];
            let per_pair = pairs.div_ceil(THREADS);
            work.run(&EXPAND, per_pair, &constants, &bound)?;
            let keyed = sort(gpu, work, keyed, pairs, 0..bits)?;
            work.clear(&bounds);
            let bound = [(4, &keyed.keys), (7, &bounds)];
            work.run_at(&RANGES, per_pair, &constants, &bound)?;
            let shares = match goal {
                Goal::Depths(_) => None,
                Goal::Weights(_) => Some(gpu.buffer("shares", pairs)?),
            };
            let (kernel, rounds, found) = match (goal, &shares) {
                (Goal::Depths(depths), _) => (&DEPTHS, gpu.max_rounds(), depths),
                (Goal::Weights(w), shares) => {
                    let rounds = gpu.max_rounds() / WEIGH_ROUNDS;
                    (&WEIGH, rounds, shares.as_ref().unwrap_or(w))
                }
            };
            let bound = [&records, &keyed.words, &drawn, &bounds, light, found];
            let rounds = rounds.min(pairs);
            for first in (0..pairs).step_by(rounds) {
                let constants = Constants {
                    first,
                    pairs: rounds,
                    ..Constants::default()
                };
                work.run(kernel, tiles, &constants.words(view), &bound)?;
            }
            if let (Goal::Weights(weights), Some(shares)) = (goal, &shares) {
                let bound = [
                    (1, &records),
                    (2, &order),
                    (3, &before),
                    (8, shares),
                    (9, weights),
                ];
                work.run_at(&COLLECT, per_splat, &constants, &bound)?;
            }
        }
        Ok(())
    }
}
