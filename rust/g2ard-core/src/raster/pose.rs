//! The gradient of an image with respect to the camera's pose.

use super::backward::SUMS;
use super::gradients::collect;
use super::params::Source;
use super::project::{Splat, View, unproject_to_pose};
use super::simd::{Kernel, LANES, Lanes, Lanes16};

/// dL/d(v, ω); see [`unproject_to_pose`].
pub type PoseGradient = [f64; 6];

/// Adds up the slots of one chunk's splats and their contribution to the pose's gradient.
pub(crate) struct GatherPose<'a, S: Source> {
    pub view: &'a View,
    pub source: S,
    /// One chunk's visible splats, in row order.
    pub splats: &'a [Splat],
    pub slots: &'a [[f32; SUMS]],
    pub written: &'a [u8],
}

impl<S: Source> Kernel for GatherPose<'_, S> {
    type Output = PoseGradient;

    #[inline(always)]
    fn run<F: Lanes>(self) -> PoseGradient {
        let mut sum = [0.0; 6];
        let mut next = 0;
        while next < self.splats.len() {
            let group = self.splats[next].row as usize / LANES;
            let (touched, screen) =
                collect::<F>(self.splats, &mut next, group, self.slots, self.written);
            if touched == 0 {
                continue;
            }
            let gradient = unproject_to_pose::<F, S>(self.view, &self.source, group, &screen);
            for (sum, values) in sum.iter_mut().zip(gradient) {
                let mut row = Lanes16::default();
                values.store(&mut row);
                for l in (0..LANES).filter(|l| touched >> l & 1 != 0) {
                    *sum += f64::from(row.0[l]);
                }
            }
        }
        sum
    }
}
