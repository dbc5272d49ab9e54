//! A view's share of every Gaussian's sensitivity: forward, then the tiles and rows of [`crate::raster::sensitivity`].

use rayon::prelude::*;

use super::{Image, Rasterizer};
use crate::raster::disjoint::DisjointSlice;
use crate::raster::params::Params;
use crate::raster::sensitivity::{GatherSensitivity, MOMENTS, Sensitivity, TRIANGLE};
use crate::raster::simd::dispatch;
use crate::raster::tile_batch::TileBatch;
use crate::raster::{Camera, Settings};
use crate::{Error, Result};

impl Rasterizer {
    /// Renders a view over black and adds to every Gaussian's F, 21 values of the upper triangle a row.
    pub fn sensitivity(
        &mut self,
        params: &Params,
        camera: &Camera,
        settings: &Settings,
        sums: &mut [f64],
    ) -> Result<()> {
        if settings.antialiased {
            return Err(Error::invalid("sensitivity", "no antialiasing", "some"));
        }
        if sums.len() != TRIANGLE * params.len() {
            let expected = format!("{TRIANGLE} values for each of {} rows", params.len());
            return Err(Error::invalid("sensitivity", expected, sums.len()));
        }
        let pixels = camera.width * camera.height;
        let mut image = Image {
            rgb: &mut vec![0.0; 3 * pixels],
            alpha: &mut vec![0.0; pixels],
            depth: None,
            median: None,
        };
        self.forward(params, camera, settings, [0.0; 3], &mut image)?;
        let sensitive = self.sensitivity_tiles();
        let Some(state) = &self.state else {
            return Ok(());
        };
        let out = DisjointSlice::new(sums);
        self.visible().for_each(|(splats, slots)| {
            let gather = GatherSensitivity {
                view: &state.view,
                source: *params,
                splats,
                slots: &sensitive[slots.clone()],
                written: &self.written[slots],
                out,
            };
            dispatch(self.isa, gather);
        });
        Ok(())
    }

    /// Every pair's sums, in its slot.
    fn sensitivity_tiles(&mut self) -> Vec<[f32; MOMENTS]> {
        self.clear_slots();
        let mut sums = vec![[0.0; MOMENTS]; self.bins.pairs.len()];
        let Some(state) = &self.state else {
            return sums;
        };
        let camera = &state.camera;
        let grid = state.grid;
        let slots = DisjointSlice::new(&mut sums);
        let written = DisjointSlice::new(&mut self.written);
        let (bins, splats, isa) = (&self.bins, &self.splats, self.isa);
        let states = self
            .batches
            .par_iter()
            .zip(&self.transmittance)
            .zip(&self.last);
        states.enumerate().for_each_init(
            TileBatch::default,
            |tile_batch, (tile, ((batch, transmittance), last))| {
                let sensitivity = Sensitivity {
                    pairs: bins.pairs_of(tile),
                    splats,
                    rect: grid.rect(tile, camera),
                    settings: &state.settings,
                    block_masks: &self.block_masks[batch.0..batch.0 + batch.1],
                    transmittance,
                    last,
                    batch: &mut tile_batch.splats,
                    slots,
                    written,
                };
                dispatch(isa, sensitivity);
            },
        );
        sums
    }
}
