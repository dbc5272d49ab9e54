//! Which tiles each splat meets, exactly, and the stable scatter of depth-ordered splats into them.

use rayon::prelude::*;

use super::TILE;
use super::order::{Key, Shared};
use super::project::Splat;
use super::simd::{Isa, Kernel, Lanes, dispatch};

/// How many stretches the depth order is cut into: fixed, so that the work splits alike for any number of threads.
const STRETCHES: usize = 16;

/// A splat in a tile, and the slot this pair's gradient goes to.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Pair {
    pub splat: u32,
    pub slot: u32,
}

/// Every tile's pairs, nearest first.
#[derive(Debug, Default)]
pub struct Bins {
    pub pairs: Vec<Pair>,
    /// Tile t owns `pairs[starts[t]..starts[t + 1]]`.
    pub starts: Vec<u32>,
    counts: Vec<u32>,
    /// Each chunk's tiles, splat after splat; then all of them together.
    lists: Vec<Vec<u32>>,
    slot_tiles: Vec<u32>,
    /// Each splat's first slot and number of slots.
    slots: Vec<(u32, u32)>,
}

/// Calls `visit(tile)` for each tile whose pixel centres' rectangle meets the splat's ellipse at α = 1/255,
/// row by row, left to right.
#[inline(always)]
pub fn for_each_tile(
    splat: &Splat,
    half: [f32; 2],
    tiles: (usize, usize),
    mut visit: impl FnMut(usize),
) {
    let (x, y) = (splat.x as f32, splat.y as f32);
    let (slack_x, slack_y) = (
        0.01 + 1e-4 * half[0].min(1e6),
        0.01 + 1e-4 * half[1].min(1e6),
    );
    let (mut rows, mut columns) = ((0, tiles.1), (0, tiles.0));
    if splat.radius.is_finite() {
        rows = square_span(y, splat.radius, tiles.1);
        columns = square_span(x, splat.radius, tiles.0);
    }
    let (half_x, half_y) = (half[0] + slack_x, half[1] + slack_y);
    let (first, last) = span(y - half_y, y + half_y, rows);
    let (from, to) = span(x - half_x, x + half_x, columns);
    if last <= first + 1 && to <= from + 1 {
        // Most splats: their box lies in one tile.
        for row in first..last {
            for column in from..to {
                visit(row * tiles.0 + column);
            }
        }
        return;
    }
    let r_a = 1.0 / splat.a;
    let (slope, level) = (-splat.b * r_a, splat.level());
    // dy at the rightmost point: Σ_xy / Σ_xx = −a·b/(b² + c²) times half the width.
    let dy_right = -half[0] * splat.a * splat.b / (splat.b * splat.b + splat.c * splat.c);
    for row in first..last {
        let top = ((row * TILE) as f32 + 0.5 - y).max(-half_y);
        let bottom = ((row * TILE + TILE) as f32 - 0.5 - y).min(half_y);
        let (top, bottom) = (top.min(bottom), top.max(bottom));
        // A chord's end is a concave function of dy: its extreme over the strip is at the ellipse's own, or nearest
        // to it.
        let mut ends = [0.0; 2];
        for (end, side) in ends.iter_mut().zip([-1.0, 1.0]) {
            let dy = (side * dy_right).max(top).min(bottom);
            let v = splat.c * dy;
            *end = slope * dy + side * ((level - v * v).max(0.0).sqrt() * r_a + slack_x);
        }
        let (from, to) = span(x + ends[0], x + ends[1], columns);
        for column in from..to {
            visit(row * tiles.0 + column);
        }
    }
}

/// Lists the tiles of each of a chunk's splats, one list after another; sets the splats' `tiles`, and `slot` within
/// the chunk.
struct List<'a> {
    splats: &'a mut [Splat],
    halves: &'a [[f32; 2]],
    tiles: (usize, usize),
    list: &'a mut Vec<u32>,
}

impl Kernel for List<'_> {
    type Output = ();

    #[inline(always)]
    fn run<F: Lanes>(self) {
        self.list.clear();
        for (splat, half) in self.splats.iter_mut().zip(self.halves) {
            let start = self.list.len();
            for_each_tile(splat, *half, self.tiles, |tile| self.list.push(tile as u32));
            splat.slot = start as u32;
            splat.tiles = (self.list.len() - start) as u32;
        }
    }
}

/// Tiles whose pixel centres' interval [16t + 0.5, 16t + 15.5] meets [low, high], within `bounds`.
#[inline(always)]
fn span(low: f32, high: f32, bounds: (usize, usize)) -> (usize, usize) {
    const PER_PIXEL: f32 = 1.0 / TILE as f32;
    let bound = (bounds.0 as f32, bounds.1 as f32);
    let from = ((low + 0.5) * PER_PIXEL - 1.0)
        .ceil()
        .max(bound.0)
        .min(bound.1);
    let to = ((high - 0.5) * PER_PIXEL + 1.0)
        .floor()
        .max(bound.0)
        .min(bound.1);
    // SAFETY: both lie between the bounds (a NaN became one of them); a checked cast costs several instructions.
    unsafe {
        (
            from.to_int_unchecked::<i32>() as usize,
            to.to_int_unchecked::<i32>() as usize,
        )
    }
}

/// The tiles INRIA's kernel gives a splat of this radius: those its square [centre ± radius] touches.
#[inline(always)]
fn square_span(centre: f32, radius: f32, tiles: usize) -> (usize, usize) {
    // Its pixel coordinates have centres at whole numbers.
    let (size, centre) = (TILE as f32, centre - 0.5);
    let from = ((centre - radius) / size).max(0.0) as usize;
    let to = ((centre + radius + size - 1.0) / size).max(0.0) as usize;
    (from.min(tiles), to.min(tiles))
}

impl Bins {
    /// Fills the bins from splats in depth order. Sets each splat's `tiles` and `slot`; slots are numbered in the
    /// order of `splats` (rows), so that a Gaussian's slots lie side by side.
    pub fn fill(
        &mut self,
        isa: Isa,
        order: &[Key],
        splats: &mut [Splat],
        halves: &[[f32; 2]],
        chunks: &[(usize, usize)],
        tiles: (usize, usize),
    ) {
        self.list_tiles(isa, splats, halves, chunks, tiles);
        let total_tiles = tiles.0 * tiles.1;
        let stretch = order.len().div_ceil(STRETCHES).max(1);
        self.counts.clear();
        self.counts.resize(STRETCHES * total_tiles, 0);
        let (slots, slot_tiles) = (&self.slots, &self.slot_tiles);
        let stretches = order
            .par_chunks(stretch)
            .zip(self.counts.par_chunks_mut(total_tiles));
        stretches.for_each(|(keys, counts)| {
            for key in keys {
                let (slot, count) = slots[key.splat as usize];
                for tile in &slot_tiles[slot as usize..(slot + count) as usize] {
                    counts[*tile as usize] += 1;
                }
            }
        });
        let pairs = self.prefix(total_tiles);
        self.pairs.resize(pairs, Pair::default());
        let out = Shared::new(&mut self.pairs);
        let (slots, slot_tiles) = (&self.slots, &self.slot_tiles);
        let stretches = order
            .par_chunks(stretch)
            .zip(self.counts.par_chunks_mut(total_tiles));
        stretches.for_each(|(keys, next)| {
            for key in keys {
                let (slot, count) = slots[key.splat as usize];
                for slot in slot..slot + count {
                    let place = &mut next[slot_tiles[slot as usize] as usize];
                    let pair = Pair {
                        splat: key.splat,
                        slot,
                    };
                    // SAFETY: the prefix sums give every stretch its own places in every tile.
                    unsafe { out.write(*place as usize, pair) };
                    *place += 1;
                }
            }
        });
    }

    /// Finds every splat's tiles and numbers the slots: `slot_tiles[slot]` is the tile of that slot's pair.
    fn list_tiles(
        &mut self,
        isa: Isa,
        splats: &mut [Splat],
        halves: &[[f32; 2]],
        chunks: &[(usize, usize)],
        tiles: (usize, usize),
    ) {
        self.lists.resize_with(chunks.len(), Vec::new);
        let shared = Shared::new(splats);
        self.lists
            .par_iter_mut()
            .zip(chunks)
            .for_each(|(list, &(first, count))| {
                // SAFETY: chunks do not overlap.
                let splats = unsafe { shared.slice(first, count) };
                dispatch(
                    isa,
                    List {
                        splats,
                        halves: &halves[first..first + count],
                        tiles,
                        list,
                    },
                );
            });
        let mut starts = Vec::with_capacity(chunks.len());
        let mut total = 0;
        for list in &self.lists {
            starts.push(total);
            total += list.len();
        }
        self.slot_tiles.resize(total, 0);
        self.slots.resize(splats.len(), (0, 0));
        let (all, slots) = (
            Shared::new(&mut self.slot_tiles),
            Shared::new(&mut self.slots),
        );
        let shared = Shared::new(splats);
        let lists = self.lists.par_iter().zip(&starts).zip(chunks);
        lists.for_each(|((list, start), &(first, count))| {
            // SAFETY: chunks, their lists and their stretches of slots do not overlap.
            unsafe {
                all.slice(*start, list.len()).copy_from_slice(list);
                for i in first..first + count {
                    let splat = &mut shared.slice(i, 1)[0];
                    splat.slot += *start as u32;
                    slots.write(i, (splat.slot, splat.tiles));
                }
            }
        });
    }

    /// Turns the counts into each stretch's first place in each tile; returns how many pairs there are.
    fn prefix(&mut self, tiles: usize) -> usize {
        self.starts.clear();
        let mut at = 0u32;
        for tile in 0..tiles {
            self.starts.push(at);
            for stretch in 0..STRETCHES {
                let count = &mut self.counts[stretch * tiles + tile];
                let first = at;
                at += *count;
                *count = first;
            }
        }
        self.starts.push(at);
        at as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The exact tiles, by testing a fine grid of points between the first and last pixel centres of each tile.
    fn brute(splat: &Splat, tiles: (usize, usize)) -> Vec<usize> {
        let level = f64::from(splat.level());
        let (a, b, c) = (f64::from(splat.a), f64::from(splat.b), f64::from(splat.c));
        let hit = |tile: usize| {
            let (left, top) = (
                (tile % tiles.0 * TILE) as f64 + 0.5,
                (tile / tiles.0 * TILE) as f64 + 0.5,
            );
            (0..=150).any(|i| {
                (0..=150).any(|j| {
                    let (dx, dy) = (
                        left + 0.1 * f64::from(i) - splat.x,
                        top + 0.1 * f64::from(j) - splat.y,
                    );
                    (a * dx + b * dy).powi(2) + (c * dy).powi(2) <= level
                })
            })
        };
        (0..tiles.0 * tiles.1).filter(|&t| hit(t)).collect()
    }

    #[test]
    fn tiles_are_exact() {
        let mut state = 7u64;
        let mut random = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 24) as f32
        };
        let tiles = (6, 5);
        let (mut met, mut extra) = (0, 0);
        for _ in 0..200 {
            let a = 0.02 * 60f32.powf(random());
            let splat = Splat {
                x: f64::from(random() * 140.0 - 20.0),
                y: f64::from(random() * 120.0 - 20.0),
                a,
                b: a * (random() - 0.5) * 6.0,
                c: 0.02 * 60f32.powf(random()),
                log2_opacity: -random() * 6.0,
                radius: f32::INFINITY,
                ..Splat::default()
            };
            let mut got = Vec::new();
            for_each_tile(&splat, splat.half_extents(), tiles, |t| got.push(t));
            let expected = brute(&splat, tiles);
            assert!(
                expected.iter().all(|t| got.contains(t)),
                "{splat:?}: {got:?} misses some of {expected:?}"
            );
            met += expected.len();
            extra += got.len() - expected.len();
        }
        assert!(met > 500, "only {met} tiles: the test draws too little");
        assert!(extra * 50 < met, "{extra} tiles too many of {met}");
    }
}
