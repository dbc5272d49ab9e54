//! The passes that work tile by tile.

use rayon::prelude::*;

use super::{Image, ImageGradients, Rasterizer};
use crate::raster::BATCH;
use crate::raster::ROWS;
use crate::raster::backward::{self, Backward, Incoming};
use crate::raster::disjoint::DisjointSlice;
use crate::raster::forward::{Forward, Pixels};
use crate::raster::memory;
use crate::raster::region::Everywhere;
use crate::raster::simd::{LANES, Lanes16, dispatch};
use crate::raster::tile_batch::{TileBatch, for_stretches};

/// Tiles that a thread takes at a time: few, so that all threads finish together.
pub(super) const MOST_TILES: usize = 8;

#[derive(Default)]
struct Scratch {
    tile_batch: TileBatch,
    pixels: Pixels,
    light: [Lanes16; ROWS],
    incoming: Incoming,
}

impl Rasterizer {
    /// Blends every tile into the image.
    pub(crate) fn forward_tiles<const DEPTH: bool>(&mut self, image: &mut Image) {
        let Some(state) = &self.state else { return };
        let (camera, background) = (state.camera, state.background);
        let grid = state.grid;
        let tiles = self.batches.len();
        self.transmittance.resize(tiles, [Lanes16::default(); ROWS]);
        self.last.resize(tiles, [Lanes16::default(); ROWS]);
        let block_masks = DisjointSlice::new(&mut self.block_masks);
        let rgb = DisjointSlice::new(image.rgb);
        let alpha = DisjointSlice::new(image.alpha);
        let depth = image.depth.as_deref_mut().map(DisjointSlice::new);
        let median = image.median.as_deref_mut().map(DisjointSlice::new);
        let (bins, splats, isa) = (&self.bins, &self.splats, self.isa);
        let tile_states = self
            .batches
            .par_iter_mut()
            .zip(&mut self.transmittance)
            .zip(&mut self.last);
        tile_states
            .enumerate()
            .with_max_len(MOST_TILES)
            .for_each_init(
                Scratch::default,
                |scratch, (tile, ((batch, transmittance), last))| {
                    let pairs = bins.pairs_of(tile);
                    let rect = grid.rect(tile, &camera);
                    if pairs.is_empty() {
                        batch.1 = 0;
                        for y in 0..rect.rows {
                            let first = (rect.y + y) * camera.width + rect.x;
                            // SAFETY: as below.
                            unsafe {
                                let rgb = rgb.slice(3 * first, 3 * rect.columns);
                                rgb.as_chunks_mut().0.fill(background);
                                alpha.slice(first, rect.columns).fill(0.0);
                                for plane in [depth, median].into_iter().flatten() {
                                    plane.slice(first, rect.columns).fill(0.0);
                                }
                            }
                        }
                        return;
                    }
                    // SAFETY: every tile has its own batches, and the pixels written below are its own.
                    let block_masks =
                        unsafe { block_masks.slice(batch.0, pairs.len().div_ceil(BATCH)) };
                    scratch.pixels = Pixels::default();
                    scratch.light = rect.light();
                    *transmittance = [Lanes16([1.0; LANES]); ROWS];
                    *last = [Lanes16([-1.0; LANES]); ROWS];
                    let forward = Forward::<_, DEPTH> {
                        pairs,
                        splats,
                        rect,
                        settings: &state.settings,
                        block_masks,
                        light: &mut scratch.light,
                        transmittance,
                        last,
                        pixels: &mut scratch.pixels,
                        tile_batch: &mut scratch.tile_batch,
                        within: Everywhere,
                    };
                    batch.1 = dispatch(isa, forward);
                    let pixels = &scratch.pixels;
                    for y in 0..rect.rows {
                        let first = (rect.y + y) * camera.width + rect.x;
                        // SAFETY: as above.
                        let (rgb, alpha) = unsafe {
                            (
                                rgb.slice(3 * first, 3 * rect.columns),
                                alpha.slice(first, rect.columns),
                            )
                        };
                        for_stretches(y, rect.columns, |x, block, lane, count| {
                            let light: &[f32; 4] = transmittance[block].0[lane..]
                                .first_chunk()
                                .unwrap_or(&[0.0; 4]);
                            for i in 0..count {
                                alpha[x + i] = 1.0 - light[i];
                            }
                            let mut values = [0.0; 12];
                            for c in 0..3 {
                                let channel = &pixels.rgb[c][block].0[lane..lane + 4];
                                for i in 0..4 {
                                    values[3 * i + c] = channel[i] + light[i] * background[c];
                                }
                            }
                            let place = &mut rgb[3 * x..];
                            match place.first_chunk_mut() {
                                Some(four) if count == 4 => *four = values, // no call of memcpy
                                _ => place[..3 * count].copy_from_slice(&values[..3 * count]),
                            }
                        });
                        for (plane, rows) in [(depth, &pixels.depth), (median, &pixels.median)] {
                            let Some(plane) = plane else { continue };
                            // SAFETY: as above.
                            let row = unsafe { plane.slice(first, rect.columns) };
                            for (x, value) in row.iter_mut().enumerate() {
                                *value = rows[y / 4 * 4 + x / 4].0[y % 4 * 4 + x % 4];
                            }
                        }
                    }
                },
            );
    }

    /// Fills the slots with every pair's share of the gradient.
    pub(super) fn backward_tiles<const DEPTH: bool>(&mut self, image: &ImageGradients) {
        self.clear_slots();
        let Some(state) = &self.state else { return };
        let camera = &state.camera;
        let grid = state.grid;
        let slots = DisjointSlice::new(&mut self.slots);
        let written = DisjointSlice::new(&mut self.written);
        let (bins, splats, isa) = (&self.bins, &self.splats, self.isa);
        let states = self
            .batches
            .par_iter()
            .zip(&self.transmittance)
            .zip(&self.last);
        states.enumerate().with_max_len(MOST_TILES).for_each_init(
            Scratch::default,
            |scratch, (tile, ((batch, transmittance), last))| {
                let pairs = bins.pairs_of(tile);
                if pairs.is_empty() {
                    return;
                }
                let rect = grid.rect(tile, camera);
                let incoming = &mut scratch.incoming;
                incoming.load(backward::RGB, image.rgb, 3, camera.width, &rect);
                if let Some(alpha) = image.alpha {
                    incoming.load(backward::ALPHA, alpha, 1, camera.width, &rect);
                }
                if let Some(depth) = image.depth {
                    incoming.load(backward::DEPTH, depth, 1, camera.width, &rect);
                }
                let backward = Backward::<DEPTH> {
                    pairs,
                    splats,
                    rect,
                    settings: &state.settings,
                    background: state.background,
                    block_masks: &self.block_masks[batch.0..batch.0 + batch.1],
                    transmittance,
                    last,
                    incoming,
                    batch: &mut scratch.tile_batch.splats,
                    slots,
                    written,
                };
                dispatch(isa, backward);
            },
        );
    }

    /// Clear the marks of written slots; slots without a mark hold stale sums.
    pub(super) fn clear_slots(&mut self) {
        let pairs = self.bins.len();
        memory::first(&mut self.slots, pairs);
        memory::first(&mut self.written, pairs).fill(0);
    }
}
