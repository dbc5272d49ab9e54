//! Drawing one box of a scene behind what is drawn already: see [`crate::raster::region`].

use rayon::prelude::*;

use super::Rasterizer;
use super::tiled::MOST_TILES;
use crate::raster::bins::Pair;
use crate::raster::disjoint::DisjointSlice;
use crate::raster::forward::{Forward, Pixels};
use crate::raster::grid::{TileGrid, TileRect};
use crate::raster::params::Params;
use crate::raster::project::Splat;
use crate::raster::region::{DepthRanges, Rays, Region};
use crate::raster::simd::{LANES, Lanes16, dispatch};
use crate::raster::tile_batch::TileBatch;
use crate::raster::{BATCH, Camera, ROWS, Settings};
use crate::{Error, Result};

/// A view's image so far, without a background: the boxes in front are drawn. Row-major.
#[derive(Debug)]
pub struct Canvas<'a> {
    /// Σ αT·c, interleaved.
    pub rgb: &'a mut [f32],
    /// The light that is left, negated where the pixel has stopped.
    pub light: &'a mut [f32],
}

impl Canvas<'_> {
    fn validate(&self, camera: &Camera) -> Result<()> {
        let pixels = camera.width * camera.height;
        for (name, got, expected) in [
            ("color", self.rgb.len(), 3 * pixels),
            ("light", self.light.len(), pixels),
        ] {
            Error::unless_equal(name, got, expected, "values")?;
        }
        Ok(())
    }
}

/// The planes of a canvas while threads draw, each its own tiles.
struct Planes<'a> {
    rgb: DisjointSlice<'a, f32>,
    light: DisjointSlice<'a, f32>,
}

/// A tile's state between its memory and its image.
#[derive(Default)]
struct Scratch {
    tile_batch: TileBatch,
    pixels: Pixels,
    light: [Lanes16; ROWS],
    transmittance: [Lanes16; ROWS],
    last: [Lanes16; ROWS],
}

impl Rasterizer {
    /// Draws a box of a scene, or what no box bounds, behind what the canvas shows. `params` has at least the Gaussians
    /// that [`crate::raster::reaching`] names. No backward pass follows.
    pub fn draw(
        &mut self,
        params: &Params,
        camera: &Camera,
        settings: &Settings,
        region: &Region,
        canvas: &mut Canvas,
    ) -> Result<()> {
        params.validate()?;
        camera.validate()?;
        settings.validate()?;
        region.validate()?;
        canvas.validate(camera)?;
        self.prepare(*params, camera, settings, [0.0; 3], TileGrid::of(camera))?;
        self.draw_tiles(region, canvas);
        self.state = None; // no state that a backward pass could use
        Ok(())
    }

    fn draw_tiles(&mut self, region: &Region, canvas: &mut Canvas) {
        let Some(state) = &self.state else { return };
        let (camera, grid, isa) = (&state.camera, state.grid, self.isa);
        let (bins, splats) = (&self.bins, &self.splats);
        let rays = Rays::of(camera);
        let planes = Planes {
            rgb: DisjointSlice::new(canvas.rgb),
            light: DisjointSlice::new(canvas.light),
        };
        let block_masks = DisjointSlice::new(&mut self.block_masks);
        let tiles = self.batches.par_iter().enumerate();
        tiles
            .with_max_len(MOST_TILES)
            .for_each_init(Scratch::default, |scratch, (tile, batch)| {
                let rect = grid.rect(tile, camera);
                let Some((pairs, ranges)) =
                    pairs_within(bins.pairs_of(tile), splats, region, &rays, &rect)
                else {
                    return;
                };
                // SAFETY: every tile has its own pixels.
                unsafe { scratch.load(&planes, camera.width, &rect) };
                let forward = Forward::<_, false> {
                    pairs,
                    splats,
                    rect,
                    settings: &state.settings,
                    // SAFETY: every tile has its own batches, and `pairs` are no more than all of its pairs.
                    block_masks: unsafe { block_masks.slice(batch.0, pairs.len().div_ceil(BATCH)) },
                    light: &mut scratch.light,
                    transmittance: &mut scratch.transmittance,
                    last: &mut scratch.last,
                    pixels: &mut scratch.pixels,
                    tile_batch: &mut scratch.tile_batch,
                    within: &ranges,
                };
                dispatch(isa, forward);
                scratch.mark_stopped(state.settings.transmittance_min);
                // SAFETY: as above.
                unsafe { scratch.store(&planes, camera.width, &rect) };
            });
    }
}

/// A tile's pairs that may lie within a box, and the box's depths at its pixels; None without pairs.
fn pairs_within<'a>(
    pairs: &'a [Pair],
    splats: &[Splat],
    region: &Region,
    rays: &Rays,
    rect: &TileRect,
) -> Option<(&'a [Pair], DepthRanges)> {
    if pairs.is_empty() {
        return None;
    }
    let ranges = DepthRanges::of(region, rays, rect);
    let depth = |pair: &Pair| splats[pair.splat as usize].depth;
    let first = pairs.partition_point(|pair| depth(pair) < ranges.least);
    let count = pairs[first..].partition_point(|pair| depth(pair) < ranges.most);
    (count > 0).then(|| (&pairs[first..first + count], ranges))
}

/// Calls `visit(pixel of the image, row of lanes, lane)` for every pixel of a tile.
fn for_pixels(width: usize, rect: &TileRect, mut visit: impl FnMut(usize, usize, usize)) {
    for y in 0..rect.rows {
        let first = (rect.y + y) * width + rect.x;
        for x in 0..rect.columns {
            visit(first + x, y / 4 * 4 + x / 4, y % 4 * 4 + x % 4);
        }
    }
}

/// Copies a tile of the light into lanes; off the image it is 0.
///
/// # Safety
/// No other thread touches the tile meanwhile.
unsafe fn load_light(plane: DisjointSlice<f32>, width: usize, rect: &TileRect) -> [Lanes16; ROWS] {
    let mut light = [Lanes16::default(); ROWS];
    for_pixels(width, rect, |pixel, row, lane| {
        // SAFETY: the caller's promise; a tile's pixels lie in the image.
        light[row].0[lane] = unsafe { *plane.at(pixel) };
    });
    light
}

/// Copies light from lanes into its tile.
///
/// # Safety
/// As for [`load_light`].
unsafe fn store_light(
    light: &[Lanes16; ROWS],
    plane: DisjointSlice<f32>,
    width: usize,
    rect: &TileRect,
) {
    for_pixels(width, rect, |pixel, row, lane| {
        // SAFETY: the caller's promise; a tile's pixels lie in the image.
        unsafe { plane.write(pixel, light[row].0[lane]) };
    });
}

impl Scratch {
    /// # Safety
    /// As for [`load_light`].
    unsafe fn load(&mut self, planes: &Planes, width: usize, rect: &TileRect) {
        self.last = [Lanes16([-1.0; LANES]); ROWS];
        self.pixels = Pixels::default();
        // SAFETY: the caller's promise; a tile's pixels lie in the image.
        unsafe {
            self.light = load_light(planes.light, width, rect);
            for_pixels(width, rect, |pixel, row, lane| {
                for c in 0..3 {
                    self.pixels.rgb[c][row].0[lane] = *planes.rgb.at(3 * pixel + c);
                }
            });
        }
        self.transmittance = self.light.map(|row| Lanes16(row.0.map(f32::abs)));
    }

    /// Turns the light that would be left into what is, negated where the pixel has stopped.
    fn mark_stopped(&mut self, minimum: f32) {
        for (light, left) in self.light.iter_mut().zip(&self.transmittance) {
            for (light, left) in light.0.iter_mut().zip(left.0) {
                *light = if *light > minimum { left } else { -left };
            }
        }
    }

    /// # Safety
    /// As for [`load_light`].
    unsafe fn store(&self, planes: &Planes, width: usize, rect: &TileRect) {
        // SAFETY: the caller's promise; a tile's pixels lie in the image.
        unsafe {
            store_light(&self.light, planes.light, width, rect);
            for_pixels(width, rect, |pixel, row, lane| {
                for c in 0..3 {
                    planes
                        .rgb
                        .write(3 * pixel + c, self.pixels.rgb[c][row].0[lane]);
                }
            });
        }
    }
}
