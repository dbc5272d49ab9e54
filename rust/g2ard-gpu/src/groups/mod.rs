//! Twins that work group by group: affine energy, and merging with the coverage guard.

mod batch;

use g2ard_core::backend::Group;
use g2ard_core::linalg::Mat3;
use g2ard_core::simplify::{Gaussian, Merged, color, disc, weights};
use g2ard_core::{Backend, Control, Cpu, Splats};
use rayon::prelude::*;

use crate::runtime::{Gpu, Kernel, Result};
use crate::soft64::{LINEAR, SOFT64};
use batch::{Twin, run};

const ENERGY: Twin = Twin {
    kernel: Kernel {
        name: "groups.energy",
        sources: &[SOFT64, LINEAR, include_str!("energy.wgsl")],
        entry: "energy",
    },
    member: 12,
    answer: 2,
};

const MERGE: Twin = Twin {
    kernel: Kernel {
        name: "groups.merge",
        sources: &[SOFT64, LINEAR, include_str!("merge.wgsl")],
        entry: "merge",
    },
    member: 16,
    answer: 32,
};

/// See [`Backend::energies`].
pub fn energies(
    gpu: &Gpu,
    splats: &Splats,
    count: usize,
    group: &Group<'_>,
    control: &Control,
) -> Result<Vec<f64>> {
    let fill = |rows: &[u32], out: &mut Vec<u32>| {
        for &i in rows {
            let numbers = [splats.means[i as usize], color(splats, i as usize)];
            out.extend_from_slice(bytemuck::cast_slice(&numbers));
        }
    };
    let found = run(gpu, &ENERGY, count, group, &fill, &[], control)?;
    let mut energies: Vec<f64> = bytemuck::pod_collect_to_vec(&found.answers);
    let large = &found.large;
    let again = |at: usize, rows: &mut Vec<u32>| group(large[at], rows);
    let rest = Cpu.energies(splats, large.len(), &again, control)?;
    large.iter().zip(rest).for_each(|(&g, e)| energies[g] = e);
    Ok(energies)
}

/// See [`Backend::merges`]. Opacity and SH are averaged here: to send a row's 180 bytes of SH to a device takes
/// longer than to add them up.
pub fn merges(
    gpu: &Gpu,
    splats: &Splats,
    groups: &[&[u32]],
    control: &Control,
) -> Result<Vec<(Merged, f64)>> {
    let fill = |rows: &[u32], out: &mut Vec<u32>| {
        for (&i, &w) in rows.iter().zip(&weights(splats, rows).0) {
            let ([x, y, z], i) = (splats.means[i as usize], i as usize);
            out.extend_from_slice(bytemuck::cast_slice(&[x, y, z, w]));
            out.extend(splats.quats[i].map(f32::to_bits));
            out.extend(splats.scales[i].map(f32::to_bits));
            out.push(0);
        }
    };
    let group = |at: usize, rows: &mut Vec<u32>| {
        rows.extend_from_slice(groups[at]);
        rows.len()
    };
    let disc = gpu.upload("disc", disc().as_flattened())?;
    let found = run(gpu, &MERGE, groups.len(), &group, &fill, &[&disc], control)?;
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
    let rest = Cpu.merges(splats, &large, control)?;
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
    use g2ard_core::spatial::{Cells, Frame};

    /// Groups of a few rows and of many, with and without borrowed ones.
    fn cells_of(splats: &Splats) -> Cells {
        Cells::adaptive(&splats.means, &Frame::of(&splats.means), splats.len() / 6)
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
            let want = Cpu
                .energies(&splats, cells.len() + 9, &own, &control)
                .unwrap();
            let got = energies(gpu, &splats, cells.len() + 9, &own, &control).unwrap();
            let bits = |v: &[f64]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            let energy = share(&bits(&want), &bits(&got));
            let mut groups: Vec<&[u32]> = (0..cells.len()).map(|c| cells.members_of(c)).collect();
            let rows: Vec<u32> = (0..splats.len() as u32).collect();
            groups.extend(rows.chunks(700)); // of every size up to those that are left to the CPU
            groups.extend(rows[..splats.len().min(900)].chunks(125));
            let want = Cpu.merges(&splats, &groups, &control).unwrap();
            let got = merges(gpu, &splats, &groups, &control).unwrap();
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
