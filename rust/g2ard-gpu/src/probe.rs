//! A check that a device computes correctly, and a race against the CPU.

use std::time::{Duration, Instant};

use g2ard_core::random::Lcg;
use g2ard_core::simplify::GroupKernels;
use g2ard_core::{Control, Cpu, Splats};

use crate::groups;
use crate::rows::Rows;
use crate::runtime::{Error, Gpu, Result};

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
    }
}
