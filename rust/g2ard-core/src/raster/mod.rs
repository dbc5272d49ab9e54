//! The tiled differentiable rasteriser: one file per pass.
//!
//! [`project`] turns 16 Gaussians at a time into screen splats, and [`tile_lists`] lists the 16×16 tiles that each one's
//! ellipse at α = 1/255 meets; [`depth_sort`] sorts them by depth once; [`bins`] scatters them stably into their tiles;
//! [`tile_batch`] holds a tile's pairs in the tile's coordinates; [`forward`] blends each tile, 4×4 or 4×2 pixels to a register; [`backward`] walks the same pairs from back to front, each pair summing into its own slot; [`gradients`]
//! adds a Gaussian's slots in order and goes back through the projection. No atomics: the bits do not depend on threads.
//!
//! Conventions (gsplat's by default): pixel centres at +0.5; 0.3 px² dilation; α = min(0.99, opacity·exp(−q)); α < 1/255
//! is skipped; a pixel stops before its transmittance would fall to 1e-4; colour = max(0, 0.5 + SH).

pub(crate) mod accumulate;
pub(crate) mod backward;
mod bins;
mod blocks;
pub(crate) mod bounds;
pub(crate) mod depth_sort;
pub(crate) mod disjoint;
pub(crate) mod find_bounds;
mod forward;
pub(crate) mod frustum;
pub(crate) mod gradients;
pub(crate) mod grid;
pub(crate) mod memory;
pub(crate) mod params;
pub(crate) mod project;
pub(crate) mod rasterizer;
mod region;
mod sh;
pub mod simd;
#[cfg(test)]
pub(crate) mod small;
mod tile_batch;
mod tile_lists;
pub mod visibility;

pub use accumulate::Accumulated;
pub use bounds::Bounds;
pub use gradients::Gradients;
pub use params::Params;
pub use rasterizer::{Canvas, Image, ImageGradients, Rasterizer};
pub use region::{Region, light_on, reaching};
pub use simd::Isa;

use crate::Result;
use crate::scene::limits::MAX_OPACITY;

/// Pixels on a tile's side.
pub const TILE: usize = 16;
/// Sixteen-lane rows that hold a value for every pixel of a tile: 4×4 pixels each.
pub(crate) const ROWS: usize = 16;
/// Pairs of a tile that are processed together: a bit each in a block's mask.
pub(crate) const BATCH: usize = 64;
/// Below this a Gaussian does not touch a pixel.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// Added to both variances of the projected covariance, px².
pub const DILATION: f32 = 0.3;

/// One pinhole view, OpenCV axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// camera_from_world, the upper three rows; rigid.
    pub viewmat: [[f64; 4]; 3],
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
    pub width: usize,
    pub height: usize,
    /// Gaussians nearer than this are culled. gsplat: 0.01; INRIA: 0.2.
    pub near: f32,
}

impl Camera {
    pub fn validate(&self) -> Result<()> {
        let pose = self.viewmat.iter().flatten();
        let all = pose.chain([&self.fx, &self.fy, &self.cx, &self.cy]);
        refuse!(!all.into_iter().all(|v| v.is_finite()) => "camera", "finite pose and intrinsics", "NaN or infinity");
        refuse!(self.fx <= 0.0 || self.fy <= 0.0 =>
            "camera", "positive focal lengths", format!("{} {}", self.fx, self.fy));
        let most = 1 << 15;
        refuse!(self.width == 0 || self.height == 0 || self.width > most || self.height > most =>
            "camera", format!("an image of 1 to {most} pixels a side"), format!("{}×{}", self.width, self.height));
        refuse!(self.near.is_nan() || self.near <= 0.0 => "near", "a positive distance", self.near);
        Ok(())
    }

    /// The camera's centre in the world.
    pub fn position(&self) -> [f64; 3] {
        let v = &self.viewmat;
        [0, 1, 2].map(|j| -(v[0][j] * v[0][3] + v[1][j] * v[1][3] + v[2][j] * v[2][3]))
    }

    /// A point of the world in the camera's axes.
    pub(crate) fn in_camera(&self, p: [f64; 3]) -> [f64; 3] {
        self.viewmat
            .map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3])
    }

    /// The size of a pixel at a depth, scene units; it grows with the depth.
    #[inline]
    pub(crate) fn pixel_size(&self, depth: f64) -> f32 {
        (depth / self.fx.max(self.fy)) as f32
    }

    /// Lowers `size` to that of a pixel at a point, depth / focal length in scene units, if the image contains the point.
    #[inline]
    pub(crate) fn lower_pixel_size(&self, point: [f64; 3], size: &mut f32) {
        let p = self.in_camera(point);
        let here = self.pixel_size(p[2]);
        // Most points are already smaller in an earlier view: that is one division instead of three.
        if !(p[2] >= f64::from(self.near) && here < *size) {
            return;
        }
        let x = self.fx * p[0] / p[2] + self.cx;
        let y = self.fy * p[1] / p[2] + self.cy;
        let (width, height) = (self.width as f64, self.height as f64);
        if (0.0..=width).contains(&x) && (0.0..=height).contains(&y) {
            *size = here;
        }
    }
}

/// The rasteriser to agree with where conventions differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Convention {
    #[default]
    Gsplat,
    /// Also limits each splat to the tiles that its 3σ square meets, and the antialiasing factor to at least √2.5e-5.
    Inria,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    pub convention: Convention,
    /// Opacity × √(det Σ₂ / det(Σ₂ + 0.3 I)): splats under a pixel fade instead of growing.
    pub antialiased: bool,
    /// α is clipped here; 0.99 (3DGS, gsplat) or 0.999 (older gsplat).
    pub alpha_max: f32,
    /// A pixel stops before its transmittance would fall to this.
    pub transmittance_min: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            convention: Convention::Gsplat,
            antialiased: false,
            alpha_max: MAX_OPACITY as f32,
            transmittance_min: 1e-4,
        }
    }
}

impl Settings {
    pub fn validate(&self) -> Result<()> {
        refuse!(!(ALPHA_MIN..1.0).contains(&self.alpha_max) => "alpha_max", "a value in [1/255, 1)", self.alpha_max);
        refuse!(!(1e-12..1.0).contains(&self.transmittance_min) =>
            "transmittance_min", "a value in [1e-12, 1)", self.transmittance_min);
        Ok(())
    }
}
