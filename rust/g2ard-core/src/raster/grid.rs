//! The tiles of an image, or of some of its rows of tiles.

use std::ops::Range;

use super::tile_batch::TileRect;
use super::{Camera, TILE};

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
