//! Inputs and outputs of the passes.

use crate::raster::Camera;
use crate::{Error, Result};

/// Outputs of the forward pass: row-major, `height × width` (× 3 interleaved).
#[derive(Debug)]
pub struct Image<'a> {
    pub rgb: &'a mut [f32],
    /// 1 − transmittance.
    pub alpha: &'a mut [f32],
    /// Σ αT·z: *not* divided by alpha.
    pub depth: Option<&'a mut [f32]>,
    /// Depth of the splat at which transmittance falls below one half; 0 if it never does.
    pub median: Option<&'a mut [f32]>,
}

/// dL/d(image), dL/d(alpha), dL/d(depth), in the layouts of [`Image`].
#[derive(Debug, Clone, Copy)]
pub struct ImageGradients<'a> {
    pub rgb: &'a [f32],
    pub alpha: Option<&'a [f32]>,
    pub depth: Option<&'a [f32]>,
}

fn check(name: &'static str, got: usize, expected: usize) -> Result<()> {
    Error::unless_equal(name, got, expected, "values")
}

impl Image<'_> {
    /// Check that every plane has the camera's size.
    pub(crate) fn validate(&self, camera: &Camera) -> Result<()> {
        let pixels = camera.width * camera.height;
        let length = |plane: &Option<&mut [f32]>| plane.as_ref().map_or(pixels, |p| p.len());
        check("image", self.rgb.len(), 3 * pixels)?;
        check("alpha", self.alpha.len(), pixels)?;
        check("depth", length(&self.depth), pixels)?;
        check("median", length(&self.median), pixels)
    }
}

impl ImageGradients<'_> {
    /// Check sizes like [`Image`].
    pub(crate) fn validate(&self, camera: &Camera) -> Result<()> {
        let pixels = camera.width * camera.height;
        let length = |plane: Option<&[f32]>| plane.map_or(pixels, <[f32]>::len);
        check("image gradient", self.rgb.len(), 3 * pixels)?;
        check("alpha gradient", length(self.alpha), pixels)?;
        check("depth gradient", length(self.depth), pixels)
    }
}
