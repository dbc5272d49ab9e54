//! A camera as kernels are handed it.

use std::ops::Range;

use g2ard_core::raster::Camera;
use g2ard_core::select::Pinhole;

use super::FAR;
use crate::runtime::{Error, Result};

/// Spans of pixels are 16 bits.
const MAX_SIDE: usize = u16::MAX as usize;

/// A camera whose image kernels can draw.
pub fn of(camera: &Camera) -> Result<Pinhole> {
    let view = Pinhole::of(camera);
    let side = view.width.max(view.height);
    if side > MAX_SIDE {
        return Err(Error::TooMany {
            what: "pixels along a side of a view",
            count: side as u64,
            limit: MAX_SIDE as u64,
        });
    }
    Ok(view)
}

/// `View` of pinhole.wgsl.
pub struct Constants<'a> {
    pub view: &'a Pinhole,
    /// Rows, cells or splats there are.
    pub count: usize,
    /// The first of them among all.
    pub first: usize,
    /// The range of depths, as bits; or of pairs of splat and tile.
    pub range: Range<u32>,
    /// Edge of a cell.
    pub cell: f32,
    /// Share of its depth that a cell may lie off the depths.
    pub tolerance: f32,
}

impl<'a> Constants<'a> {
    pub fn new(view: &'a Pinhole, count: usize) -> Self {
        Self {
            view,
            count,
            first: 0,
            range: 0..FAR,
            cell: 0.0,
            tolerance: 0.0,
        }
    }

    pub fn words(&self) -> Vec<u32> {
        let v = self.view;
        let mut numbers = Vec::with_capacity(32);
        for (row, shift) in v.rotation.iter().zip(v.translation) {
            numbers.extend(row);
            numbers.push(shift);
        }
        numbers.extend(v.focal);
        numbers.extend(v.center);
        numbers.extend(v.limits.as_flattened());
        let mut words: Vec<u32> = numbers.into_iter().map(f32::to_bits).collect();
        words.extend([v.width as u32, v.height as u32, v.near.to_bits()]);
        words.extend([self.count as u32, self.first as u32]);
        words.extend([self.range.start, self.range.end, self.cell.to_bits()]);
        words.extend([self.tolerance.to_bits(), 0, 0, 0]); // a uniform's size is a multiple of four words
        words
    }
}
