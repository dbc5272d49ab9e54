//! A view's contribution to every Gaussian's sums: see [`crate::raster::accumulate`].

use rayon::prelude::*;

use super::Rasterizer;
use super::tiled::MOST_TILES;
use crate::Result;
use crate::raster::accumulate::{ALL, Accumulate, Accumulated, SharedSums, Total, smallest_pixels};
use crate::raster::disjoint::DisjointSlice;
use crate::raster::grid::TileGrid;
use crate::raster::memory;
use crate::raster::params::{Params, Source};
use crate::raster::simd::dispatch;
use crate::raster::tile_batch::TileBatch;
use crate::raster::{Camera, Settings};

impl Rasterizer {
    /// Renders a view without an image and adds what every Gaussian contributes to it.
    pub fn accumulate(
        &mut self,
        params: &Params,
        camera: &Camera,
        settings: &Settings,
        sums: &mut Accumulated,
    ) -> Result<()> {
        params.validate()?;
        camera.validate()?;
        settings.validate()?;
        refuse!(sums.weight.len() != params.len() =>
            "accumulate", format!("sums of {} rows", params.len()), sums.weight.len());
        let colourless = Params {
            sh_n: &[],
            sh_coeffs: 1,
            ..*params
        };
        let rows = SharedSums::new(sums);
        self.accumulate_from::<ALL, _>(
            colourless,
            camera,
            settings,
            TileGrid::of(camera),
            |row, total| {
                // SAFETY: the call comes once for every row.
                unsafe { rows.add(row, &total) };
            },
        )?;
        smallest_pixels(params, camera, &mut sums.pixel_size);
        Ok(())
    }

    /// Calls `visit(row, its sums)` once for every row that may touch the grid's part of the view's image, in parallel.
    pub(crate) fn accumulate_from<const KINDS: usize, S: Source>(
        &mut self,
        source: S,
        camera: &Camera,
        settings: &Settings,
        grid: TileGrid,
        visit: impl Fn(usize, Total) + Sync,
    ) -> Result<()> {
        self.prepare(source, camera, settings, [0.0; 3], grid)?;
        self.accumulate_tiles::<KINDS>();
        let shares = self.shares.as_chunks::<KINDS>().0;
        self.visible().for_each(|(splats, slots)| {
            let (shares, written) = (&shares[slots.clone()], &self.written[slots]);
            for splat in splats {
                visit(splat.row as usize, Total::of(splat, shares, written));
            }
        });
        self.state = None; // no state that a backward pass could use
        Ok(())
    }

    fn accumulate_tiles<const KINDS: usize>(&mut self) {
        let pairs = self.bins.len();
        let shares = memory::first(&mut self.shares, pairs * KINDS);
        memory::first(&mut self.written, pairs).fill(0);
        let Some(state) = &self.state else { return };
        let camera = &state.camera;
        let grid = state.grid;
        let slots = DisjointSlice::new(shares.as_chunks_mut::<KINDS>().0);
        let written = DisjointSlice::new(&mut self.written);
        let (bins, splats, isa) = (&self.bins, &self.splats, self.isa);
        let settings = &state.settings;
        let tiles = (0..self.batches.len())
            .into_par_iter()
            .with_max_len(MOST_TILES);
        tiles.for_each_init(TileBatch::default, |tile_batch, tile| {
            let rect = grid.rect(tile, camera);
            let accumulate = Accumulate {
                pairs: bins.pairs_of(tile),
                splats,
                rect,
                settings,
                tile_batch,
                slots,
                written,
            };
            dispatch(isa, accumulate);
        });
    }
}
