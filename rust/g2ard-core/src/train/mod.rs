//! The fused trainer: forward, loss, backward and Adam of one view without leaving Rust.
//!
//! It is an optimisation of rasterize + l1_ssim + torch's Adam with the same result to rounding, but that Gaussians no
//! pixel of the view touched are left alone (sparse Adam): each has its own count of steps for the bias terms.
//! Rows whose bounds a view cannot see are not even projected.
//! Parameters and moments lie in blocks of sixteen Gaussians, attribute by attribute, in Morton order of the means, so
//! every pass reads whole registers and neighbours in space are neighbours in memory.

mod adam;
mod anchors;
mod row_major;
mod store;
#[cfg(test)]
mod tests;

pub use adam::{BETA2, Biases, EPSILON, GRADIENT_MAX};
pub use anchors::{Anchors, Regularizers, anchor_rows};
pub use row_major::{Attribute, step_rows};
pub use store::{Exported, Part, Store};

use rayon::prelude::*;

use crate::raster::rasterizer::ChunkSums;
use crate::raster::simd::{LANES, dispatch};
use crate::raster::{Camera, Image, ImageGradients, Isa, Params, Rasterizer, Settings};
use crate::ssim::{Loss, Mask, Shape};
use crate::{Cpu, Error, Result};
use adam::Update;

/// Smaller losses, about 40 dB, are hardly visible.
pub const LEAST_LOSS: f32 = 0.005;

/// Adam's learning rate of each attribute, and its β₁.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Rates {
    /// Times each Gaussian's own unit, if the trainer was given units.
    pub means: f32,
    pub quats: f32,
    pub log_scales: f32,
    pub logit_opacities: f32,
    pub sh0: f32,
    pub sh_n: f32,
    /// Share of the mean gradient that a step keeps, β₁.
    pub momentum: f32,
}

/// Inputs of one step: a view, its target, and the rates.
#[derive(Debug, Clone, Copy)]
pub struct StepInput<'a> {
    pub camera: &'a Camera,
    pub settings: Settings,
    pub background: [f32; 3],
    /// height × width × 3.
    pub target: &'a [f32],
    /// height × width: where the loss counts; `None` means everywhere.
    pub mask: Option<&'a [bool]>,
    /// Number of the view if its target and mask are the same in all steps, so that a device may keep them.
    pub view: Option<u32>,
    /// λ of (1 − λ)·L1 + λ·(1 − SSIM).
    pub ssim_weight: f32,
    /// Times the gradient of the loss's logarithm: all views then count alike, whatever their loss. `None` takes the
    /// gradient of the loss.
    pub relative: Option<f32>,
    pub rates: Rates,
    /// c, a size in pixels: rates of Gaussians that are larger in this view are multiplied by 1/(1 + (σ/c)¹⁶). For
    /// means and rotations σ is the Gaussian's longer side, for each scale its own axis. `None` leaves all rates
    /// unchanged.
    pub reach: Option<f32>,
    /// A size in pixels, c: the same rates are multiplied by σ²/(σ² + c²), because a view determines no shape below its
    /// sampling limit. 0 leaves them unchanged.
    pub finest: f32,
    /// Added to the loss of this step; needs anchors.
    pub regularizers: Option<Regularizers>,
}

impl StepInput<'_> {
    /// Check the view, the target's size and the options; `anchored`: whether anchors were set.
    pub fn validate(&self, anchored: bool) -> Result<()> {
        self.camera.validate()?;
        self.settings.validate()?;
        let shape = self.shape();
        Error::unless_equal("target", self.target.len(), shape.values(), "values")?;
        if let Some(reach) = self.reach {
            refuse!(!(reach > 0.0 && reach.is_finite()) => "reach", "pixels, more than 0", reach);
        }
        refuse!(!(self.finest >= 0.0 && self.finest.is_finite()) => "finest", "pixels, at least 0", self.finest);
        let momentum = self.rates.momentum;
        refuse!(!(0.0..1.0).contains(&momentum) => "momentum", "a share below 1", momentum);
        refuse!(self.regularizers.is_some() && !anchored => "regularizers", "anchors set before", "none");
        let pixels = shape.height * shape.width;
        let counts = self.mask.map_or(pixels, <[bool]>::len);
        Error::unless_equal("mask", counts, pixels, "values")
    }

    fn shape(&self) -> Shape {
        Shape {
            height: self.camera.height,
            width: self.camera.width,
            channels: 3,
        }
    }
}

/// The outcome of a step.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Report {
    /// The photometric loss before the step.
    pub loss: f64,
    /// Gaussians that moved.
    pub updated: usize,
    /// Gaussians left alone because a gradient was not finite.
    pub skipped: usize,
}

/// A trainer on the processor or on another device. Rows are numbered as the caller numbers them.
pub trait Train: Send + Sync {
    /// One step; with [`Error::Device`] it must go on elsewhere, from its last export.
    fn step(&mut self, input: &StepInput) -> Result<Report>;

    /// Parameters in the layout of [`Exported::values`].
    fn values(&self) -> Result<Vec<f32>>;

    /// The attributes between each two of these numbers, row-major: [`Train::values`] in parts.
    fn columns(&self, starts: &[usize]) -> Result<Vec<Vec<f32>>> {
        let values = self.values()?;
        let width = starts.last().copied().unwrap_or(1);
        let part = |at: &[usize]| {
            let rows = values.chunks_exact(width);
            rows.flat_map(|row| &row[at[0]..at[1]]).copied().collect()
        };
        Ok(starts.windows(2).map(part).collect())
    }

    /// How many steps each row has taken.
    fn steps(&self) -> Result<Vec<u32>> {
        Ok(self.export()?.steps)
    }

    /// Everything that [`Train::import`] needs.
    fn export(&self) -> Result<Exported>;

    /// At least one part of it, so that a checkpoint need not hold both moments at once.
    fn export_part(&self, _part: Part) -> Result<Exported> {
        self.export()
    }

    /// Restore an earlier export; training then continues bit for bit, except on another device.
    fn import(&mut self, state: &Exported) -> Result<()>;

    /// Rows that no step changes.
    fn freeze(&mut self, frozen: &[bool]) -> Result<()>;

    /// Set the surface that [`StepInput::regularizers`] pull the Gaussians to: means 3 values each, frames 9, radii 1.
    fn set_anchors(
        &mut self,
        means: &[f32],
        frames: &[f32],
        r_parallel: &[f32],
        r_perp: &[f32],
    ) -> Result<()>;
}

/// Makes trainers on a device.
pub trait TrainKernels {
    /// `units`: factor of each Gaussian's rate of the mean; `None` means 1.
    fn trainer(&self, params: &Params, units: Option<&[f32]>) -> Result<Box<dyn Train>>;
}

impl TrainKernels for Cpu {
    fn trainer(&self, params: &Params, units: Option<&[f32]>) -> Result<Box<dyn Train>> {
        Ok(Box::new(Trainer::new(params, units, Isa::detect())?))
    }
}

/// Parameters, Adam's moments, and buffers of a step.
pub struct Trainer {
    store: Store,
    anchors: Option<Anchors>,
    rasterizer: Rasterizer,
    isa: Isa,
    loss: Loss,
    biases: Biases,
    image: Vec<f32>,
    alpha: Vec<f32>,
    gradient: Vec<f32>,
    /// Frozen rows in the caller's order; empty if none is frozen.
    frozen: Vec<bool>,
    /// One bit per row of a group of the store, 0 if it is frozen; empty if none is.
    free: Vec<u16>,
}

impl Trainer {
    /// `units`: factor of each Gaussian's rate of the mean; `None` means 1.
    pub fn new(params: &Params, units: Option<&[f32]>, isa: Isa) -> Result<Self> {
        Ok(Self {
            store: Store::new(params, units)?,
            anchors: None,
            rasterizer: Rasterizer::new(isa),
            isa,
            loss: Loss::new(isa),
            biases: Biases::default(),
            image: Vec::new(),
            alpha: Vec::new(),
            gradient: Vec::new(),
            frozen: Vec::new(),
            free: Vec::new(),
        })
    }

    pub fn store(&self) -> &Store {
        &self.store
    }

    fn mark_free(&mut self) {
        let frozen = &self.frozen;
        self.free = match frozen.iter().any(|&f| f) {
            false => Vec::new(),
            true => (self.store.order().chunks(LANES))
                .map(|rows| {
                    let bit =
                        |(lane, &row): (usize, &u32)| u16::from(!frozen[row as usize]) << lane;
                    rows.iter().enumerate().map(bit).sum()
                })
                .collect(),
        };
    }

    /// Renders the view; returns its loss against the target, and leaves the gradient.
    fn photometric_loss(&mut self, input: &StepInput) -> Result<f64> {
        input.validate(self.anchors.is_some())?;
        let (camera, shape) = (input.camera, input.shape());
        self.image.resize(shape.values(), 0.0);
        self.gradient.resize(shape.values(), 0.0);
        self.alpha.resize(camera.width * camera.height, 0.0);
        let mut parameters = self.store.parameters();
        if input.regularizers.is_some() {
            parameters = parameters.unbounded(); // rows out of view step too
        }
        let mut image = Image {
            rgb: &mut self.image,
            alpha: &mut self.alpha,
            depth: None,
            median: None,
        };
        self.rasterizer.forward_from(
            parameters,
            camera,
            &input.settings,
            input.background,
            &mut image,
        )?;
        let mask = input.mask.map(|m| Mask::new(m, shape)).transpose()?;
        let loss = self.loss.l1_ssim(
            &self.image,
            input.target,
            shape,
            mask.as_ref(),
            input.ssim_weight,
            &mut self.gradient,
        )?;
        if let Some(typical) = input.relative {
            let factor = typical / (loss as f32).max(LEAST_LOSS);
            self.gradient.par_iter_mut().for_each(|g| *g *= factor);
        }
        Ok(loss)
    }

    /// The backward pass and Adam; returns how many Gaussians moved and how many were skipped.
    fn adam_step(&mut self, input: &StepInput) -> (usize, usize) {
        self.biases
            .extend_to(input.rates.momentum, self.store.most_steps() as usize + 1);
        let (biases, anchors, isa) = (&self.biases, self.anchors.as_ref(), self.isa);
        let free = &self.free[..];
        let blocks = self.store.blocks();
        let finish = |sums: &ChunkSums| {
            let regularize = input.regularizers.as_ref().zip(anchors);
            dispatch(
                isa,
                Update {
                    sums,
                    blocks,
                    biases,
                    rates: &input.rates,
                    reach: input.reach,
                    finest: input.finest,
                    regularize,
                    free: (!free.is_empty()).then_some(free),
                },
            )
        };
        let gradients = ImageGradients {
            rgb: &self.gradient,
            alpha: None,
            depth: None,
        };
        let chunks = self.rasterizer.backward_by_chunk(&gradients, finish);
        let (updated, skipped) = chunks.iter().fold((0, 0), |t, c| (t.0 + c.0, t.1 + c.1));
        self.store.count_step();
        (updated, skipped)
    }
}

impl Train for Trainer {
    fn step(&mut self, input: &StepInput) -> Result<Report> {
        let loss = self.photometric_loss(input)?;
        let (updated, skipped) = self.adam_step(input);
        Ok(Report {
            loss,
            updated,
            skipped,
        })
    }

    fn values(&self) -> Result<Vec<f32>> {
        Ok(self.store.columns(0, self.store.attributes()))
    }

    fn columns(&self, starts: &[usize]) -> Result<Vec<Vec<f32>>> {
        let parts = starts.windows(2);
        Ok(parts.map(|at| self.store.columns(at[0], at[1])).collect())
    }

    fn steps(&self) -> Result<Vec<u32>> {
        Ok(self.store.steps())
    }

    fn export(&self) -> Result<Exported> {
        Ok(self.store.export())
    }

    fn export_part(&self, part: Part) -> Result<Exported> {
        Ok(self.store.export_part(part))
    }

    fn import(&mut self, state: &Exported) -> Result<()> {
        self.store.import(state)?;
        self.mark_free();
        Ok(())
    }

    fn freeze(&mut self, frozen: &[bool]) -> Result<()> {
        Error::unless_equal("frozen", frozen.len(), self.store.len(), "rows")?;
        self.frozen = frozen.to_vec();
        self.mark_free();
        Ok(())
    }

    fn set_anchors(
        &mut self,
        means: &[f32],
        frames: &[f32],
        r_parallel: &[f32],
        r_perp: &[f32],
    ) -> Result<()> {
        let order = self.store.order();
        self.anchors = Some(Anchors::new(order, means, frames, r_parallel, r_perp)?);
        Ok(())
    }
}
