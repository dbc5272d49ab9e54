//! A camera in the layout that kernels read.

use bytemuck::{Pod, Zeroable};
use g2ard_core::raster::{Camera, Settings};
use g2ard_core::select::Pinhole;

use crate::runtime::{Error, Result};

/// Pixel spans have 16 bits.
const MAX_SIDE: usize = u16::MAX as usize;

/// `View` of pinhole.wgsl. Fields from `count` to `tolerance` change per kernel and are 0 at first.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct View {
    pub rotation: [[f32; 4]; 3],
    pub eye: [f32; 4],
    pub focal: [f32; 2],
    pub center: [f32; 2],
    pub limits: [[f32; 2]; 2],
    pub size: [u32; 2],
    pub near: f32,
    /// Number of rows, cells or splats.
    pub count: u32,
    /// The first pair of splat and tile, the number of pairs from there, and the total.
    pub first: u32,
    pub pairs: u32,
    pub all_pairs: u32,
    /// Edge of a cell, and its depth tolerance as a share of its depth.
    pub cell: f32,
    pub tolerance: f32,
    /// Upper limit of α; the transmittance at which a pixel ends.
    pub alpha_max: f32,
    pub light_min: f32,
    /// Hides results from the compiler.
    pub zero: u32,
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
        let pinhole = Pinhole::of(camera);
        let eye = camera.position();
        let lost = eye.map(|v| (v - f64::from(v as f32)) as f32);
        let row = |k: usize| {
            let [x, y, z] = pinhole.rotation[k];
            [x, y, z, lost[k]]
        };
        let [x, y, z] = eye.map(|v| v as f32);
        Ok(Self {
            rotation: [row(0), row(1), row(2)],
            eye: [x, y, z, 0.0],
            focal: pinhole.focal,
            center: pinhole.center,
            limits: pinhole.limits,
            size: [camera.width as u32, camera.height as u32],
            near: pinhole.near,
            alpha_max: settings.alpha_max,
            light_min: settings.transmittance_min,
            ..Self::zeroed()
        })
    }

    /// This view for a kernel over `count` rows, cells or splats.
    pub fn over(self, count: usize) -> Self {
        let count = count as u32;
        Self { count, ..self }
    }

    pub fn words(&self) -> &[u32] {
        bytemuck::cast_slice(std::slice::from_ref(self))
    }

    pub fn pixels(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    pub fn tiles(&self, side: usize) -> usize {
        (self.size[0] as usize).div_ceil(side) * (self.size[1] as usize).div_ceil(side)
    }
}
