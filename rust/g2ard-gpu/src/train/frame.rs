//! Buffers of a view, and the kernels of an image or of a step, recorded once.

use super::constants::Step;
use super::scene::{Scene, Values};
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
const SHOW: Kernel = Kernel::new("train.show", DRAW, "show");
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
const STATE: usize = 6;

/// Room for a view.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Room {
    pixels: usize,
    tiles: usize,
    /// Pairs of splat and tile.
    pairs: usize,
}

impl Room {
    /// For an image, and any number of pairs.
    fn of(gpu: &Gpu, width: usize, height: usize) -> Result<Self> {
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
    fn with(self, other: Self) -> Self {
        Self {
            pixels: self.pixels.max(other.pixels),
            tiles: self.tiles.max(other.tiles),
            pairs: self.pairs.max(other.pairs),
        }
    }
}

/// What a step compares the image with.
pub struct Target {
    pub image: Buffer,
    /// A byte per pixel.
    pub mask: Buffer,
}

pub struct Frame {
    room: Room,
    state: Buffer,
    pub image: Buffer,
    /// None for images alone.
    pub target: Option<Target>,
    program: Program,
}

impl Frame {
    /// Record a step of `trained`, or an image of `values`.
    fn new(
        gpu: &Gpu,
        values: &Values,
        trained: Option<&Scene>,
        constants: &Constants,
        room: Room,
    ) -> Result<Self> {
        let Room {
            pixels,
            tiles,
            pairs,
        } = room;
        let rows = values.rows;
        let state = gpu.buffer("state", STATE)?;
        let mut work = Work::new(gpu);
        work.clear(&state);
        let run = |work: &mut Work, kernel, threads: usize, size, bound: &[(u32, &Buffer)]| {
            work.run_with(kernel, threads.div_ceil(size), constants, bound)
        };

        let splats = gpu.buffer("splats", SPLAT_WORDS * rows)?;
        let by_depth = Keyed::new(gpu, rows)?;
        let bound = [&values.buffer, &splats, &by_depth.keys, &by_depth.words];
        run(&mut work, &SPLAT, rows, THREADS, &numbered(bound))?;
        let order = sort(gpu, &mut work, by_depth, rows, 0..32)?.words;

        let before = gpu.buffer("tiles before", rows)?;
        let shared = [(1, &splats), (2, &order), (3, &before), (4, &state)];
        run(&mut work, &COUNT, rows, THREADS, &shared)?;
        scan::exclusive(gpu, &mut work, &before, rows)?;
        let by_tile = Keyed::new(gpu, pairs)?;
        let drawn = gpu.buffer("pairs", pairs)?;
        let summed = trained.map_or(1, |_| pairs);
        let sums = gpu.buffer("sums of pairs", SUMS * summed)?;
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
        let shared = [&splats, &drawn, &by_tile.words, &first];
        let Some(scene) = trained else {
            let bound = [&shared[..], &[&image]].concat();
            run(&mut work, &SHOW, tiles, 1, &numbered(bound))?;
            return Ok(Self {
                room,
                state,
                image,
                target: None,
                program: work.program(),
            });
        };
        let buckets = pairs / BUCKET + tiles;
        let behind = gpu.buffer("light of buckets", 4 * TILE * TILE * buckets)?;
        let last = gpu.buffer("last pairs", pixels)?;
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
            &values.buffer,
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
            state,
            image,
            target: Some(Target {
                image: target,
                mask,
            }),
            program: work.program(),
        })
    }
}

/// The last frame, whose constants are the view's.
pub struct View {
    constants: Constants,
    pub frame: Option<Frame>,
}

/// What a run leaves: Gaussians moved and skipped, and the loss.
pub struct Outcome {
    pub updated: u32,
    pub skipped: u32,
    pub loss: f32,
    /// For images alone, three values per pixel.
    pub image: Vec<f32>,
}

impl View {
    pub fn new(gpu: &Gpu) -> Self {
        Self {
            constants: gpu.constants(&vec![0; size_of::<Step>() / 4]),
            frame: None,
        }
    }

    /// Take a step of `trained`, or draw an image of `values`; again with more room until the pairs fit. `fill` writes the
    /// target.
    pub fn run(
        &mut self,
        gpu: &Gpu,
        values: &Values,
        trained: Option<&Scene>,
        mut task: Step,
        fill: impl Fn(&mut Work, &Target),
    ) -> Result<Outcome> {
        let [width, height] = task.size.map(|side| side as usize);
        let mut room = Room::of(gpu, width, height)?;
        room.pairs = (2 * values.rows).max(1 << 14);
        // A thread draws a tile's pairs one after the other, and does little else.
        let most_in_tile = gpu.max_rounds() / 8 * 7;
        loop {
            let (frame, constants) = self.frame_for(gpu, values, trained, room)?;
            task.capacity = frame.room.pairs as u32;
            task.most_in_tile = u32::try_from(most_in_tile).unwrap_or(u32::MAX);
            gpu.set_constants(constants, task.words());
            let mut work = Work::new(gpu);
            if let Some(target) = &frame.target {
                fill(&mut work, target);
            }
            work.append(&frame.program);
            let image = (&frame.image, 3 * width * height);
            let reads = [(&frame.state, STATE), image];
            let wanted = trained.map_or(2, |_| 1);
            let found = work.submit(&reads[..wanted])?.take()?;
            let mut found = found.into_iter();
            let state = found.next().unwrap_or_default();
            let [pairs, failed, updated, skipped, loss, _] = state[..] else {
                return Err(Error::Lost("it left no state".to_owned()));
            };
            let too_many = |what, count: usize, limit: usize| Error::TooMany {
                what,
                count: count as u64,
                limit: limit as u64,
            };
            match failed {
                0 => {
                    return Ok(Outcome {
                        updated,
                        skipped,
                        loss: f32::from_bits(loss),
                        image: bytemuck::cast_vec(found.next().unwrap_or_default()),
                    });
                }
                1 if pairs as usize > frame.room.pairs => {
                    room.pairs = pairs as usize / 4 * 5 + 1024;
                }
                1 => {
                    let what = "pairs of splat and tile of a view";
                    return Err(too_many(what, 1 << 32, (1 << 32) - 1));
                }
                _ => {
                    let what = "splats in a tile of a view";
                    return Err(too_many(what, most_in_tile + 1, most_in_tile));
                }
            }
        }
    }

    /// The frame, with at least this room, and its constants.
    fn frame_for(
        &mut self,
        gpu: &Gpu,
        values: &Values,
        trained: Option<&Scene>,
        room: Room,
    ) -> Result<(&Frame, &Constants)> {
        let held = &mut self.frame;
        let had = held.as_ref().map_or(Room::default(), |frame| frame.room);
        let room = room.with(had);
        let frame = match held.take() {
            Some(frame) if frame.room == room => frame,
            outgrown => {
                drop(outgrown); // before its successor takes as much memory
                Frame::new(gpu, values, trained, &self.constants, room)?
            }
        };
        Ok((held.insert(frame), &self.constants))
    }
}

/// Bindings from 1 on.
fn numbered<'a>(buffers: impl IntoIterator<Item = &'a Buffer>) -> Vec<(u32, &'a Buffer)> {
    (1..).zip(buffers).collect()
}
