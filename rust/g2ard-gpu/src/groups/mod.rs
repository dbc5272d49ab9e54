//! GPU kernels over groups: affine energy, and merging with the coverage guard.

mod batch;

use g2ard_core::scene::Gaussian;
use g2ard_core::simplify::{Group, GroupKernels, Merged, disc, weights};
use g2ard_core::{Control, Cpu};
use rayon::prelude::*;

use crate::rows::{COLORED, Run, WEIGHED};
use crate::runtime::{Kernel, Result};
use crate::two::{TWO, number};
use batch::{Twin, run_twin};

const MEMBERS: &str = include_str!("members.wgsl");
const ENERGY_SOURCES: &[&str] = &[TWO, include_str!("energy.wgsl"), MEMBERS];
const ENERGY: Kernel = Kernel::new("groups.energy", ENERGY_SOURCES, "energy");
const MERGE_SOURCES: &[&str] = &[TWO, include_str!("merge.wgsl"), MEMBERS];
const MERGE: Kernel = Kernel::new("groups.merge", MERGE_SOURCES, "merge");

/// See [`GroupKernels::energies`].
pub fn energies(
    run: Run<'_>,
    count: usize,
    group: &Group<'_>,
    control: &Control,
) -> Result<Vec<f64>> {
    let twin = Twin {
        kernel: &ENERGY,
        part: COLORED,
        answer: 2,
        extra: None,
        constants: [0; 2],
    };
    let found = run_twin(run, &twin, count, group, control)?;
    let mut energies: Vec<f64> = found.answers.chunks(twin.answer).map(number).collect();
    let again = |at: usize, rows: &mut Vec<u32>| group(found.large[at], rows);
    let rest = Cpu.energies(run.splats, found.large.len(), &again, control)?;
    let large = found.large.iter().zip(rest);
    large.for_each(|(&g, energy)| energies[g] = energy);
    Ok(energies)
}

/// See [`GroupKernels::merges`]. Opacity and SH are averaged on the CPU, because sending a row's 180 bytes of SH to a
/// device takes longer than adding them up.
pub fn merges(
    run: Run<'_>,
    groups: &[&[u32]],
    support: f64,
    control: &Control,
) -> Result<Vec<(Merged, f64)>> {
    let group = |at: usize, rows: &mut Vec<u32>| {
        rows.extend_from_slice(groups[at]);
        groups[at].len()
    };
    let disc = disc().map(|at| at.map(|v| v as f32));
    let disc = run.gpu.upload("disc", &disc)?;
    let twin = Twin {
        kernel: &MERGE,
        part: WEIGHED,
        answer: 32,
        extra: Some(&disc),
        constants: [(support as f32).to_bits(), run.frame.exponent as u32],
    };
    let found = run_twin(run, &twin, groups.len(), &group, control)?;
    let splats = run.splats;
    let mut merges: Vec<_> = found
        .answers
        .par_chunks(twin.answer)
        .zip(groups)
        .map(|(answer, rows)| {
            let (weights, mass) = weights(splats, rows);
            let gaussian = gaussian(answer, splats.means[rows[0] as usize]);
            let covered = f64::from(f32::from_bits(answer[COVERED]));
            (Merged::of(splats, rows, &weights, mass, gaussian), covered)
        })
        .collect();
    let large: Vec<&[u32]> = found.large.iter().map(|&g| groups[g]).collect();
    let rest = Cpu.merges(splats, &large, support, control)?;
    let large = found.large.iter().zip(rest);
    large.for_each(|(&g, merged)| merges[g] = merged);
    Ok(merges)
}

/// Words of an answer that hold the covered share and the exponent of its lengths.
const COVERED: usize = 30;
const POWER: usize = 31;

/// Mean (relative to the first row's), axes and scales, as the kernel returns them.
fn gaussian(answer: &[u32], first: [f64; 3]) -> Gaussian {
    let numbers: Vec<f64> = answer[..COVERED].chunks(2).map(number).collect();
    let unit = 2f64.powi(answer[POWER] as i32);
    let axis = |k: usize| &numbers[3 + 3 * k..6 + 3 * k];
    let least = f64::from(f32::MIN_POSITIVE);
    Gaussian {
        mean: [0, 1, 2].map(|k| first[k] + unit * numbers[k]),
        rotation: [0, 1, 2].map(|r| [axis(0)[r], axis(1)[r], axis(2)[r]]),
        scales: [12, 13, 14].map(|k| (unit * numbers[k]).max(least)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rows::Rows;
    use crate::runtime::Gpu;
    use crate::testing::{WHOLE, compare_on_gpu, scenes};
    use g2ard_core::Splats;
    use g2ard_core::spatial::{Cells, RobustBounds};

    /// Groups of a few rows and of many, with and without borrowed ones.
    fn cells_of(splats: &Splats) -> Cells {
        Cells::adaptive(
            &splats.means,
            &RobustBounds::of(&splats.means),
            splats.len() / 6,
        )
    }

    fn compare(gpu: &Gpu) {
        let control = Control::default();
        for (name, splats) in scenes(6000) {
            let cells = cells_of(&splats);
            let own = |c: usize, rows: &mut Vec<u32>| {
                if c >= cells.len() {
                    let first = (c - cells.len()) * 120 % splats.len();
                    rows.extend(first as u32..splats.len().min(first + 120) as u32);
                    return rows.len();
                }
                rows.extend_from_slice(cells.members_of(c));
                let own = rows.len();
                if own < 8 {
                    rows.extend(cells.face_neighbors(c).flat_map(|d| cells.members_of(d)));
                }
                own
            };
            let numbers: Vec<u32> = (0..splats.len() as u32).collect();
            let mut held = Rows::default();
            let run = held.of(gpu, &splats).unwrap();
            let count = cells.len() + 9;
            let want = Cpu.energies(&splats, count, &own, &control).unwrap();
            let got = energies(run, count, &own, &control).unwrap();
            let apart = |a: f64, b: f64| (a - b).abs() / (a.abs() + 1e-9);
            let energy = want.iter().zip(&got).map(|(&a, &b)| apart(a, b));
            let energy = energy.fold(0.0, f64::max);
            let mut groups: Vec<&[u32]> = (0..cells.len()).map(|c| cells.members_of(c)).collect();
            groups.extend(numbers.chunks(700)); // of every size up to those that are left to the CPU
            groups.extend(numbers[..splats.len().min(900)].chunks(125));
            let want = Cpu.merges(&splats, &groups, 3.0, &control).unwrap();
            let got = merges(run, &groups, 3.0, &control).unwrap();
            let (mut moments, mut recovered) = (0f64, 0);
            for ((a, covered_a), (b, covered_b)) in want.iter().zip(&got) {
                moments = moments.max(moments_apart(&a.gaussian, &b.gaussian));
                recovered += usize::from((covered_a - covered_b).abs() > TOLERANCE);
            }
            eprintln!(
                "{name}: {} energies within {energy:.1e}, {} moments within {moments:.1e}; {recovered} \
                 coverages differ",
                want.len(),
                got.len(),
            );
            assert!(energy <= TOLERANCE && moments <= TOLERANCE, "{name}");
            assert!(
                recovered * 100 <= got.len(),
                "{name}: {recovered} coverages"
            );
        }
    }

    /// Largest difference of energies (relative) and of moments (relative to the merged footprint). Coverages may
    /// differ more in at most one group in a hundred, where a sample point lies on the edge.
    const TOLERANCE: f64 = 1e-5;

    fn moments_apart(a: &Gaussian, b: &Gaussian) -> f64 {
        let size = a.scales[0].max(f64::from(f32::MIN_POSITIVE));
        let mean = (0..3).map(|k| (a.mean[k] - b.mean[k]).abs() / size);
        let (c, d) = (a.covariance(), b.covariance());
        let spread = (0..6).map(|k| (c[k] - d[k]).abs() / (size * size));
        mean.chain(spread).fold(0.0, f64::max)
    }

    #[test]
    fn energies_and_merges_are_close_to_the_cpus() {
        compare_on_gpu(&[WHOLE, 1 << 14], compare);
    }
}
