//! The kernel that looks call, and the CPU's.

use super::VisibilityAccumulator;
use crate::raster::{Camera, Settings};
use crate::{Control, Cpu, Result};

/// Kernels over a scene that views look at. An implementation may differ from [`Cpu`]'s within a stated tolerance.
pub trait VisibilityKernels: Sync {
    /// Adds views in the scene's coordinates.
    fn add_views(
        &self,
        sums: &mut VisibilityAccumulator,
        cameras: &[Camera],
        settings: &Settings,
        control: &Control,
    ) -> Result<()>;
}

impl VisibilityKernels for Cpu {
    fn add_views(
        &self,
        sums: &mut VisibilityAccumulator,
        cameras: &[Camera],
        settings: &Settings,
        control: &Control,
    ) -> Result<()> {
        control.begin(cameras.len() as u64);
        for camera in cameras {
            control.check()?;
            sums.add(camera, settings)?;
            control.advance(1);
        }
        Ok(())
    }
}
