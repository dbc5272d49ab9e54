//! Quantisers of file formats: codebooks of numbers, palettes of vectors.

mod cells;
mod codebook;
mod near;
mod palette;
mod rows;
#[cfg(test)]
mod tests;

pub use codebook::codebook;
pub use palette::{Palette, palette};
