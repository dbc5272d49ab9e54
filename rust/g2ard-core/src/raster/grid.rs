//! The tiles of an image, or of some of its rows of tiles.

use std::ops::Range;

use super::simd::{LANES, Lanes16};
use super::{Camera, ROWS, TILE};

/// Whole rows of an image's tiles, numbered row by row from the first of them.
#[derive(Debug, Clone, Copy)]
pub struct TileGrid {
    /// Tiles in a row.
    pub columns: usize,
    /// The image's row of tiles that comes first here.
    pub first_row: usize,
    pub rows: usize,
}

impl TileGrid {
    /// All tiles of an image.
    pub fn of(camera: &Camera) -> Self {
        Self {
            columns: camera.width.div_ceil(TILE),
            first_row: 0,
            rows: camera.height.div_ceil(TILE),
        }
    }

    /// Only the rows of tiles in `rows`, counted in the image.
    pub fn with_rows(self, rows: Range<usize>) -> Self {
        Self {
            first_row: rows.start,
            rows: rows.len(),
            ..self
        }
    }

    pub fn tiles(&self) -> usize {
        self.columns * self.rows
    }

    /// Whether every tile's number fits a u16.
    pub fn narrow(&self) -> bool {
        self.tiles() <= 1 << 16
    }

    /// The position of a tile in the image.
    pub fn rect(&self, tile: usize, camera: &Camera) -> TileRect {
        let tile = tile + self.first_row * self.columns;
        TileRect::of(tile, self.columns, camera.width, camera.height)
    }
}

/// A tile's rect in the image.
#[derive(Debug, Clone, Copy)]
pub struct TileRect {
    /// Its first pixel.
    pub x: usize,
    pub y: usize,
    /// Number of its 16 columns and rows that are on the image.
    pub columns: usize,
    pub rows: usize,
}

impl TileRect {
    pub fn of(tile: usize, tiles_x: usize, width: usize, height: usize) -> Self {
        let (x, y) = (tile % tiles_x * TILE, tile / tiles_x * TILE);
        Self {
            x,
            y,
            columns: (width - x).min(TILE),
            rows: (height - y).min(TILE),
        }
    }

    /// The light of every row's pixels before the first splat: 1, but 0 off the image.
    pub fn light(&self) -> [Lanes16; ROWS] {
        if self.columns == TILE && self.rows == TILE {
            return [Lanes16([1.0; LANES]); ROWS];
        }
        let mut light = [Lanes16::default(); ROWS];
        for (row, light) in light.iter_mut().enumerate() {
            for (l, light) in light.0.iter_mut().enumerate() {
                let (x, y) = pixel_of(row, l);
                *light = f32::from(x < self.columns && y < self.rows);
            }
        }
        light
    }
}

/// The pixel of a row's lane, relative to the tile.
#[inline(always)]
pub const fn pixel_of(row: usize, lane: usize) -> (usize, usize) {
    (row % 4 * 4 + lane % 4, row / 4 * 4 + lane / 4)
}
