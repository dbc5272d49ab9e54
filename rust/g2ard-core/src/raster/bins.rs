//! The stable scatter of depth-ordered splats into the tiles they meet.

use std::ops::Range;

use rayon::prelude::*;

use super::depth_sort::{Key, prefix_sums};
use super::disjoint::DisjointSlice;
use super::grid::TileGrid;
use super::memory::{first, prefetch};
use super::tile_lists::{TileIntersector, TileList};
use crate::Result;

/// Number of stretches of the depth order: fixed, so that work is split equally for any number of threads.
const STRETCHES: usize = 32;
/// Number of keys that a stretch prefetches ahead, because their splats are scattered in memory.
const AHEAD: usize = 16;
/// Number of pairs that a u32 counts.
const MOST_PAIRS: u64 = u32::MAX as u64;

/// A splat in a tile, and the slot this pair's gradient goes to.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Pair {
    pub splat: u32,
    pub slot: u32,
}

/// Every tile's pairs, nearest first.
#[derive(Debug, Default)]
pub struct Bins {
    pairs: Vec<Pair>,
    /// Tile t owns `pairs[starts[t]..starts[t + 1]]`.
    pub starts: Vec<u32>,
    /// First slot of each chunk of splats, and the number of slots.
    slots: Vec<u32>,
    counts: Vec<u32>,
}

impl Bins {
    /// A tile's pairs, nearest first.
    pub fn pairs_of(&self, tile: usize) -> &[Pair] {
        &self.pairs[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }

    /// Number of pairs.
    pub fn len(&self) -> usize {
        self.starts.last().map_or(0, |&end| end as usize)
    }

    /// The slots of a chunk's splats.
    pub fn slots_of(&self, chunk: usize) -> Range<usize> {
        self.slots[chunk] as usize..self.slots[chunk + 1] as usize
    }

    /// Fills the bins from splats in depth order. Slots are numbered in the order of the splats (rows), so that a
    /// Gaussian's slots lie side by side, and its neighbours' near them.
    pub fn fill(
        &mut self,
        order: &[Key],
        tile_lists: &[TileList],
        intersectors: &[TileIntersector],
        chunk: usize,
        grid: TileGrid,
    ) -> Result<()> {
        self.slots.clear();
        let mut total = 0;
        for intersector in intersectors {
            self.slots.push(total as u32);
            total += intersector.slots;
        }
        self.slots.push(total as u32);
        refuse!(total > MOST_PAIRS => "view", format!("at most {MOST_PAIRS} pairs of a Gaussian and a tile of 16×16 pixels"), total);
        let (total_tiles, narrow) = (grid.tiles(), grid.narrow());
        let stretch = order.len().div_ceil(STRETCHES).max(1);
        self.counts.clear();
        self.counts.resize(STRETCHES * total_tiles, 0);
        let stretches = order
            .par_chunks(stretch)
            .zip(self.counts.par_chunks_mut(total_tiles))
            .with_max_len(1);
        stretches.for_each(|(keys, counts)| {
            for (i, key) in keys.iter().enumerate() {
                if let Some(ahead) = keys.get(i + AHEAD) {
                    prefetch(&tile_lists[ahead.splat as usize]);
                }
                let splat = key.splat as usize;
                let list = &intersectors[splat / chunk].list;
                tile_lists[splat].for_each(list, 0, narrow, |tile, _| counts[tile] += 1);
            }
        });
        self.starts.clear();
        self.starts.resize(total_tiles + 1, 0);
        prefix_sums(&mut self.counts, &mut self.starts[1..]);
        let count = self.len();
        let pairs = first(&mut self.pairs, count);
        let (out, slots) = (DisjointSlice::new(pairs), &self.slots);
        let stretches = order
            .par_chunks(stretch)
            .zip(self.counts.par_chunks_mut(total_tiles))
            .with_max_len(1);
        stretches.for_each(|(keys, next)| {
            for (i, key) in keys.iter().enumerate() {
                if let Some(ahead) = keys.get(i + AHEAD) {
                    prefetch(&tile_lists[ahead.splat as usize]);
                }
                let splat = key.splat as usize;
                let list = &intersectors[splat / chunk].list;
                let first_slot = slots[splat / chunk];
                tile_lists[splat].for_each(list, first_slot, narrow, |tile, slot| {
                    let splat = key.splat;
                    // SAFETY: the prefix sums give every stretch its own places in every tile, and do not overflow: there
                    // are as many pairs as slots.
                    unsafe { out.write(next[tile] as usize, Pair { splat, slot }) };
                    next[tile] += 1;
                });
            }
        });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_pairs_than_a_u32_counts_are_an_error() {
        let grid = TileGrid {
            columns: 3,
            first_row: 0,
            rows: 2,
        };
        let most = u64::from(u32::MAX);
        for (chunks, fits) in [
            (vec![most], true),
            (vec![most - 1, 0, 1], true),
            (vec![most + 1], false),
            (vec![most, 0, 1], false),
            (vec![1 << 31; 2], false),
            (vec![1 << 32], false),
            (vec![most; 9], false),
        ] {
            let mut intersectors = Vec::new();
            intersectors.resize_with(chunks.len(), TileIntersector::default);
            for (intersector, &slots) in intersectors.iter_mut().zip(&chunks) {
                intersector.slots = slots;
            }
            let filled = Bins::default().fill(&[], &[], &intersectors, 1, grid);
            assert_eq!(filled.is_ok(), fits, "{chunks:?}: {filled:?}");
        }
    }
}
