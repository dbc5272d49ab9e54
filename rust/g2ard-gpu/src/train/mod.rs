//! Recovery's steps on the device: forward, loss, backward, regularisers and Adam, as [`g2ard_core::train`].
//!
//! Parameters, moments and the targets that fit stay on the device. A step writes the camera and the rates, runs one recorded
//! list of kernels and reads back six words. Gaussians are projected and sorted by depth, expanded to pairs with the tiles that
//! they meet, and the pairs sorted by tile. Each pair has a place of its own for the sums of its gradient, beside those of
//! the same Gaussian, which are added in order. No sum is atomic: the bits do not change from run to run.

mod constants;
mod frame;
mod images;
mod scene;
mod targets;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use g2ard_core::raster::Convention;
use g2ard_core::train::{Exported, Report, StepInput, Train, anchor_rows};

use crate::runtime::{Error, Gpu, Owned, Result, Work, guarded};
use constants::Step;
use frame::{Target, View};
pub use images::Images;
use scene::Scene;
use targets::Targets;

/// The device's trainer. It cannot be used after [`g2ard_core::Error::Device`].
pub struct Trainer {
    held: Owned<Held>,
    rows: usize,
    attributes: usize,
    anchored: bool,
}

struct Held {
    gpu: Arc<Gpu>,
    scene: Scene,
    view: View,
    targets: Targets,
}

impl Trainer {
    /// Start from a state with this number of SH coefficients.
    pub fn new(gpu: Arc<Gpu>, state: &Exported, coeffs: usize) -> Result<Self> {
        let scene = Scene::new(&gpu, state, coeffs)?;
        let view = View::new(&gpu);
        Ok(Self {
            rows: scene.values.rows,
            attributes: scene.attributes(),
            held: Owned::new(Held {
                gpu,
                scene,
                view,
                targets: Targets::default(),
            }),
            anchored: false,
        })
    }

    /// Run `f` on the device.
    fn with<T>(&self, f: impl FnOnce(&Gpu, &Scene) -> Result<T>) -> g2ard_core::Result<T> {
        guarded(|| self.held.get().and_then(|held| f(&held.gpu, &held.scene))).map_err(failed)
    }

    /// Run `f` on the device.
    fn change<T>(&mut self, f: impl FnOnce(&mut Held) -> Result<T>) -> g2ard_core::Result<T> {
        guarded(|| self.held.get_mut().and_then(f)).map_err(failed)
    }
}

impl Held {
    fn step(&mut self, input: &StepInput) -> Result<Report> {
        let gpu = &self.gpu;
        let kept = self.targets.of(gpu, input)?;
        let fill = |work: &mut Work, target: &Target| match kept {
            Some(kept) => kept.copy(work, target),
            None => targets::send(gpu, input, target),
        };
        let values = &self.scene.values;
        let task = Step::of(input, values);
        let found = (self.view).run(gpu, values, Some(&self.scene), task, fill)?;
        Ok(Report {
            loss: f64::from(found.loss),
            updated: found.updated as usize,
            skipped: found.skipped as usize,
        })
    }
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
        self.change(|held| held.step(input))
    }

    fn values(&self) -> g2ard_core::Result<Vec<f32>> {
        self.with(|gpu, scene| scene.values(gpu))
    }

    fn export(&self) -> g2ard_core::Result<Exported> {
        self.with(|gpu, scene| scene.export(gpu))
    }

    fn import(&mut self, state: &Exported) -> g2ard_core::Result<()> {
        state.validate(self.rows, self.attributes)?;
        self.change(|held| held.scene.import(&held.gpu, state))
    }

    fn freeze(&mut self, frozen: &[bool]) -> g2ard_core::Result<()> {
        g2ard_core::Error::unless_equal("frozen", frozen.len(), self.rows, "rows")?;
        self.change(|held| held.scene.freeze(&held.gpu, frozen))
    }

    fn set_anchors(
        &mut self,
        means: &[f32],
        frames: &[f32],
        r_parallel: &[f32],
        r_perp: &[f32],
    ) -> g2ard_core::Result<()> {
        let order = &self.held.get().map_err(failed)?.scene.order;
        let rows = anchor_rows(order, means, frames, r_parallel, r_perp)?;
        self.with(|gpu, scene| scene.set_anchors(gpu, &rows))?;
        self.anchored = true;
        Ok(())
    }
}
