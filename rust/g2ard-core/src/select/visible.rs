//! Visibility of surface cells and depths in each view.

use rayon::prelude::*;

use super::Surface;
use super::depth::Scratch;
use super::occluders::Occluders;
use super::pinhole::Pinhole;
use crate::raster::Camera;
use crate::{Control, Result};

/// The share of each camera's pixels that show the scene, and their median depth: see [`statistics_of`].
pub fn view_statistics(
    scene: &Occluders,
    cameras: &[Camera],
    control: &Control,
) -> Result<Vec<[f32; 2]>> {
    control.begin(cameras.len() as u64);
    cameras
        .par_iter()
        .map_init(Scratch::default, |scratch, camera| {
            control.check()?;
            let view = Pinhole::of(camera);
            scratch.clear(&view, 1.0);
            scratch.trace(scene, &view);
            control.advance(1);
            Ok(statistics_of(&scratch.depth))
        })
        .collect()
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

/// The cells that each camera sees, ascending: the cell's centre falls on the image and lies within max(cell size,
/// `tolerance` · its depth) of the median depth in that pixel.
pub fn visible_cells(
    scene: &Occluders,
    surface: &Surface,
    tolerance: f32,
    cameras: &[Camera],
    control: &Control,
) -> Result<Vec<Vec<u32>>> {
    control.begin(cameras.len() as u64);
    let centers: Vec<[f32; 3]> = surface
        .centers
        .iter()
        .map(|c| c.map(|v| v as f32))
        .collect();
    cameras
        .par_iter()
        .map_init(Scratch::default, |scratch, camera| {
            control.check()?;
            let view = Pinhole::of(camera);
            scratch.clear(&view, 0.0);
            let mut cells: Vec<(u32, u32, f32)> = Vec::new();
            for (cell, &center) in centers.iter().enumerate() {
                if let Some((pixel, z)) = view.pixel(center) {
                    scratch.light[pixel as usize] = 1.0;
                    cells.push((cell as u32, pixel, z));
                }
            }
            scratch.trace(scene, &view);
            control.advance(1);
            let near = |&(_, pixel, z): &(u32, u32, f32)| {
                let median = scratch.depth[pixel as usize];
                median > 0.0 && (z - median).abs() <= (surface.size as f32).max(tolerance * z)
            };
            Ok(cells.iter().filter(|c| near(c)).map(|c| c.0).collect())
        })
        .collect()
}
