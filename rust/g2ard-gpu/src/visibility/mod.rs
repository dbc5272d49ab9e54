//! GPU kernels for visibility: the median depths and cells of `g2ard_core::select`, and each Gaussian's Σ αT² of
//! `g2ard_core::raster::visibility`.
//!
//! A view takes two submissions. The first projects all rows, marks those that the image may show and counts the tiles
//! they touch. With the counts known, the second sorts the marked rows by depth, distributes them over their tiles and
//! draws. While one view is drawn, the next is projected. Arithmetic is f32. Drivers may fuse operations and round
//! divisions and exponentials differently, so ties within that rounding may be decided differently.

mod cells;
mod raster;
mod scene;
#[cfg(test)]
mod tests;
mod view;

use g2ard_core::Control;
use g2ard_core::raster::visibility::VisibilityAccumulator;
use g2ard_core::raster::{Camera, Convention, Settings};
use g2ard_core::select::{Gaussians, Surface, statistics_of};

use crate::runtime::{Buffer, Gpu, Pending, Result, Work};
use cells::Cells;
use raster::{Goal, Marked};
use scene::Scene;
use view::View;

/// See [`g2ard_core::select::ViewKernels::view_statistics`].
pub fn view_statistics(
    gpu: &Gpu,
    scene: &Gaussians<'_>,
    cameras: &[Camera],
    control: &Control,
) -> Result<Vec<[f32; 2]>> {
    let scene = Scene::of_gaussians(gpu, scene)?;
    let read = |words: &[u32]| statistics_of(bytemuck::cast_slice(words));
    each(gpu, &scene, cameras, &MEDIAN, &Look::Depths, control, read)
}

/// See [`g2ard_core::select::ViewKernels::visible_cells`].
pub fn visible_cells(
    gpu: &Gpu,
    scene: &Gaussians<'_>,
    surface: &Surface,
    tolerance: f32,
    cameras: &[Camera],
    control: &Control,
) -> Result<Vec<Vec<u32>>> {
    let scene = Scene::of_gaussians(gpu, scene)?;
    let cells = Cells::upload(gpu, surface, tolerance)?;
    let read = |bits: &[u32]| cells.set(bits);
    let look = Look::Cells(&cells);
    each(gpu, &scene, cameras, &MEDIAN, &look, control, read)
}

/// Whether these settings can be drawn on the device.
pub fn serves(settings: &Settings) -> bool {
    settings.convention == Convention::Gsplat && !settings.antialiased
}

/// Σ αT² of every row over these views, in the order of `sums`. The device keeps the scene between calls.
pub fn weights(
    gpu: &Gpu,
    sums: &mut VisibilityAccumulator,
    cameras: &[Camera],
    settings: &Settings,
    control: &Control,
) -> Result<Vec<f32>> {
    let held = sums.held.take().and_then(|held| held.downcast().ok());
    let scene: Box<Scene> = match held {
        Some(scene) => scene,
        None => Box::new(Scene::of_sums(gpu, sums)?),
    };
    let weights = gpu.buffer("weights", scene.count)?;
    let cameras: Vec<Camera> = cameras.iter().map(|c| sums.relative(c)).collect();
    let look = Look::Weights(&weights);
    each(gpu, &scene, &cameras, settings, &look, control, |_| ())?;
    let found = Work::new(gpu).submit(&[(&weights, scene.count)])?.take()?;
    sums.held = Some(scene);
    Ok(found[0][..sums.len()]
        .iter()
        .map(|&w| f32::from_bits(w))
        .collect())
}

/// Settings for median depths, at which a pixel ends.
const MEDIAN: Settings = Settings {
    convention: Convention::Gsplat,
    antialiased: false,
    alpha_max: 0.99,
    transmittance_min: 0.5,
};

/// Result requested per view.
enum Look<'a> {
    Depths,
    Cells(&'a Cells),
    Weights(&'a Buffer),
}

/// Pass each view's answer to `read`: its depths, one bit per cell, or nothing.
fn each<T>(
    gpu: &Gpu,
    scene: &Scene,
    cameras: &[Camera],
    settings: &Settings,
    look: &Look<'_>,
    control: &Control,
    read: impl Fn(&[u32]) -> T,
) -> Result<Vec<T>> {
    control.begin(cameras.len() as u64);
    let mut found = Vec::with_capacity(cameras.len());
    let mut take = |drawn: Option<Pending>| -> Result<()> {
        if let Some(drawn) = drawn {
            found.push(read(&drawn.take()?.concat()));
            control.advance(1);
        }
        Ok(())
    };
    let (mut begun, mut drawn): (Option<Marked>, Option<Pending>) = (None, None);
    for camera in cameras.iter().map(Some).chain([None]) {
        control.check()?;
        let next = match camera {
            Some(camera) => Some(begin(gpu, scene, View::of(camera, settings)?, look)?),
            None => None,
        };
        let drawing = match begun.take() {
            Some(marked) => Some(finish(gpu, marked, look)?),
            None => None,
        };
        take(std::mem::replace(&mut drawn, drawing))?;
        begun = next;
    }
    take(drawn)?;
    Ok(found)
}

/// Submit the first part of a view.
fn begin<'a>(gpu: &'a Gpu, scene: &'a Scene, view: View, look: &Look<'_>) -> Result<Marked<'a>> {
    let mut work = Work::new(gpu);
    let light = match look {
        Look::Cells(cells) => cells.light(gpu, &mut work, &view)?,
        _ => gpu.upload("light", &vec![1f32; view.pixels()])?,
    };
    Marked::begin(gpu, work, scene, view, light)
}

/// Submit the second part of a view.
fn finish<'a>(gpu: &'a Gpu, marked: Marked<'a>, look: &Look<'_>) -> Result<Pending<'a>> {
    let (mut work, view) = (Work::new(gpu), marked.view);
    if let Look::Weights(weights) = look {
        marked.draw(&mut work, Goal::Weights(weights))?;
        return work.submit(&[]);
    }
    let depths = gpu.buffer("depth", view.pixels())?;
    marked.draw(&mut work, Goal::Depths(&depths))?;
    let answer = match look {
        Look::Cells(cells) => cells.seen(gpu, &mut work, &view, &depths)?,
        _ => depths,
    };
    work.submit(&[(&answer, answer.words())])
}
