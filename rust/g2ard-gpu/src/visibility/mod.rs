//! Twin of `g2ard_core::select`'s visibility: the median depth of a view, and what it shows.
//!
//! A view takes two trips. The first projects all rows, marks those that the image may show and counts the tiles
//! they touch (`marks`). With the counts known, the second sorts the marked ones by depth, spreads them over their
//! tiles and draws (`tiles`). While one view is drawn the next is projected. Arithmetic is f32, as on the CPU;
//! drivers may fuse operations and round divisions and exponentials otherwise, so ties within that rounding may
//! fall elsewhere.

mod cells;
mod marks;
mod scene;
#[cfg(test)]
mod tests;
mod tiles;
mod view;

use g2ard_core::Control;
use g2ard_core::raster::Camera;
use g2ard_core::select::{Gaussians, Pinhole, Surface, statistics_of};

use crate::runtime::{Buffer, Gpu, Pending, Result, Work};
use cells::Cells;
use marks::Marked;
use scene::Scene;

/// Rows of a workgroup that projects them, and threads of all others.
const BLOCK: usize = 256;
const THREADS: usize = 64;
/// Words of a splat.
const SPLAT: usize = 9;
/// Beyond every depth.
const FAR: u32 = f32::INFINITY.to_bits();

/// See [`g2ard_core::select::view_statistics`].
pub fn view_statistics(
    gpu: &Gpu,
    scene: &Gaussians<'_>,
    cameras: &[Camera],
    control: &Control,
) -> Result<Vec<[f32; 2]>> {
    let scene = Scene::upload(gpu, scene)?;
    let read = |words: &[u32]| statistics_of(bytemuck::cast_slice(words));
    each(&scene, cameras, None, control, read)
}

/// See [`g2ard_core::select::visible_cells`].
pub fn visible_cells(
    gpu: &Gpu,
    scene: &Gaussians<'_>,
    surface: &Surface,
    tolerance: f32,
    cameras: &[Camera],
    control: &Control,
) -> Result<Vec<Vec<u32>>> {
    let scene = Scene::upload(gpu, scene)?;
    let cells = Cells::upload(gpu, surface, tolerance)?;
    each(&scene, cameras, Some(&cells), control, |bits| {
        cells.set(bits)
    })
}

/// A view whose rows are being marked.
struct Begun<'a> {
    view: Pinhole,
    light: Buffer,
    marked: Marked<'a>,
}

/// What `read` makes of each view's answer: its depths, or with `cells` a bit for each.
fn each<T>(
    scene: &Scene<'_>,
    cameras: &[Camera],
    cells: Option<&Cells>,
    control: &Control,
    read: impl Fn(&[u32]) -> T,
) -> Result<Vec<T>> {
    control.begin(cameras.len() as u64);
    let mut found = Vec::with_capacity(cameras.len());
    let mut begun = None;
    let mut drawn: Option<Pending> = None;
    for camera in cameras.iter().map(Some).chain([None]) {
        control.check()?;
        let next = camera.map(|c| begin(scene, c, cells)).transpose()?;
        let drawing = match begun.take() {
            Some(view) => Some(finish(scene, view, cells)?),
            None => None,
        };
        if let Some(done) = std::mem::replace(&mut drawn, drawing) {
            found.push(read(&done.take()?.concat()));
            control.advance(1);
        }
        begun = next;
    }
    if let Some(done) = drawn {
        found.push(read(&done.take()?.concat()));
        control.advance(1);
    }
    Ok(found)
}

/// The first trip.
fn begin<'a>(scene: &Scene<'a>, camera: &Camera, cells: Option<&Cells>) -> Result<Begun<'a>> {
    let view = view::of(camera)?;
    let pixels = view.width * view.height;
    let mut work = Work::new(scene.gpu);
    let light = match cells {
        Some(cells) => cells.light(scene.gpu, &mut work, &view)?,
        None => scene.gpu.upload("light", &vec![1f32; pixels])?,
    };
    let marked = scene.mark(work, &view, 0..FAR)?;
    Ok(Begun {
        view,
        light,
        marked,
    })
}

/// The second.
fn finish<'a>(scene: &Scene<'a>, begun: Begun<'a>, cells: Option<&Cells>) -> Result<Pending<'a>> {
    let Begun {
        view,
        light,
        marked,
    } = begun;
    let depth = scene.gpu.buffer("depth", view.width * view.height)?;
    let image = [&light, &depth];
    let marks = marked.counted()?;
    let mut work = Work::new(scene.gpu);
    if scene.fits(&marks) {
        scene.draw(&mut work, &view, &marks, image)?;
    } else {
        for range in scene.slabs(&view)? {
            let marks = scene.mark(Work::new(scene.gpu), &view, range)?.counted()?;
            scene.check_pairs(&marks)?;
            scene.draw(&mut work, &view, &marks, image)?;
        }
    }
    match cells {
        Some(cells) => cells.seen(scene.gpu, work, &view, &depth),
        None => work.submit(&[(&depth, depth.words())]),
    }
}
