//! Marked rows onto the image: sorted by depth, spread over tiles, drawn front to back.

use g2ard_core::select::Pinhole;

use super::marks::{Marks, PROJECTION};
use super::scene::Scene;
use super::view::Constants;
use super::{BLOCK, SPLAT, THREADS};
use crate::runtime::{Buffer, Kernel, Result, Work};
use crate::scan;
use crate::sort::{Keyed, sort};

const GATHER: Kernel = Kernel {
    name: "visibility.gather",
    sources: PROJECTION,
    entry: "gather",
};
const TILES: &[&str] = &[include_str!("pinhole.wgsl"), include_str!("tiles.wgsl")];
const COUNT: Kernel = Kernel {
    name: "visibility.count",
    sources: TILES,
    entry: "count",
};
const EXPAND: Kernel = Kernel {
    name: "visibility.expand",
    sources: TILES,
    entry: "expand",
};
const RANGES: Kernel = Kernel {
    name: "visibility.ranges",
    sources: TILES,
    entry: "ranges",
};
const DRAW: Kernel = Kernel {
    name: "visibility.draw",
    sources: &[include_str!("pinhole.wgsl"), include_str!("draw.wgsl")],
    entry: "draw",
};

/// Pixels along a side of a tile.
const TILE: usize = 16;

/// Depths are positive floats: their bits sort as they do.
const DEPTH_BITS: usize = 32;

impl<'a> Scene<'a> {
    /// Draws the marked rows onto what is left of the light. Pairs that do not fit at once are drawn in turns: the
    /// nearer before the farther.
    pub fn draw(
        &self,
        work: &mut Work<'a>,
        view: &Pinhole,
        marks: &Marks,
        [light, depth]: [&Buffer; 2],
    ) -> Result<()> {
        let splats = marks.splats;
        if splats == 0 {
            return Ok(());
        }
        let gpu = self.gpu;
        let records = gpu.buffer("splats", SPLAT * splats)?;
        let keyed = Keyed::new(gpu, splats)?;
        for (first, count, piece) in self.pieces() {
            let constants = Constants {
                first,
                ..Constants::new(view, count)
            };
            let bound = [
                (1, piece),
                (2, &marks.sums),
                (5, &records),
                (6, &keyed.keys),
                (7, &keyed.words),
            ];
            let groups = count.div_ceil(BLOCK);
            work.run_at(&GATHER, groups, &constants.words(), &bound)?;
        }
        let order = sort(gpu, work, keyed, splats, 0..DEPTH_BITS)?.words;
        let before = gpu.buffer("tiles before", splats)?;
        let constants = Constants::new(view, splats).words();
        let bound = [&records, &order, &before];
        work.run(&COUNT, splats.div_ceil(THREADS), &constants, &bound)?;
        scan::exclusive(gpu, work, &before, splats)?;
        let tiles = view.width.div_ceil(TILE) * view.height.div_ceil(TILE);
        let bounds = gpu.buffer("tile bounds", 2 * tiles)?;
        let bits = (usize::BITS - tiles.leading_zeros()) as usize;
        let (turn, pairs) = (gpu.max_words() / 2, marks.pairs as usize);
        for first in (0..pairs).step_by(turn) {
            let count = turn.min(pairs - first);
            let constants = Constants {
                first,
                range: 0..count as u32,
                ..Constants::new(view, splats)
            }
            .words();
            let keyed = Keyed::new(gpu, count)?;
            let bound = [&records, &order, &before, &keyed.keys, &keyed.words];
            let groups = count.div_ceil(THREADS);
            work.run(&EXPAND, groups, &constants, &bound)?;
            let keyed = sort(gpu, work, keyed, count, 0..bits)?;
            work.clear(&bounds);
            let bound = [(4, &keyed.keys), (6, &bounds)];
            work.run_at(&RANGES, groups, &constants, &bound)?;
            let bound = [&records, &keyed.words, &bounds, light, depth];
            let rounds = gpu.max_rounds().min(count);
            for first in (0..count).step_by(rounds) {
                let constants = Constants {
                    first,
                    ..Constants::new(view, rounds)
                };
                work.run(&DRAW, tiles, &constants.words(), &bound)?;
            }
        }
        Ok(())
    }
}
