//! Which tiles each splat meets, exactly, and the stable scatter of depth-ordered splats into them.

use rayon::prelude::*;

use super::TILE;
use super::order::{Key, Shared};
use super::project::Splat;

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
}

/// Calls `visit(tile)` for each tile whose pixel centres' rectangle meets the splat's ellipse at α = 1/255,
/// row by row, left to right.
#[inline]
pub fn for_each_tile(splat: &Splat, tiles: (usize, usize), mut visit: impl FnMut(usize)) {
    let reach = splat.reach();
    let (x, y) = (splat.x as f32, splat.y as f32);
    let slack_x = 0.01 + 1e-4 * reach.half_x.min(1e6);
    let slack_y = 0.01 + 1e-4 * reach.half_y.min(1e6);
    let (mut rows, mut columns) = ((0, tiles.1), (0, tiles.0));
    if splat.radius.is_finite() {
        rows = square_span(y, splat.radius, tiles.1);
        columns = square_span(x, splat.radius, tiles.0);
    }
    let half_y = reach.half_y + slack_y;
    let (first, last) = span(y - half_y, y + half_y, rows);
    let (slope, r_a) = (-splat.b / splat.a, 1.0 / splat.a);
    let reaches_to = |dy: f32, side: f32| {
        let v = splat.c * dy;
        slope * dy + side * (reach.level - v * v).max(0.0).sqrt() * r_a
    };
    for row in first..last {
        let top = ((row * TILE) as f32 + 0.5 - y).max(-reach.half_y);
        let bottom = ((row * TILE + TILE) as f32 - 0.5 - y).min(reach.half_y);
        // A chord's end is a concave function of dy: its extreme over the strip is at the ellipse's own, or nearest to it.
        let inside = |dy: f32| dy.max(top.min(bottom)).min(bottom.max(top));
        let right = reaches_to(inside(reach.dy_right), 1.0) + slack_x;
        let left = reaches_to(inside(-reach.dy_right), -1.0) - slack_x;
        let (from, to) = span(x + left, x + right, columns);
        for column in from..to {
            visit(row * tiles.0 + column);
        }
    }
}

/// Tiles whose pixel centres' interval [16t + 0.5, 16t + 15.5] meets [low, high], within `bounds`.
#[inline]
fn span(low: f32, high: f32, bounds: (usize, usize)) -> (usize, usize) {
    let size = TILE as f32;
    let from = ((low - (size - 0.5)) / size).ceil().max(bounds.0 as f32) as usize;
    let to = ((high - 0.5) / size).floor() + 1.0;
    (from, (to.max(0.0) as usize).min(bounds.1))
}

/// The tiles INRIA's kernel gives a splat of this radius: those its square [centre ± radius] touches.
#[inline]
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
        order: &[Key],
        splats: &mut [Splat],
        chunks: &[(usize, usize)],
        tiles: (usize, usize),
    ) {
        let total_tiles = tiles.0 * tiles.1;
        let stretch = order.len().div_ceil(STRETCHES).max(1);
        self.counts.clear();
        self.counts.resize(STRETCHES * total_tiles, 0);
        let shared = Shared::new(splats);
        order
            .par_chunks(stretch)
            .zip(self.counts.par_chunks_mut(total_tiles))
            .for_each(|(keys, counts)| {
                for key in keys {
                    // SAFETY: each splat is named by one key only.
                    let splat = &mut unsafe { shared.slice(key.splat as usize, 1) }[0];
                    let mut met = 0;
                    for_each_tile(splat, tiles, |tile| {
                        counts[tile] += 1;
                        met += 1;
                    });
                    splat.tiles = met;
                }
            });
        number_slots(splats, chunks);
        let pairs = self.prefix(total_tiles);
        self.pairs.resize(pairs, Pair::default());
        let out = Shared::new(&mut self.pairs);
        let splats = &*splats;
        order
            .par_chunks(stretch)
            .zip(self.counts.par_chunks_mut(total_tiles))
            .for_each(|(keys, next)| {
                for key in keys {
                    let splat = &splats[key.splat as usize];
                    let mut slot = splat.slot;
                    for_each_tile(splat, tiles, |tile| {
                        let pair = Pair {
                            splat: key.splat,
                            slot,
                        };
                        // SAFETY: the prefix sums give every stretch its own places in every tile.
                        unsafe { out.write(next[tile] as usize, pair) };
                        next[tile] += 1;
                        slot += 1;
                    });
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

fn number_slots(splats: &mut [Splat], chunks: &[(usize, usize)]) {
    let mut slot = 0;
    for &(first, count) in chunks {
        for splat in &mut splats[first..first + count] {
            splat.slot = slot;
            slot += splat.tiles;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The exact tiles, by testing a fine grid of points between the first and last pixel centres of each tile.
    fn brute(splat: &Splat, tiles: (usize, usize)) -> Vec<usize> {
        let level = f64::from(splat.reach().level);
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
            for_each_tile(&splat, tiles, |t| got.push(t));
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
