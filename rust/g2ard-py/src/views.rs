//! Cameras and the rasteriser's options, as Python holds them.

use g2ard_core::raster::{Camera, Convention, Region, Settings};
use pyo3::prelude::*;

use crate::error::invalid;

/// `(viewmat 4×4, (fx, fy, cx, cy), (width, height), near)`.
#[derive(FromPyObject)]
pub struct View([[f64; 4]; 4], [f64; 4], (usize, usize), f32);

impl View {
    pub fn camera(&self) -> Camera {
        let [fx, fy, cx, cy] = self.1;
        let (width, height) = self.2;
        Camera {
            viewmat: [self.0[0], self.0[1], self.0[2]],
            fx,
            fy,
            cx,
            cy,
            width,
            height,
            near: self.3,
        }
    }
}

/// Low and high corner of a box, (2, 3).
#[derive(FromPyObject)]
pub struct Corners([f64; 3], [f64; 3]);

impl From<Corners> for Region {
    fn from(Corners(low, high): Corners) -> Self {
        Self { low, high }
    }
}

/// The attributes of a `g2ard.rendering.renderer.RasterSettings` that do not depend on the view.
#[derive(FromPyObject)]
pub struct RasterOptions {
    convention: String,
    antialiased: bool,
    alpha_max: f32,
}

impl RasterOptions {
    pub fn settings(&self) -> PyResult<Settings> {
        let convention = match self.convention.as_str() {
            "gsplat" => Convention::Gsplat,
            "inria" => Convention::Inria,
            other => return Err(invalid("convention", "gsplat or inria", other)),
        };
        Ok(Settings {
            convention,
            antialiased: self.antialiased,
            alpha_max: self.alpha_max,
            ..Settings::default()
        })
    }
}
