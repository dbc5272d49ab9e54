//! Visibility of a surface's cells.

use g2ard_core::select::Surface;

use super::raster::THREADS;
use super::view::View;
use crate::runtime::{Buffer, Gpu, Kernel, Result, Work};

const CELLS: &[&str] = &[include_str!("pinhole.wgsl"), include_str!("cells.wgsl")];
const WANT: Kernel = Kernel::new("visibility.want", CELLS, "want");
const SEEN: Kernel = Kernel::new("visibility.seen", CELLS, "seen");

/// Centres of cells on the device.
pub struct Cells {
    centers: Buffer,
    count: usize,
    /// Edge of a cell, and its depth tolerance as a share of its depth.
    size: f32,
    tolerance: f32,
}

impl Cells {
    pub fn upload(gpu: &Gpu, surface: &Surface, tolerance: f32) -> Result<Self> {
        let centers = surface.centers.iter().map(|c| c.map(|v| v as f32));
        Ok(Self {
            centers: gpu.upload("cells", &centers.collect::<Vec<_>>())?,
            count: surface.len(),
            size: surface.size as f32,
            tolerance,
        })
    }

    fn seen_in(&self, view: &View) -> View {
        View {
            cell: self.size,
            tolerance: self.tolerance,
            ..view.over(self.count)
        }
    }

    /// The cells whose bits are set.
    pub fn set(&self, bits: &[u32]) -> Vec<u32> {
        let bit = |cell: &u32| bits[*cell as usize / 32] >> (cell % 32) & 1 == 1;
        (0..self.count as u32).filter(bit).collect()
    }

    /// Light in the pixels that contain a cell; other depths are not needed.
    pub fn light(&self, gpu: &Gpu, work: &mut Work, view: &View) -> Result<Buffer> {
        let light = gpu.buffer("light", view.pixels())?;
        let groups = self.count.div_ceil(THREADS);
        let view = self.seen_in(view);
        work.run(&WANT, groups, view.words(), &[&self.centers, &light])?;
        Ok(light)
    }

    /// One bit per cell: set if the depths show it.
    pub fn seen(&self, gpu: &Gpu, work: &mut Work, view: &View, depth: &Buffer) -> Result<Buffer> {
        let words = self.count.div_ceil(32);
        let bits = gpu.buffer("seen", words)?;
        let bound = [(1, &self.centers), (3, depth), (4, &bits)];
        let view = self.seen_in(view);
        work.run_at(&SEEN, words.div_ceil(THREADS), view.words(), &bound)?;
        Ok(bits)
    }
}
