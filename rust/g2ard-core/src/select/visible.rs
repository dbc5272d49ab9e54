//! Visibility of surface cells and depths in each view: the kernels that selection calls, and the CPU's.

use rayon::prelude::*;

use super::depth::Scratch;
use super::occluders::Occluders;
use super::pinhole::Pinhole;
use super::{Gaussians, Surface};
use crate::raster::Camera;
use crate::{Control, Cpu, Result};

/// Kernels over a scene and its views. An implementation may differ from [`Cpu`]'s within a stated tolerance.
pub trait ViewKernels: Sync {
    /// The share of each camera's pixels that show the scene, and their median depth: see [`statistics_of`].
    fn view_statistics(
        &self,
        scene: &Gaussians<'_>,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<[f32; 2]>>;

    /// The cells that each camera sees, ascending: the cell's centre falls on the image and lies within max(cell size,
    /// `tolerance` · its depth) of the median depth in that pixel.
    fn visible_cells(
        &self,
        scene: &Gaussians<'_>,
        surface: &Surface,
        tolerance: f32,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<Vec<u32>>>;
}

/// The share of pixels that show the scene, and the median of their depths (0 without any).
pub fn statistics_of(image: &[f32]) -> [f32; 2] {
    let mut depths: Vec<f32> = image.iter().copied().filter(|&d| d > 0.0).collect();
    if depths.is_empty() {
        return [0.0; 2];
    }
    let share = depths.len() as f32 / image.len() as f32;
    let middle = depths.len() / 2;
    let median = *depths.select_nth_unstable_by(middle, f32::total_cmp).1;
    [share, median]
}

/// Call `look` for every camera, with buffers that a thread reuses.
fn each_view<T: Send>(
    cameras: &[Camera],
    control: &Control,
    look: impl Fn(&mut Scratch, &Pinhole) -> T + Sync,
) -> Result<Vec<T>> {
    control.begin(cameras.len() as u64);
    cameras
        .par_iter()
        .with_max_len(1)
        .map_init(Scratch::default, |scratch, camera| {
            control.check()?;
            let found = look(scratch, &Pinhole::of(camera));
            control.advance(1);
            Ok(found)
        })
        .collect()
}

impl ViewKernels for Cpu {
    fn view_statistics(
        &self,
        scene: &Gaussians<'_>,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<[f32; 2]>> {
        let scene = Occluders::of(scene);
        each_view(cameras, control, |scratch, view| {
            scratch.clear(view, 1.0);
            scratch.trace(&scene, view);
            statistics_of(&scratch.depth)
        })
    }

    fn visible_cells(
        &self,
        scene: &Gaussians<'_>,
        surface: &Surface,
        tolerance: f32,
        cameras: &[Camera],
        control: &Control,
    ) -> Result<Vec<Vec<u32>>> {
        let scene = Occluders::of(scene);
        let centers = surface.centers.iter().map(|c| c.map(|v| v as f32));
        let centers: Vec<[f32; 3]> = centers.collect();
        each_view(cameras, control, |scratch, view| {
            scratch.clear(view, 0.0);
            let mut cells: Vec<(u32, u32, f32)> = Vec::new();
            for (cell, &center) in centers.iter().enumerate() {
                if let Some((pixel, z)) = view.pixel(center) {
                    scratch.light[pixel as usize] = 1.0;
                    cells.push((cell as u32, pixel, z));
                }
            }
            scratch.trace(&scene, view);
            let near = |&(_, pixel, z): &(u32, u32, f32)| {
                let median = scratch.depth[pixel as usize];
                median > 0.0 && (z - median).abs() <= (surface.size as f32).max(tolerance * z)
            };
            cells.iter().filter(|c| near(c)).map(|c| c.0).collect()
        })
    }
}
