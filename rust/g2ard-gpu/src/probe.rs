//! A check that a device computes correctly, and races against the CPU.

use std::sync::Arc;
use std::time::{Duration, Instant};

use g2ard_core::random::Lcg;
use g2ard_core::raster::{Camera, Params, Settings};
use g2ard_core::simplify::GroupKernels;
use g2ard_core::train::{Rates, StepInput, Store, Train, TrainKernels};
use g2ard_core::{Control, Cpu, Splats};

use crate::rows::Rows;
use crate::runtime::{Error, Gpu, Result};
use crate::{groups, train};

/// Groups of the check, groups of the race, and rows per group.
const FEW: usize = 128;
const MANY: usize = 1 << 15;
const ROWS: usize = 8;

/// Largest relative difference of energies of groups of eight scattered rows.
const TOLERANCE: f64 = 1e-6;

/// The CPU must take at least this many times as long; otherwise transfers outweigh the gain.
const PAYS: f64 = 1.5;

/// Check that the device's answers equal the CPU's within rounding.
pub fn check(gpu: &Gpu) -> Result<()> {
    race(gpu, FEW).map(|_| ())
}

/// Check that the device is also faster than the CPU, once its kernels are compiled.
pub fn pays(gpu: &Gpu) -> Result<bool> {
    check(gpu)?;
    let (here, there) = race(gpu, MANY)?;
    Ok(here.as_secs_f64() > PAYS * there.as_secs_f64())
}

/// Rows, pixels and steps of the race of trainers.
const TRAINED: usize = 20_000;
const SIZE: [usize; 2] = [640, 480];
const STEPS: usize = 4;

/// Largest relative difference of their losses.
const LOSS_TOLERANCE: f64 = 1e-3;

/// Check that the device trains as the CPU does, and faster once its kernels are compiled.
pub fn training_pays(gpu: &Arc<Gpu>) -> Result<bool> {
    let (here, there) = race_of_trainers(gpu, TRAINED, SIZE)?;
    Ok(here.as_secs_f64() > PAYS * there.as_secs_f64())
}

/// Seconds of the CPU and of the device for the same steps.
fn race_of_trainers(gpu: &Arc<Gpu>, rows: usize, size: [usize; 2]) -> Result<(Duration, Duration)> {
    let mut random = Lcg(2);
    let mut draw = |columns: usize, low: f64, high: f64| -> Vec<f32> {
        (0..columns * rows)
            .map(|_| random.between(low, high) as f32)
            .collect()
    };
    let params = Params {
        means: &draw(3, -1.0, 1.0),
        quats: &draw(4, 0.1, 1.0),
        log_scales: &draw(3, -5.0, -3.0),
        logit_opacities: &draw(1, -2.0, 4.0),
        sh0: &draw(3, -1.0, 1.0),
        sh_n: &[],
        sh_coeffs: 1,
        bounds: None,
    };
    let start = Store::new(&params, None)?.export();
    let mut there = train::Trainer::new(gpu.clone(), &start, params.sh_coeffs)?;
    let (want, here) = steps(&mut *Cpu.trainer(&params, None)?, size)?;
    let (got, there) = steps(&mut there, size)?;
    let apart = (want - got).abs();
    if apart > LOSS_TOLERANCE * want || apart.is_nan() {
        return Err(Error::Wrong(gpu.adapter.name.clone()));
    }
    Ok((here, there))
}

/// The last loss of a few steps, and the time of all but the first.
fn steps(trainer: &mut dyn Train, [width, height]: [usize; 2]) -> Result<(f64, Duration)> {
    let mut random = Lcg(3);
    let target: Vec<f32> = (0..3 * width * height)
        .map(|_| random.uniform_f32())
        .collect();
    let camera = Camera {
        viewmat: [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 2.0],
        ],
        fx: width as f64,
        fy: width as f64,
        cx: width as f64 / 2.0,
        cy: height as f64 / 2.0,
        width,
        height,
        near: 0.01,
    };
    let input = StepInput {
        camera: &camera,
        settings: Settings::default(),
        background: [0.0; 3],
        target: &target,
        mask: None,
        view: None,
        ssim_weight: 0.2,
        relative: None,
        rates: Rates {
            means: 1e-3,
            sh0: 0.01,
            ..Rates::default()
        },
        reach: None,
        finest: 0.0,
        regularizers: None,
    };
    trainer.step(&input)?;
    let began = Instant::now();
    let mut loss = 0.0;
    for _ in 1..STEPS {
        loss = trainer.step(&input)?.loss;
    }
    Ok((loss, began.elapsed()))
}

/// Seconds of the CPU and of the device for the same groups.
fn race(gpu: &Gpu, groups: usize) -> Result<(Duration, Duration)> {
    let splats = sample(groups * ROWS);
    let control = Control::default();
    let group = |g: usize, rows: &mut Vec<u32>| {
        rows.extend((g * ROWS) as u32..((g + 1) * ROWS) as u32);
        ROWS
    };
    let began = Instant::now();
    let want = Cpu.energies(&splats, groups, &group, &control)?;
    let here = began.elapsed();
    let began = Instant::now();
    let mut held = Rows::default();
    let run = held.of(gpu, &splats)?;
    let got = groups::energies(run, groups, &group, &control)?;
    let there = began.elapsed();
    if want
        .iter()
        .zip(&got)
        .any(|(a, b)| (a - b).abs() > TOLERANCE * a || b.is_nan())
    {
        return Err(Error::Wrong(gpu.adapter.name.clone()));
    }
    Ok((here, there))
}

/// Random rows.
fn sample(count: usize) -> Splats {
    let mut random = Lcg(1);
    let mut next = || random.centred();
    Splats {
        means: (0..count).map(|_| [next(), next(), next()]).collect(),
        sh: (0..count)
            .map(|_| [next() as f32, next() as f32, next() as f32])
            .collect(),
        sh_coeffs: 1,
        quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
        scales: vec![[1.0; 3]; count],
        logit_opacities: vec![0.0; count],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::gpu;

    #[test]
    fn software_is_right() {
        let Some(gpu) = gpu() else { return };
        check(&gpu).unwrap();
        race_of_trainers(&Arc::new(gpu), 500, [64, 48]).unwrap();
    }
}
