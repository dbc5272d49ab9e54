//! Recovery's steps on the device: forward, loss, backward, regularisers and Adam, as [`g2ard_core::train`].
//!
//! Parameters and moments stay on the device. A step writes the camera, the rates and the target, runs one recorded list
//! of kernels and reads back six words. Gaussians are projected and sorted by depth, expanded to pairs with the tiles that
//! they meet, and the pairs sorted by tile. Each pair has a place of its own for the sums of its gradient, beside those of
//! the same Gaussian, which are added in order. No sum is atomic: the bits do not change from run to run.

mod constants;
mod frame;
mod scene;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use g2ard_core::raster::Convention;
use g2ard_core::train::{Exported, Report, StepInput, Train, anchor_rows};

use crate::runtime::{Constants, Error, Gpu, Result, Work, guarded};
use constants::Step;
use frame::{Frame, Room};
use scene::Scene;

/// The device's trainer. It cannot be used after [`g2ard_core::Error::Device`].
pub struct Trainer {
    gpu: Own,
    scene: Scene,
    constants: Constants,
    frame: Option<Frame>,
    anchored: bool,
}

/// A device for the process that opened it.
struct Own {
    gpu: Arc<Gpu>,
    process: u32,
}

impl Own {
    /// The device; an error in a forked child.
    fn get(&self) -> Result<&Gpu> {
        match self.process == std::process::id() {
            true => Ok(&self.gpu),
            false => Err(Error::Forked),
        }
    }
}

impl Trainer {
    /// Start from a state with this number of SH coefficients.
    pub fn new(gpu: Arc<Gpu>, state: &Exported, coeffs: usize) -> Result<Self> {
        let scene = Scene::new(&gpu, state, coeffs)?;
        let nothing = vec![0; size_of::<Step>() / 4];
        Ok(Self {
            constants: gpu.constants(&nothing),
            gpu: Own {
                gpu,
                process: std::process::id(),
            },
            scene,
            frame: None,
            anchored: false,
        })
    }

    fn take_step(&mut self, input: &StepInput) -> Result<Report> {
        let gpu = self.gpu.get()?;
        let camera = input.camera;
        let mut room = Room::of(gpu, camera.width, camera.height)?;
        room.pairs = (2 * self.scene.rows).max(1 << 14);
        loop {
            let frame = frame_for(gpu, &self.scene, &self.constants, &mut self.frame, room)?;
            let mut constants = Step::of(input, self.scene.rows, self.scene.coeffs);
            constants.capacity = frame.room.pairs as u32;
            // A thread draws a tile's pairs one after the other, and does little else.
            constants.most_in_tile = u32::try_from(gpu.max_rounds() / 8 * 7).unwrap_or(u32::MAX);
            gpu.set_constants(&self.constants, constants.words());
            gpu.overwrite(&frame.target, input.target);
            if let Some(mask) = input.mask {
                let mut bytes: Vec<u8> = mask.iter().map(|&counts| counts.into()).collect();
                bytes.resize(mask.len().next_multiple_of(4), 0);
                gpu.overwrite(&frame.mask, &bytes);
            }
            let work = Work::of(gpu, frame.step.clone());
            let found = work.submit(&[(&frame.state, frame::STATE)])?.take()?;
            let [pairs, failed, updated, skipped, loss, _] = found[0][..] else {
                return Err(Error::Lost("it left no state".to_owned()));
            };
            let too_many = |what, count: usize, limit: usize| Error::TooMany {
                what,
                count: count as u64,
                limit: limit as u64,
            };
            match failed {
                0 => {
                    return Ok(Report {
                        loss: f64::from(f32::from_bits(loss)),
                        updated: updated as usize,
                        skipped: skipped as usize,
                    });
                }
                1 if pairs as usize > frame.room.pairs => {
                    room.pairs = pairs as usize / 4 * 5 + 1024;
                }
                1 => {
                    return Err(too_many(
                        "pairs of splat and tile of a view",
                        1 << 32,
                        (1 << 32) - 1,
                    ));
                }
                _ => {
                    let limit = constants.most_in_tile as usize;
                    return Err(too_many("splats in a tile of a view", limit + 1, limit));
                }
            }
        }
    }
}

/// The frame, with at least this room.
fn frame_for<'a>(
    gpu: &Gpu,
    scene: &Scene,
    constants: &Constants,
    held: &'a mut Option<Frame>,
    room: Room,
) -> Result<&'a Frame> {
    let had = held.as_ref().map_or(Room::default(), |frame| frame.room);
    let room = room.with(had);
    let frame = match held.take() {
        Some(frame) if frame.room == room => frame,
        outgrown => {
            drop(outgrown); // before its successor takes as much memory
            Frame::new(gpu, scene, constants, room)?
        }
    };
    Ok(held.insert(frame))
}

/// An error of the device as the core's.
fn failed(error: Error) -> g2ard_core::Error {
    g2ard_core::Error::Device(error.to_string())
}

impl Train for Trainer {
    fn step(&mut self, input: &StepInput) -> g2ard_core::Result<Report> {
        input.validate(self.anchored)?;
        if input.settings.convention != Convention::Gsplat {
            let (want, got) = ("gsplat on this device", "inria");
            return Err(g2ard_core::Error::invalid("convention", want, got));
        }
        guarded(|| self.take_step(input)).map_err(failed)
    }

    fn values(&self) -> g2ard_core::Result<Vec<f32>> {
        guarded(|| self.scene.values(self.gpu.get()?)).map_err(failed)
    }

    fn export(&self) -> g2ard_core::Result<Exported> {
        guarded(|| self.scene.export(self.gpu.get()?)).map_err(failed)
    }

    fn import(&mut self, state: &Exported) -> g2ard_core::Result<()> {
        state.validate(self.scene.rows, self.scene.attributes())?;
        guarded(|| self.scene.import(self.gpu.get()?, state)).map_err(failed)
    }

    fn freeze(&mut self, frozen: &[bool]) -> g2ard_core::Result<()> {
        let rows = self.scene.rows;
        g2ard_core::Error::unless_equal("frozen", frozen.len(), rows, "rows")?;
        guarded(|| self.scene.freeze(self.gpu.get()?, frozen)).map_err(failed)
    }

    fn set_anchors(
        &mut self,
        means: &[f32],
        frames: &[f32],
        r_parallel: &[f32],
        r_perp: &[f32],
    ) -> g2ard_core::Result<()> {
        let rows = anchor_rows(&self.scene.order, means, frames, r_parallel, r_perp)?;
        guarded(|| self.scene.set_anchors(self.gpu.get()?, &rows)).map_err(failed)?;
        self.anchored = true;
        Ok(())
    }
}
