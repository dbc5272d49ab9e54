//! The derivative of an image with respect to its pose.

use super::{ChunkSums, ImageGradients, Rasterizer};
use crate::Result;
use crate::raster::params::Params;
use crate::raster::pose::{GatherPose, PoseGradient};
use crate::raster::simd::dispatch;

impl Rasterizer {
    /// dL/dξ of the last forward pass's pose T, where T ← exp(ξ)·T with ξ = (v, ω) in the camera's axes. `params` must be
    /// the ones it rendered, and the gradient of depth is not followed. Summed in f64, chunk by chunk of rows: the bits do
    /// not depend on threads.
    pub fn pose_gradient(
        &mut self,
        params: &Params,
        image: &ImageGradients,
    ) -> Result<PoseGradient> {
        params.validate()?;
        self.check_rendered("pose gradient", params.len(), image)?;
        refuse!(image.depth.is_some() => "pose gradient", "no gradient of depth", "one");
        let isa = self.isa;
        let parts = self.backward_by_chunk(image, |chunk: &ChunkSums| {
            let gather = GatherPose {
                view: chunk.view,
                source: *params,
                splats: chunk.splats,
                slots: chunk.slots,
                written: chunk.written,
            };
            dispatch(isa, gather)
        });
        let mut sum = [0.0; 6];
        for part in parts {
            for (sum, value) in sum.iter_mut().zip(part) {
                *sum += value;
            }
        }
        Ok(sum)
    }
}
