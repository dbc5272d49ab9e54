//! Gaussians on the device, in pieces, for all views.

use g2ard_core::select::{Gaussians, Occluder, Occluders};

use super::BLOCK;
use crate::runtime::{Buffer, Gpu, Result};

/// Words of a row.
const ROW: usize = 12;

pub struct Scene<'a> {
    pub gpu: &'a Gpu,
    pub count: usize,
    /// Each of a multiple of `BLOCK` rows, but the last.
    pieces: Vec<Buffer>,
}

impl<'a> Scene<'a> {
    pub fn upload(gpu: &'a Gpu, scene: &Gaussians<'_>) -> Result<Self> {
        let occluders = Occluders::of(scene);
        let piece = (gpu.max_words() / ROW / BLOCK).max(1) * BLOCK;
        Ok(Self {
            gpu,
            count: occluders.rows.len(),
            pieces: occluders
                .rows
                .chunks(piece)
                .map(|rows| gpu.upload("rows", &rows.iter().map(words_of).collect::<Vec<_>>()))
                .collect::<Result<_>>()?,
        })
    }

    /// Each piece with its first row and how many it has.
    pub fn pieces(&self) -> impl Iterator<Item = (usize, usize, &Buffer)> {
        let mut first = 0;
        self.pieces.iter().map(move |piece| {
            let count = piece.words() / ROW;
            first += count;
            (first - count, count, piece)
        })
    }
}

fn words_of(row: &Occluder) -> [u32; ROW] {
    let mut words = [0; ROW];
    let numbers = row.mean.iter().chain([&row.opacity]);
    let numbers = numbers
        .chain(&row.covariance)
        .chain([&row.trace, &row.reach]);
    words
        .iter_mut()
        .zip(numbers)
        .for_each(|(word, number)| *word = number.to_bits());
    words
}
