//! A camera in the layout that kernels read.

use g2ard_core::raster::{Camera, Settings};
use g2ard_core::select::Pinhole;

use crate::runtime::{Error, Result};

/// Pixel spans have 16 bits.
const MAX_SIDE: usize = u16::MAX as usize;

/// `View` of pinhole.wgsl, except for the fields that change per kernel.
pub struct View {
    pinhole: Pinhole,
    eye: [f64; 3],
    /// Upper limit of α; the transmittance at which a pixel ends.
    alpha_max: f32,
    light_min: f32,
}

impl View {
    /// A camera whose image kernels can draw.
    pub fn of(camera: &Camera, settings: &Settings) -> Result<Self> {
        let side = camera.width.max(camera.height);
        if side > MAX_SIDE {
            return Err(Error::TooMany {
                what: "pixels along a side of a view",
                count: side as u64,
                limit: MAX_SIDE as u64,
            });
        }
        Ok(Self {
            pinhole: Pinhole::of(camera),
            eye: camera.position(),
            alpha_max: settings.alpha_max,
            light_min: settings.transmittance_min,
        })
    }

    pub fn pixels(&self) -> usize {
        self.pinhole.width * self.pinhole.height
    }

    pub fn tiles(&self, side: usize) -> usize {
        self.pinhole.width.div_ceil(side) * self.pinhole.height.div_ceil(side)
    }
}

/// Fields of a view that change per kernel.
#[derive(Default, Clone, Copy)]
pub struct Constants {
    /// Number of rows, cells or splats.
    pub count: usize,
    /// The first pair of splat and tile, the number of pairs from there, and the total.
    pub first: usize,
    pub pairs: usize,
    pub all_pairs: usize,
    /// Edge of a cell, and its depth tolerance as a share of its depth.
    pub cell: f32,
    pub tolerance: f32,
}

impl Constants {
    pub fn of(count: usize) -> Self {
        Self {
            count,
            ..Self::default()
        }
    }

    pub fn words(&self, view: &View) -> Vec<u32> {
        let v = &view.pinhole;
        let mut numbers = Vec::with_capacity(36);
        for (row, eye) in v.rotation.iter().zip(view.eye) {
            numbers.extend(row);
            numbers.push((eye - f64::from(eye as f32)) as f32);
        }
        numbers.extend(view.eye.map(|v| v as f32));
        numbers.push(0.0);
        numbers.extend(v.focal);
        numbers.extend(v.center);
        numbers.extend(v.limits.as_flattened());
        let mut words: Vec<u32> = numbers.into_iter().map(f32::to_bits).collect();
        words.extend([v.width as u32, v.height as u32, v.near.to_bits()]);
        let counts = [self.count, self.first, self.pairs, self.all_pairs];
        words.extend(counts.map(|n| n as u32));
        let limits = [self.cell, self.tolerance, view.alpha_max, view.light_min];
        words.extend(limits.map(f32::to_bits));
        words.push(0); // a uniform's size is a multiple of four words
        words
    }
}
