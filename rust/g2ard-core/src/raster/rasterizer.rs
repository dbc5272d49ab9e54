//! The passes in order, and the buffers of one view that they share and reuse from call to call.

mod accumulated;
mod boxed;
#[cfg(test)]
mod tests;
mod tiled;
mod views;

use std::ops::Range;

use rayon::prelude::*;

use super::BATCH;
use super::backward::SUMS;
use super::bins::Bins;
use super::blocks::BlockMasks;
use super::bounds;
use super::depth_sort::{self, Key};
use super::disjoint::DisjointSlice;
use super::frustum::Frustum;
use super::gradients::{Gather, Gradients};
use super::grid::TileGrid;
use super::memory;
use super::params::{Params, Source};
use super::project::{Project, Splat, View};
use super::simd::{Isa, LANES, Lanes16, dispatch};
use super::tile_lists::{TileIntersector, TileList};
use super::{Camera, ROWS, Settings};
use crate::{Error, Result};

pub use boxed::Canvas;
pub use views::{Image, ImageGradients};

/// Groups of sixteen rows projected as one piece of work; one under Miri, which runs few rows.
const CHUNK: usize = if cfg!(miri) { 1 } else { 64 };
/// Bounds of a chunk.
const PARTS: usize = CHUNK.div_ceil(bounds::GROUPS);

/// One chunk of rows after the backward pass: its visible splats and the location of their sums.
pub(crate) struct ChunkSums<'a> {
    pub view: &'a View,
    pub first_group: usize,
    pub last_group: usize,
    pub splats: &'a [Splat],
    pub slots: &'a [[f32; SUMS]],
    pub written: &'a [u8],
}

/// A chunk's number, and which of its parts the view may see.
type SeenChunk = (u32, [bool; PARTS]);

struct ForwardState {
    camera: Camera,
    settings: Settings,
    grid: TileGrid,
    view: View,
    background: [f32; 3],
    rows: usize,
}

/// Renders one view and keeps what its backward pass needs; the next view reuses every buffer.
#[derive(Default)]
pub struct Rasterizer {
    isa: Isa,
    state: Option<ForwardState>,
    splats: Vec<Splat>,
    tile_lists: Vec<TileList>,
    intersectors: Vec<TileIntersector>,
    /// The chunks of rows that the view may see, ascending, and which of their parts.
    seen: Vec<SeenChunk>,
    /// (first splat, number visible) of each of these chunks.
    chunks: Vec<(usize, usize)>,
    /// Visible splats by depth: the first [`Self::collect_keys`] of them.
    order: Vec<Key>,
    spare: Vec<Key>,
    bins: Bins,
    /// First batch of each tile, and how many the forward pass processed.
    batches: Vec<(usize, usize)>,
    block_masks: Vec<BlockMasks>,
    transmittance: Vec<[Lanes16; ROWS]>,
    last: Vec<[Lanes16; ROWS]>,
    slots: Vec<[f32; SUMS]>,
    /// The sums of visibility, one pair's after another's.
    shares: Vec<f32>,
    written: Vec<u8>,
}

impl Rasterizer {
    pub fn new(isa: Isa) -> Self {
        Self {
            isa,
            ..Self::default()
        }
    }

    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Renders a view.
    pub fn forward(
        &mut self,
        params: &Params,
        camera: &Camera,
        settings: &Settings,
        background: [f32; 3],
        image: &mut Image,
    ) -> Result<()> {
        params.validate()?;
        camera.validate()?;
        settings.validate()?;
        image.validate(camera)?;
        self.prepare(*params, camera, settings, background, TileGrid::of(camera))?;
        if image.depth.is_some() || image.median.is_some() {
            self.forward_tiles::<true>(image);
        } else {
            self.forward_tiles::<false>(image);
        }
        Ok(())
    }

    /// Gradients of the last forward pass; `params` must be the ones it rendered.
    pub fn backward(
        &mut self,
        params: &Params,
        image: &ImageGradients,
        out: &mut Gradients,
    ) -> Result<()> {
        params.validate()?;
        out.validate(params)?;
        self.check_rendered(params.len(), image)?;
        let out = out.row_major(params.sh_coeffs);
        if image.depth.is_some() {
            self.backward_tiles::<true>(image);
        } else {
            self.backward_tiles::<false>(image);
        }
        let Some(state) = &self.state else {
            return Ok(());
        };
        self.visible().for_each(|(splats, slots)| {
            let gather = Gather {
                view: &state.view,
                source: *params,
                out,
                splats,
                slots: &self.slots[slots.clone()],
                written: &self.written[slots],
            };
            dispatch(self.isa, gather);
        });
        Ok(())
    }

    /// Check that the last forward pass rendered as many rows, in an image of this size.
    fn check_rendered(&self, rows: usize, image: &ImageGradients) -> Result<()> {
        let Some(state) = &self.state else {
            return Err(Error::invalid(
                "backward",
                "a forward pass before it",
                "none",
            ));
        };
        Error::unless_equal("rows", rows, state.rows, "rows")?;
        image.validate(&state.camera)
    }

    /// Renders any source, image only.
    pub(crate) fn forward_from<S: Source>(
        &mut self,
        source: S,
        camera: &Camera,
        settings: &Settings,
        background: [f32; 3],
        image: &mut Image,
    ) -> Result<()> {
        self.prepare(source, camera, settings, background, TileGrid::of(camera))?;
        self.forward_tiles::<false>(image);
        Ok(())
    }

    /// Fill the slots, then call `finish(chunk, slots of the chunk's splats)` for every seen chunk of rows in parallel;
    /// return the results in order.
    pub(crate) fn backward_by_chunk<T: Send>(
        &mut self,
        image: &ImageGradients,
        finish: impl Fn(&ChunkSums) -> T + Sync,
    ) -> Vec<T> {
        self.backward_tiles::<false>(image);
        let Some(state) = &self.state else {
            return Vec::new();
        };
        let groups = state.rows.div_ceil(LANES);
        let finish = |(at, (splats, slots)): (usize, (&[Splat], Range<usize>))| {
            let chunk = self.seen[at].0 as usize;
            finish(&ChunkSums {
                view: &state.view,
                first_group: chunk * CHUNK,
                last_group: groups.min((chunk + 1) * CHUNK),
                splats,
                slots: &self.slots[slots.clone()],
                written: &self.written[slots],
            })
        };
        self.visible().enumerate().map(finish).collect()
    }

    /// The visible splats of every seen chunk of rows, and their slots.
    fn visible(&self) -> impl IndexedParallelIterator<Item = (&[Splat], Range<usize>)> {
        let chunks = self.chunks.par_iter().enumerate();
        chunks.with_max_len(1).map(|(chunk, &(first, count))| {
            let splats = &self.splats[first..first + count];
            (splats, self.bins.slots_of(chunk))
        })
    }

    /// Projects, sorts and bins. After an error no backward pass is possible.
    pub(crate) fn prepare<S: Source>(
        &mut self,
        source: S,
        camera: &Camera,
        settings: &Settings,
        background: [f32; 3],
        grid: TileGrid,
    ) -> Result<()> {
        let (view, rows) = (View::new(camera, settings), source.len());
        self.state = None;
        self.find_seen(&source, camera);
        self.project(&view, source, grid);
        let visible = self.collect_keys();
        depth_sort::sort(&mut self.order, &mut self.spare, visible);
        self.bins.fill(
            &self.order[..visible],
            &self.tile_lists,
            &self.intersectors,
            CHUNK * LANES,
            grid,
        )?;
        self.batches.clear();
        let mut first = 0;
        for tile in self.bins.starts.windows(2) {
            self.batches.push((first, 0));
            first += ((tile[1] - tile[0]) as usize).div_ceil(BATCH);
        }
        memory::first(&mut self.block_masks, first);
        self.state = Some(ForwardState {
            camera: *camera,
            settings: *settings,
            grid,
            view,
            background,
            rows,
        });
        Ok(())
    }

    /// Lists the chunks of rows that a view may see.
    fn find_seen<S: Source>(&mut self, source: &S, camera: &Camera) {
        let chunks = source.len().div_ceil(CHUNK * LANES);
        self.seen.clear();
        let Some(bounds) = source.bounds() else {
            (self.seen).extend((0..chunks as u32).map(|chunk| (chunk, [true; PARTS])));
            return;
        };
        let frustum = Frustum::of(camera);
        let parts = bounds.par_chunks(PARTS).map(|parts| {
            let mut seen = [false; PARTS];
            for (seen, part) in seen.iter_mut().zip(parts) {
                *seen = part.tile_rows(&frustum).is_some();
            }
            seen
        });
        let seen = (0..).zip(parts.collect::<Vec<_>>());
        (self.seen).extend(seen.filter(|(_, seen)| seen.contains(&true)));
    }

    fn project<S: Source>(&mut self, view: &View, source: S, grid: TileGrid) {
        let groups = source.len().div_ceil(LANES);
        let isa = self.isa;
        let rows = self.seen.len() * CHUNK * LANES;
        let splats = memory::first(&mut self.splats, rows);
        let tile_lists = memory::first(&mut self.tile_lists, rows);
        self.intersectors
            .resize_with(self.seen.len(), TileIntersector::default);
        let parts = splats
            .par_chunks_mut(CHUNK * LANES)
            .zip(tile_lists.par_chunks_mut(CHUNK * LANES))
            .zip(&mut self.intersectors)
            .zip(&self.seen);
        type Part<'a> = (
            (
                (&'a mut [Splat], &'a mut [TileList]),
                &'a mut TileIntersector,
            ),
            &'a SeenChunk,
        );
        let project = |(at, (((out, tile_lists), intersector), (chunk, seen))): (usize, Part)| {
            let first = *chunk as usize * CHUNK;
            let project = Project {
                seen,
                view,
                source,
                first,
                last: groups.min(first + CHUNK),
                grid,
                out,
                tile_lists,
                intersector,
            };
            (at * CHUNK * LANES, dispatch(isa, project))
        };
        parts
            .enumerate()
            .with_max_len(1)
            .map(project)
            .collect_into_vec(&mut self.chunks);
    }

    /// Collects the visible splats' keys, in row order; returns their number.
    fn collect_keys(&mut self) -> usize {
        let mut first = 0;
        let starts = self.chunks.iter().map(|&(_, count)| {
            first += count;
            first - count
        });
        let starts: Vec<usize> = starts.collect();
        let visible = first;
        let order = DisjointSlice::new(memory::first(&mut self.order, visible));
        let chunks = self.chunks.par_iter().zip(starts);
        chunks.for_each(|(&(first, count), start)| {
            // SAFETY: the chunks' stretches of keys do not overlap.
            let keys = unsafe { order.slice(start, count) };
            for (i, (key, splat)) in keys.iter_mut().zip(&self.splats[first..]).enumerate() {
                *key = Key {
                    depth: splat.depth.to_bits(),
                    splat: (first + i) as u32,
                };
            }
        });
        visible
    }
}
