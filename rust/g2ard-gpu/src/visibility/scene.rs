//! Gaussians on the device, for all views.

use g2ard_core::linalg::rotation_from_quat;
use g2ard_core::raster::ALPHA_MIN;
use g2ard_core::raster::visibility::VisibilityAccumulator;
use g2ard_core::select::Gaussians;
use g2ard_core::spatial::{RobustBounds, codes, order};
use rayon::prelude::*;

use crate::runtime::{Buffer, Gpu, Result};

/// Words of a row.
const ROW: usize = 13;

pub struct Scene {
    pub count: usize,
    pub rows: Buffer,
}

impl Scene {
    /// Gaussians that may hide something, in Morton order, as in `g2ard_core::select::Occluders`.
    pub fn of_gaussians(gpu: &Gpu, scene: &Gaussians<'_>) -> Result<Self> {
        let order = order(&codes(scene.means, &RobustBounds::of(scene.means)));
        let rows: Vec<_> = order
            .into_par_iter()
            .map(|i| i as usize)
            .filter(|&i| scene.opacities[i] >= ALPHA_MIN)
            .map(|i| {
                let mean = scene.means[i].map(|v| v as f32);
                row(mean, scene.opacities[i], scene.quats[i], scene.scales[i])
            })
            .collect();
        Self::upload(gpu, &rows)
    }

    /// All rows of a scene, in its order.
    pub fn of_sums(gpu: &Gpu, sums: &VisibilityAccumulator) -> Result<Self> {
        let rows: Vec<_> = (0..sums.len())
            .into_par_iter()
            .map(|i| {
                let [x, y, z, p, q, r, s, u, v, w, logit] = sums.row(i);
                let opacity = 1.0 / (1.0 + (-f64::from(logit)).exp());
                row([x, y, z], opacity as f32, [p, q, r, s], [u, v, w])
            })
            .collect();
        Self::upload(gpu, &rows)
    }

    fn upload(gpu: &Gpu, rows: &[[f32; ROW]]) -> Result<Self> {
        Ok(Self {
            count: rows.len(),
            rows: gpu.upload("rows", rows)?,
        })
    }
}

/// `Row` of mark.wgsl.
fn row(mean: [f32; 3], opacity: f32, quat: [f32; 4], scales: [f32; 3]) -> [f32; ROW] {
    let r = rotation_from_quat(quat.map(f64::from));
    let [x, y, z] = mean;
    let axis = |k: usize| [0, 1, 2].map(|i: usize| (r[i][k] * f64::from(scales[k])) as f32);
    let [[a, b, c], [d, e, f], [g, h, i]] = [axis(0), axis(1), axis(2)];
    [x, y, z, opacity, a, b, c, d, e, f, g, h, i]
}
