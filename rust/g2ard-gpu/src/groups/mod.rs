//! Twins that work group by group: affine energy, and merging with the coverage guard.

mod batch;

use g2ard_core::linalg::Mat3;
use g2ard_core::scene::Gaussian;
use g2ard_core::simplify::{Group, GroupKernels, Merged, disc, weights};
use g2ard_core::{Control, Cpu};
use rayon::prelude::*;

use crate::rows::{COLORED, Numbered, Rows, WEIGHED};
use crate::runtime::{Gpu, Kernel, Result};
use crate::soft64::{LINEAR, SOFT64};
use batch::{Source, Twin, run};

const SEGMENT: &str = include_str!("segment.wgsl");

const ENERGY: Twin = Twin {
    kernel: Kernel {
        name: "groups.energy",
        sources: &[SOFT64, LINEAR, SEGMENT, include_str!("energy.wgsl")],
        entry: "energy",
    },
    gather: COLORED,
    answer: 2,
};

const MERGE: Twin = Twin {
    kernel: Kernel {
        name: "groups.merge",
        sources: &[SOFT64, LINEAR, SEGMENT, include_str!("merge.wgsl")],
        entry: "merge",
    },
    gather: WEIGHED,
    answer: 32,
};

/// See [`GroupKernels::energies`].
pub fn energies(
    gpu: &Gpu,
    held: &Rows,
    rows: Numbered<'_>,
    count: usize,
    group: &Group<'_>,
    control: &Control,
) -> Result<Vec<f64>> {
    let source = Source {
        rows: held,
        numbers: rows.numbers,
        extra: None,
        constant: 0.0,
    };
    let found = run(gpu, &ENERGY, source, count, group, control)?;
    let mut energies: Vec<f64> = bytemuck::pod_collect_to_vec(&found.answers);
    let large = &found.large;
    let again = |at: usize, rows: &mut Vec<u32>| group(large[at], rows);
    let rest = Cpu.energies(rows.splats, large.len(), &again, control)?;
    large.iter().zip(rest).for_each(|(&g, e)| energies[g] = e);
    Ok(energies)
}

/// See [`GroupKernels::merges`]. Opacity and SH are averaged here: to send a row's 180 bytes of SH to a device takes
/// longer than to add them up.
pub fn merges(
    gpu: &Gpu,
    held: &Rows,
    rows: Numbered<'_>,
    groups: &[&[u32]],
    support: f64,
    control: &Control,
) -> Result<Vec<(Merged, f64)>> {
    let group = |at: usize, rows: &mut Vec<u32>| {
        rows.extend_from_slice(groups[at]);
        groups[at].len()
    };
    let disc = gpu.upload("disc", disc().as_flattened())?;
    let source = Source {
        rows: held,
        numbers: rows.numbers,
        extra: Some(&disc),
        constant: support,
    };
    let found = run(gpu, &MERGE, source, groups.len(), &group, control)?;
    let splats = rows.splats;
    let mut merges: Vec<_> = found
        .answers
        .par_chunks(MERGE.answer)
        .zip(groups)
        .map(|(answer, rows)| {
            let numbers: Vec<f64> = bytemuck::pod_collect_to_vec(answer);
            let (weights, mass) = weights(splats, rows);
            let gaussian = gaussian(&numbers);
            (
                Merged::of(splats, rows, &weights, mass, gaussian),
                numbers[15],
            )
        })
        .collect();
    let large: Vec<&[u32]> = found.large.iter().map(|&g| groups[g]).collect();
    let rest = Cpu.merges(rows.splats, &large, support, control)?;
    found
        .large
        .iter()
        .zip(rest)
        .for_each(|(&g, m)| merges[g] = m);
    Ok(merges)
}

/// Mean, axes and scales as the kernel leaves them.
fn gaussian(numbers: &[f64]) -> Gaussian {
    let axis = |k: usize| &numbers[3 + 3 * k..6 + 3 * k];
    let rotation: Mat3 = [0, 1, 2].map(|r| [axis(0)[r], axis(1)[r], axis(2)[r]]);
    Gaussian {
        mean: [0, 1, 2].map(|k| numbers[k]),
        rotation,
        scales: [12, 13, 14].map(|k| numbers[k]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::Options;
    use crate::testing::{gpu, gpu_with, scenes, share};
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

    fn compare(gpu: &Gpu, what: &str) {
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
            let numbered = Numbered {
                splats: &splats,
                numbers: &numbers,
            };
            let mut held = Rows::default();
            held.follow(gpu, numbered).unwrap();
            let count = cells.len() + 9;
            let want = Cpu.energies(&splats, count, &own, &control).unwrap();
            let got = energies(gpu, &held, numbered, count, &own, &control).unwrap();
            let bits = |v: &[f64]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            let energy = share(&bits(&want), &bits(&got));
            let mut groups: Vec<&[u32]> = (0..cells.len()).map(|c| cells.members_of(c)).collect();
            let rows: Vec<u32> = (0..splats.len() as u32).collect();
            groups.extend(rows.chunks(700)); // of every size up to those that are left to the CPU
            groups.extend(rows[..splats.len().min(900)].chunks(125));
            let want = Cpu.merges(&splats, &groups, 3.0, &control).unwrap();
            let got = merges(gpu, &held, numbered, &groups, 3.0, &control).unwrap();
            let merge = share(&want, &got);
            eprintln!(
                "{what} {name}: {:.4} % of {} energies and {:.4} % of merges are the same bits",
                100.0 * energy,
                want.len(),
                100.0 * merge
            );
            assert!(energy == 1.0 && merge == 1.0, "{name}");
        }
    }

    #[test]
    fn energies_and_merges_are_the_cpus() {
        let Some(gpu) = gpu("groups") else { return };
        compare(&gpu, "groups");
    }

    #[test]
    fn energies_and_merges_are_the_cpus_in_pieces() {
        let max_binding = Some(1 << 14);
        let Some(gpu) = gpu_with(
            "groups in pieces",
            Options {
                max_binding,
                ..Options::default()
            },
        ) else {
            return;
        };
        compare(&gpu, "groups in pieces");
    }
}
