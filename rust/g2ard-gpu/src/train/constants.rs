//! Constants of a step in the layout that kernels read.

use bytemuck::{Pod, Zeroable};
use g2ard_core::raster::{Camera, Settings};
use g2ard_core::select::Pinhole;
use g2ard_core::train::{LEAST_LOSS, StepInput};

use super::scene::Values;

/// `Step` of step.wgsl.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Step {
    rotation: [[f32; 4]; 3],
    rotation_rest: [[f32; 4]; 3],
    eye: [f32; 4],
    eye_rest: [f32; 4],
    focal: [f32; 4],
    center: [f32; 4],
    limits: [[f32; 2]; 2],
    background: [f32; 4],
    /// Of the image.
    pub size: [u32; 2],
    near: f32,
    alpha_max: f32,
    light_min: f32,
    antialiased: u32,
    rows: u32,
    coeffs: u32,
    pub capacity: u32,
    /// Pairs of a tile that can be drawn.
    pub most_in_tile: u32,
    masked: u32,
    values: f32,
    ssim_weight: f32,
    relative: f32,
    least_loss: f32,
    /// Hides results from the compiler.
    zero: u32,
    rates: [f32; 6],
    reach: f32,
    finest: f32,
    anchor: f32,
    thickness: f32,
    rank: f32,
    rank_offset: f32,
    momentum: f32,
    /// To a multiple of sixteen bytes.
    unused: [u32; 3],
}

/// A number as two f32, and what the first lacks.
fn split<const N: usize>(values: [f64; N]) -> [[f32; N]; 2] {
    [
        values.map(|v| v as f32),
        values.map(|v| (v - f64::from(v as f32)) as f32),
    ]
}

impl Step {
    /// Constants of an image of a scene; room for pairs is set later.
    pub fn image(
        camera: &Camera,
        settings: &Settings,
        [red, green, blue]: [f32; 3],
        values: &Values,
    ) -> Self {
        let rotation = camera.viewmat.map(split);
        let [x, y, z] = camera.position();
        let [eye, eye_rest] = split([x, y, z, 0.0]);
        let [focal, focal_rest] = split([camera.fx, camera.fy]);
        let [center, center_rest] = split([camera.cx, camera.cy]);
        let both = |[a, b]: [f32; 2], [c, d]: [f32; 2]| [a, b, c, d];
        Self {
            rotation: rotation.map(|[high, _]| high),
            rotation_rest: rotation.map(|[_, rest]| rest),
            eye,
            eye_rest,
            focal: both(focal, focal_rest),
            center: both(center, center_rest),
            limits: Pinhole::of(camera).limits,
            background: [red, green, blue, 0.0],
            size: [camera.width as u32, camera.height as u32],
            near: camera.near,
            alpha_max: settings.alpha_max,
            light_min: settings.transmittance_min,
            antialiased: settings.antialiased.into(),
            rows: values.rows as u32,
            coeffs: values.coeffs as u32,
            ..Self::zeroed()
        }
    }

    /// Constants of a step; room for pairs is set later.
    pub fn of(input: &StepInput, values: &Values) -> Self {
        let (camera, rates, rows) = (input.camera, &input.rates, values.rows as f32);
        let pixels = camera.width * camera.height;
        let counted = |mask: &[bool]| mask.iter().filter(|counts| **counts).count();
        let weights = input.regularizers.unwrap_or_default();
        let shape = weights.shape / rows;
        Self {
            masked: input.mask.is_some().into(),
            values: 3.0 * input.mask.map_or(pixels, counted).max(1) as f32,
            ssim_weight: input.ssim_weight,
            relative: input.relative.unwrap_or(0.0),
            least_loss: LEAST_LOSS,
            rates: [
                rates.means,
                rates.quats,
                rates.log_scales,
                rates.logit_opacities,
                rates.sh0,
                rates.sh_n,
            ],
            reach: input.reach.unwrap_or(0.0),
            finest: input.finest,
            anchor: weights.anchor.max(0.0) / rows,
            thickness: (shape * weights.thickness).max(0.0),
            rank: if weights.effective_rank {
                shape.max(0.0)
            } else {
                0.0
            },
            rank_offset: weights.rank_offset,
            momentum: rates.momentum,
            ..Self::image(camera, &input.settings, input.background, values)
        }
    }

    pub fn words(&self) -> &[u32] {
        bytemuck::cast_slice(std::slice::from_ref(self))
    }
}
