//! The rows of a run on the device. A row is uploaded once, when it is made, and addressed by its number from then on;
//! groups are sent as the numbers of their members, whose rows are gathered on the device.

use g2ard_core::Splats;
use g2ard_core::simplify::{GONE, optical_mass};
use rayon::prelude::*;

use crate::runtime::{Buffer, Gpu, Kernel, Result, Work};
use crate::soft64::SOFT64;

const SOURCES: &[&str] = &[SOFT64, include_str!("gather.wgsl")];

/// A kernel that gathers rows in some form.
pub struct Gather {
    kernel: Kernel,
    /// Whether it reads more than means.
    reads_attributes: bool,
    binding: u32,
    /// Words of a member.
    pub words: usize,
}

pub const POINTS: Gather = Gather {
    kernel: Kernel {
        name: "rows.points",
        sources: SOURCES,
        entry: "gather_points",
    },
    reads_attributes: false,
    binding: 4,
    words: MEAN,
};
pub const COLORED: Gather = Gather {
    kernel: Kernel {
        name: "rows.colored",
        sources: SOURCES,
        entry: "gather_colored",
    },
    reads_attributes: true,
    binding: 5,
    words: 12,
};
pub const WEIGHED: Gather = Gather {
    kernel: Kernel {
        name: "rows.weighed",
        sources: SOURCES,
        entry: "gather_weighed",
    },
    reads_attributes: true,
    binding: 6,
    words: 16,
};

/// Words of a mean, and of the other attributes of a row.
const MEAN: usize = 6;
const ATTRIBUTES: usize = 12;
const THREADS: usize = 64;

/// Rows with the numbers that the device knows them by.
#[derive(Debug, Clone, Copy)]
pub struct Numbered<'a> {
    pub splats: &'a Splats,
    pub numbers: &'a [u32],
}

/// The numbers of the rows of a run: every row that is made gets the next, and a copy keeps its own.
#[derive(Debug, Default)]
pub struct Numbers {
    of_row: Vec<u32>,
    next: u32,
}

impl Numbers {
    /// The numbers of `count` rows: 0 … count − 1 before the first round.
    pub fn of(&mut self, count: usize) -> &[u32] {
        if self.next == 0 {
            self.of_row = (0..count as u32).collect();
            self.next = count as u32;
        }
        debug_assert_eq!(self.of_row.len(), count, "rows changed without a word");
        &self.of_row
    }

    /// See [`g2ard_core::simplify::GroupKernels::rows_replaced`].
    pub fn replace(&mut self, copied: &[u32]) {
        let number = |&source: &u32| {
            if source != GONE {
                return self.of_row[source as usize];
            }
            self.next += 1;
            self.next - 1
        };
        self.of_row = copied.iter().map(number).collect();
    }
}

/// Rows that the device has, in pieces that each fit into a buffer.
#[derive(Debug, Default)]
pub struct Rows {
    count: usize,
    pieces: Vec<Piece>,
}

#[derive(Debug)]
struct Piece {
    first: usize,
    count: usize,
    means: Buffer,
    attributes: Buffer,
}

impl Rows {
    /// Uploads the rows that are new: those whose numbers follow on the last.
    pub fn follow(&mut self, gpu: &Gpu, rows: Numbered<'_>) -> Result<()> {
        let known = self.count as u32;
        let fresh: Vec<u32> = (0..rows.numbers.len() as u32)
            .filter(|&i| rows.numbers[i as usize] >= known)
            .collect();
        debug_assert!(
            fresh
                .iter()
                .zip(known..)
                .all(|(&i, number)| rows.numbers[i as usize] == number),
            "new rows are numbered in their order"
        );
        let mut first = self.count;
        let mut pieces = Vec::new();
        for part in fresh.chunks((gpu.max_words() / ATTRIBUTES).max(1)) {
            let attributes: Vec<_> = part
                .par_iter()
                .map(|&i| attributes(rows.splats, i as usize))
                .collect();
            let means: Vec<_> = part
                .iter()
                .map(|&i| rows.splats.means[i as usize])
                .collect();
            pieces.push(Piece {
                first,
                count: part.len(),
                means: gpu.upload("means", &means)?,
                attributes: gpu.upload("rows", &attributes)?,
            });
            first += part.len();
        }
        self.pieces.extend(pieces);
        self.count = first;
        Ok(())
    }

    /// The means of all rows in order, if these are their numbers.
    pub fn all_means(&self, numbers: &[u32]) -> Option<Vec<Buffer>> {
        let all = numbers.len() == self.count && numbers.is_sorted();
        all.then(|| self.pieces.iter().map(|p| p.means.clone()).collect())
    }

    /// The rows of these numbers, in their order.
    pub fn gather(
        &self,
        gpu: &Gpu,
        work: &mut Work,
        how: &Gather,
        numbers: &[u32],
    ) -> Result<Buffer> {
        let members = gpu.buffer("members", how.words * numbers.len())?;
        let order = gpu.upload("order", numbers)?;
        for piece in &self.pieces {
            let constants = [
                piece.first as u32,
                piece.count as u32,
                numbers.len() as u32,
                0,
            ];
            let mut bound = vec![(1, &piece.means), (3, &order), (how.binding, &members)];
            if how.reads_attributes {
                bound.push((2, &piece.attributes));
            }
            let groups = numbers.len().div_ceil(THREADS);
            work.run_at(&how.kernel, groups, &constants, &bound)?;
        }
        Ok(members)
    }
}

/// `Attributes` of gather.wgsl.
fn attributes(splats: &Splats, i: usize) -> [u32; ATTRIBUTES] {
    let mass = optical_mass(
        f64::from(splats.logit_opacities[i]),
        splats.scales[i].map(f64::from),
    );
    let [low, high] = [mass.to_bits() as u32, (mass.to_bits() >> 32) as u32];
    let [r, g, b] = splats.sh_of(i)[0].map(f32::to_bits);
    let [x, y, z] = splats.scales[i].map(f32::to_bits);
    let [p, q, s, t] = splats.quats[i].map(f32::to_bits);
    [low, high, r, g, b, x, y, z, p, q, s, t]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_keep_their_numbers_and_new_rows_get_new_ones() {
        let mut numbers = Numbers::default();
        assert_eq!(numbers.of(4), [0, 1, 2, 3]);
        numbers.replace(&[GONE, 3, GONE]);
        assert_eq!(numbers.of(3), [4, 3, 5]);
        numbers.replace(&[2, GONE]);
        assert_eq!(numbers.of(2), [5, 6]);
    }
    use crate::runtime::Options;
    use crate::testing::{gpu_with, scenes};
    use g2ard_core::simplify::{color, weights};

    /// Rows of a scene, in any order, under other numbers.
    fn some(splats: &Splats, rows: &[usize]) -> Splats {
        let mut out = Splats {
            sh_coeffs: splats.sh_coeffs,
            ..Splats::default()
        };
        for &i in rows {
            out.means.push(splats.means[i]);
            out.quats.push(splats.quats[i]);
            out.scales.push(splats.scales[i]);
            out.logit_opacities.push(splats.logit_opacities[i]);
            out.sh.extend_from_slice(splats.sh_of(i));
        }
        out
    }

    #[test]
    fn only_new_rows_are_sent_and_all_are_found() {
        let (_, scene) = scenes(900).swap_remove(0);
        for max_binding in [None, Some(1 << 10)] {
            let options = Options {
                max_binding,
                ..Options::default()
            };
            let Some(gpu) = gpu_with("rows", options) else {
                return;
            };
            let mut held = Rows::default();
            let mut sent = |splats: &Splats, numbers: &[u32]| {
                let before = gpu.sent();
                held.follow(&gpu, Numbered { splats, numbers }).unwrap();
                (gpu.sent() - before) as usize
            };
            let bytes = 4 * (MEAN + ATTRIBUTES);
            let first: Vec<usize> = (0..700).collect();
            let numbers: Vec<u32> = (0..700).collect();
            let splats = some(&scene, &first);
            assert_eq!(sent(&splats, &numbers), 700 * bytes);
            assert_eq!(sent(&splats, &numbers), 0);
            // A few stay, two come into being.
            let numbers = [699, 700, 3, 701, 42];
            let splats = some(&scene, &[699, 800, 3, 801, 42]);
            assert_eq!(sent(&splats, &numbers), 2 * bytes);
            assert_eq!(sent(&splats, &numbers), 0);
            assert!(held.all_means(&numbers).is_none());

            let wanted = [42, 701, 3, 3, 700];
            let sources = [42, 801, 3, 3, 800];
            let read = |how: &Gather| {
                let mut work = Work::new(&gpu);
                let found = held.gather(&gpu, &mut work, how, &wanted).unwrap();
                let words = work.submit(&[(&found, found.words())]).unwrap().take();
                words.unwrap().swap_remove(0)
            };
            let (points, colored, weighed) = (read(&POINTS), read(&COLORED), read(&WEIGHED));
            for (at, &row) in sources.iter().enumerate() {
                let words = |numbers: &[f64]| -> Vec<u32> { bytemuck::pod_collect_to_vec(numbers) };
                let part = |all: &[u32], how: &Gather| all[at * how.words..][..how.words].to_vec();
                let mean = words(&scene.means[row]);
                assert_eq!(part(&points, &POINTS), mean);
                let color = words(&color(&scene, row));
                assert_eq!(part(&colored, &COLORED), [mean.clone(), color].concat());
                let mass = words(&weights(&scene, &[row as u32]).0);
                let quat = scene.quats[row].map(f32::to_bits);
                let scales = scene.scales[row].map(f32::to_bits);
                let want = [&mean[..], &mass, &quat, &scales, &[0]].concat();
                assert_eq!(part(&weighed, &WEIGHED), want);
            }
        }
    }
}
