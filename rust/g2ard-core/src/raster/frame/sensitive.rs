//! A view's share of every Gaussian's sensitivity: forward, then the tiles and rows of [`crate::raster::sensitivity`].

use rayon::prelude::*;

use super::{Image, Rasterizer};
use crate::raster::order::Shared;
use crate::raster::params::Params;
use crate::raster::sensitivity::{GatherSensitivity, MOMENTS, Sensitivity, TRIANGLE};
use crate::raster::simd::dispatch;
use crate::raster::stage::{Place, Staged};
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
        let Some(frame) = &self.frame else {
            return Ok(());
        };
        let out = Shared::new(sums);
        let chunks = self.chunks.par_iter().enumerate();
        chunks.for_each(|(chunk, &(first, count))| {
            let slots = self.bins.slots_of(chunk);
            let gather = GatherSensitivity {
                view: &frame.view,
                source: *params,
                splats: &self.splats[first..first + count],
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
        let Some(frame) = &self.frame else {
            return sums;
        };
        let camera = &frame.camera;
        let tiles_x = camera.tiles().0;
        let slots = Shared::new(&mut sums);
        let written = Shared::new(&mut self.written);
        let (bins, splats, isa) = (&self.bins, &self.splats, self.isa);
        let states = self
            .batches
            .par_iter()
            .zip(&self.transmittance)
            .zip(&self.last);
        states.enumerate().for_each_init(
            Staged::default,
            |staged, (tile, ((batch, transmittance), last))| {
                let sensitivity = Sensitivity {
                    pairs: &bins.pairs[bins.starts[tile] as usize..bins.starts[tile + 1] as usize],
                    splats,
                    place: Place::of(tile, tiles_x, camera.width, camera.height),
                    settings: &frame.settings,
                    words: &self.words[batch.0..batch.0 + batch.1],
                    transmittance,
                    last,
                    batch: &mut staged.near,
                    slots,
                    written,
                };
                dispatch(isa, sensitivity);
            },
        );
        sums
    }
}
