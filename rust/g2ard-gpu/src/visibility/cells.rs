//! Cells of a surface against the image.

use g2ard_core::select::{Pinhole, Surface};

use super::THREADS;
use super::view::Constants;
use crate::runtime::{Buffer, Gpu, Kernel, Pending, Result, Work};

const CELLS: &[&str] = &[include_str!("pinhole.wgsl"), include_str!("cells.wgsl")];
const WANT: Kernel = Kernel {
    name: "visibility.want",
    sources: CELLS,
    entry: "want",
};
const SEEN: Kernel = Kernel {
    name: "visibility.seen",
    sources: CELLS,
    entry: "seen",
};

/// Words of a cell's centre.
const CENTER: usize = 3;

/// Centres of cells on the device, in pieces of whole words of 32.
pub struct Cells {
    count: usize,
    pieces: Vec<Buffer>,
    size: f32,
    tolerance: f32,
}

impl Cells {
    pub fn upload(gpu: &Gpu, surface: &Surface, tolerance: f32) -> Result<Self> {
        let centers: Vec<[f32; 3]> = surface
            .centers
            .iter()
            .map(|c| c.map(|v| v as f32))
            .collect();
        Ok(Self {
            count: centers.len(),
            pieces: centers
                .chunks((gpu.max_words() / CENTER / 32).max(1) * 32)
                .map(|piece| gpu.upload("cells", piece))
                .collect::<Result<_>>()?,
            size: surface.size as f32,
            tolerance,
        })
    }

    /// The cells whose bits are set.
    pub fn set(&self, bits: &[u32]) -> Vec<u32> {
        let bit = |cell: &u32| bits[*cell as usize / 32] >> (cell % 32) & 1 == 1;
        (0..self.count as u32).filter(bit).collect()
    }

    /// Light in the pixels that cells fall into: only their depths are needed.
    pub fn light(&self, gpu: &Gpu, work: &mut Work, view: &Pinhole) -> Result<Buffer> {
        let light = gpu.buffer("light", view.width * view.height)?;
        for piece in &self.pieces {
            let count = piece.words() / CENTER;
            let constants = Constants::new(view, count).words();
            work.run(&WANT, count.div_ceil(THREADS), &constants, &[piece, &light])?;
        }
        Ok(light)
    }

    /// Ends the work: a bit for each cell that the depths show.
    pub fn seen<'a>(
        &self,
        gpu: &Gpu,
        mut work: Work<'a>,
        view: &Pinhole,
        depth: &Buffer,
    ) -> Result<Pending<'a>> {
        let mut answers = Vec::new();
        for piece in &self.pieces {
            let count = piece.words() / CENTER;
            let constants = Constants {
                cell: self.size,
                tolerance: self.tolerance,
                ..Constants::new(view, count)
            };
            let bits = gpu.buffer("seen", count.div_ceil(32))?;
            let bound = [(1, piece), (3, depth), (4, &bits)];
            let groups = count.div_ceil(32).div_ceil(THREADS);
            work.run_at(&SEEN, groups, &constants.words(), &bound)?;
            answers.push(bits);
        }
        let reads: Vec<_> = answers.iter().map(|bits| (bits, bits.words())).collect();
        work.submit(&reads)
    }
}
