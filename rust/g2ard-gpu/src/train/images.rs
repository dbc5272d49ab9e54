//! Images of a scene: the forward part of a step.

use std::sync::Arc;

use g2ard_core::raster::{Camera, Params, Settings};

use super::constants::Step;
use super::frame::View;
use super::scene::Values;
use crate::runtime::{Gpu, Owned, Result, guarded};

/// A scene on the device, and buffers of its last view.
pub struct Images(Owned<Held>);

struct Held {
    gpu: Arc<Gpu>,
    values: Values,
    view: View,
}

impl Images {
    pub fn new(gpu: Arc<Gpu>, params: &Params) -> Result<Self> {
        guarded(|| {
            let values = Values::of(&gpu, params)?;
            let view = View::new(&gpu);
            Ok(Self(Owned::new(Held { gpu, values, view })))
        })
    }

    /// Three values per pixel, of a valid view by gsplat's convention.
    pub fn draw(
        &mut self,
        camera: &Camera,
        settings: &Settings,
        background: [f32; 3],
    ) -> Result<Vec<f32>> {
        guarded(|| {
            let Held { gpu, values, view } = self.0.get_mut()?;
            let task = Step::image(camera, settings, background, values);
            Ok(view.run(gpu, values, None, task, |_, _| ())?.image)
        })
    }

    /// Make it another process's, as a fork does.
    #[cfg(test)]
    pub fn fork(&mut self) {
        self.0.fork();
    }
}
