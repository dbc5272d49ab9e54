//! The kernels that selection calls, and the CPU's.

use super::{Gaussians, Occluders, Surface, view_statistics, visible_cells};
use crate::raster::Camera;
use crate::spatial::{Cells, RobustBounds};
use crate::{Control, Cpu, Result};

/// Kernels over a scene and its views. An implementation may differ from [`Cpu`]'s within a stated tolerance.
pub trait ViewKernels: Sync {
    /// See [`Cells::adaptive`].
    fn cells(&self, points: &[[f64; 3]], bounds: &RobustBounds, target: usize) -> Result<Cells>;

    /// See [`view_statistics`].
    fn view_statistics(
        &self,
        scene: &Gaussians<'_>,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<[f32; 2]>>;

    /// See [`visible_cells`].
    fn visible_cells(
        &self,
        scene: &Gaussians<'_>,
        surface: &Surface,
        tolerance: f32,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<Vec<u32>>>;
}

impl ViewKernels for Cpu {
    fn cells(&self, points: &[[f64; 3]], bounds: &RobustBounds, target: usize) -> Result<Cells> {
        Ok(Cells::adaptive(points, bounds, target))
    }

    fn view_statistics(
        &self,
        scene: &Gaussians<'_>,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<[f32; 2]>> {
        view_statistics(&Occluders::of(scene), cameras, control)
    }

    fn visible_cells(
        &self,
        scene: &Gaussians<'_>,
        surface: &Surface,
        tolerance: f32,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<Vec<u32>>> {
        visible_cells(&Occluders::of(scene), surface, tolerance, cameras, control)
    }
}
