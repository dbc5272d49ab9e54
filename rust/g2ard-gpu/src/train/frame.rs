//! Buffers of a view, and the kernels of a step, recorded once.

use super::scene::Scene;
use crate::runtime::{Buffer, Constants, Error, Gpu, Kernel, Program, Result, Work};
use crate::scan;
use crate::sort::{Keyed, sort};
use crate::two::TWO;

const STEP: &str = include_str!("step.wgsl");
const TILES: &str = include_str!("tiles.wgsl");
const PROJECT: &str = include_str!("project.wgsl");
const SPLATS: &[&str] = &[TWO, STEP, TILES, PROJECT, include_str!("splats.wgsl")];
const PAIRS: &[&str] = &[STEP, TILES, include_str!("pairs.wgsl")];
const DRAW: &[&str] = &[TWO, STEP, include_str!("draw.wgsl")];
const LOSS: &[&str] = &[STEP, include_str!("loss.wgsl")];
const UPDATE: &[&str] = &[TWO, STEP, PROJECT, include_str!("update.wgsl")];

const SPLAT: Kernel = Kernel::new("train.splat", SPLATS, "splat");
const COUNT: Kernel = Kernel::new("train.count", PAIRS, "count");
const EXPAND: Kernel = Kernel::new("train.expand", PAIRS, "expand");
const STARTS: Kernel = Kernel::new("train.starts", PAIRS, "starts");
const FORWARD: Kernel = Kernel::new("train.draw", DRAW, "draw");
const BACKWARD: Kernel = Kernel::new("train.backward", DRAW, "backward");
const WEIGH: Kernel = Kernel::new("train.weigh", LOSS, "weigh");
const COMPARE: Kernel = Kernel::new("train.compare", LOSS, "compare");
const TOTAL: Kernel = Kernel::new("train.total", LOSS, "total");
const GRADIENT: Kernel = Kernel::new("train.gradient", LOSS, "gradient");
const ADAM: Kernel = Kernel::new("train.update", UPDATE, "update");

const THREADS: usize = 64;
/// Pixels along a side of a tile, and pairs of a tile that the backward pass takes together.
const TILE: usize = 16;
const BUCKET: usize = 32;
/// Words of a splat, and of a pair's sums.
const SPLAT_WORDS: usize = 13;
const SUMS: usize = 9;
/// Words of the state: pairs, failure, Gaussians moved and skipped, loss, its factor.
pub const STATE: usize = 6;

/// Room for a view.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Room {
    pub pixels: usize,
    pub tiles: usize,
    /// Pairs of splat and tile.
    pub pairs: usize,
}

impl Room {
    /// For an image, and any number of pairs.
    pub fn of(gpu: &Gpu, width: usize, height: usize) -> Result<Self> {
        let tiles = width.div_ceil(TILE) * height.div_ceil(TILE);
        // A splat may meet all of them, one after the other.
        let limit = gpu.max_rounds() as u64;
        if tiles as u64 > limit {
            return Err(Error::TooMany {
                what: "tiles of a view",
                count: tiles as u64,
                limit,
            });
        }
        let (pixels, pairs) = (width * height, 0);
        Ok(Self {
            pixels,
            tiles,
            pairs,
        })
    }

    /// Room for both.
    pub fn with(self, other: Self) -> Self {
        Self {
            pixels: self.pixels.max(other.pixels),
            tiles: self.tiles.max(other.tiles),
            pairs: self.pairs.max(other.pairs),
        }
    }
}

pub struct Frame {
    pub room: Room,
    pub target: Buffer,
    /// A byte per pixel.
    pub mask: Buffer,
    pub state: Buffer,
    #[cfg(test)]
    pub image: Buffer,
    pub step: Program,
}

impl Frame {
    pub fn new(gpu: &Gpu, scene: &Scene, constants: &Constants, room: Room) -> Result<Self> {
        let Room {
            pixels,
            tiles,
            pairs,
        } = room;
        let rows = scene.rows;
        let state = gpu.buffer("state", STATE)?;
        let mut work = Work::new(gpu);
        work.clear(&state);
        let run = |work: &mut Work, kernel, threads: usize, size, bound: &[(u32, &Buffer)]| {
            work.run_with(kernel, threads.div_ceil(size), constants, bound)
        };

        let splats = gpu.buffer("splats", SPLAT_WORDS * rows)?;
        let by_depth = Keyed::new(gpu, rows)?;
        let bound = [&scene.values, &splats, &by_depth.keys, &by_depth.words];
        run(&mut work, &SPLAT, rows, THREADS, &numbered(bound))?;
        let order = sort(gpu, &mut work, by_depth, rows, 0..32)?.words;

        let before = gpu.buffer("tiles before", rows)?;
        let shared = [(1, &splats), (2, &order), (3, &before), (4, &state)];
        run(&mut work, &COUNT, rows, THREADS, &shared)?;
        scan::exclusive(gpu, &mut work, &before, rows)?;
        let by_tile = Keyed::new(gpu, pairs)?;
        let drawn = gpu.buffer("pairs", pairs)?;
        let sums = gpu.buffer("sums of pairs", SUMS * pairs)?;
        let own = [
            (5, &by_tile.keys),
            (6, &by_tile.words),
            (7, &drawn),
            (9, &sums),
        ];
        let bound = [&shared[..], &own].concat();
        run(&mut work, &EXPAND, pairs, THREADS, &bound)?;
        let bits = (usize::BITS - tiles.leading_zeros()) as usize;
        let by_tile = sort(gpu, &mut work, by_tile, pairs, 0..bits)?;
        let first = gpu.buffer("tile starts", tiles + 1)?;
        let bound = [&shared[..], &[(5, &by_tile.keys), (8, &first)]].concat();
        run(&mut work, &STARTS, rows.max(tiles + 1), THREADS, &bound)?;

        let image = gpu.buffer("image", 3 * pixels)?;
        let buckets = pairs / BUCKET + tiles;
        let behind = gpu.buffer("light of buckets", 4 * TILE * TILE * buckets)?;
        let last = gpu.buffer("last pairs", pixels)?;
        let shared = [&splats, &drawn, &by_tile.words, &first];
        let bound = [&shared[..], &[&image, &behind, &last]].concat();
        run(&mut work, &FORWARD, tiles, 1, &numbered(bound))?;

        let target = gpu.buffer("target", 3 * pixels)?;
        let mask = gpu.buffer("mask", pixels.div_ceil(4))?;
        let factors = gpu.buffer("factors", pixels)?;
        let slopes = gpu.buffer("slopes", 9 * pixels)?;
        let parts = gpu.buffer("losses", 6 * tiles)?;
        let pull = gpu.buffer("gradient", 3 * pixels)?;
        let bound = [(3, &mask), (4, &factors)];
        run(&mut work, &WEIGH, pixels, THREADS, &bound)?;
        let bound = [&image, &target, &mask, &factors, &slopes, &parts];
        run(&mut work, &COMPARE, 3 * tiles, 1, &numbered(bound))?;
        run(&mut work, &TOTAL, 1, 1, &[(6, &parts), (7, &state)])?;
        let given = [&image, &target, &mask, &factors, &slopes];
        let bound = [&numbered(given)[..], &[(7, &state), (8, &pull)]].concat();
        run(&mut work, &GRADIENT, 3 * tiles, 1, &bound)?;

        let bound = [&shared[..], &[&pull, &behind, &last, &sums]].concat();
        run(&mut work, &BACKWARD, buckets, 1, &numbered(bound))?;
        let bound = [
            &scene.values,
            &scene.moments,
            &scene.states,
            &splats,
            &sums,
            &scene.anchors,
            &scene.biases,
            &state,
        ];
        run(&mut work, &ADAM, rows, THREADS, &numbered(bound))?;
        Ok(Self {
            room,
            target,
            mask,
            state,
            #[cfg(test)]
            image,
            step: work.program(),
        })
    }
}

/// Bindings from 1 on.
fn numbered<'a>(buffers: impl IntoIterator<Item = &'a Buffer>) -> Vec<(u32, &'a Buffer)> {
    (1..).zip(buffers).collect()
}
