//! The rows of a run on the device. A row is uploaded once, when it is created, and keeps its number. Groups are sent
//! as the numbers of their members, which the device gathers.

use g2ard_core::Splats;
use g2ard_core::simplify::{GONE, optical_mass};
use g2ard_core::spatial::RobustBounds;
use rayon::prelude::*;

use crate::runtime::{Buffer, Gpu, Kernel, Result, Work};
use crate::two::Frame;

const GATHER: Kernel = Kernel::new("rows.gather", &[include_str!("gather.wgsl")], "gather");

/// Words per row: SH of band 0 (3), mean (6), optical mass (2), scales (3), quaternion (4).
const ROW: usize = 18;

/// A range of a row's words.
#[derive(Debug, Clone, Copy)]
pub struct Part {
    from: usize,
    pub words: usize,
}

pub const POINTS: Part = Part { from: 3, words: 6 };
pub const COLORED: Part = Part { from: 0, words: 9 };
pub const WEIGHED: Part = Part { from: 3, words: 15 };

const THREADS: usize = 64;

/// Rows with their numbers on the device.
#[derive(Debug, Clone, Copy)]
pub struct Numbered<'a> {
    pub splats: &'a Splats,
    pub numbers: &'a [u32],
}

/// Numbers of a run's rows: each new row gets the next number, and a copy keeps its own.
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
    /// Frame of the first rows; later rows are merged from them.
    frame: Option<Frame>,
    count: usize,
    pieces: Vec<Piece>,
}

#[derive(Debug)]
struct Piece {
    first: usize,
    count: usize,
    rows: Buffer,
}

impl Rows {
    /// Upload new rows, whose numbers follow the last uploaded one. Return the frame of all rows.
    pub fn follow(&mut self, gpu: &Gpu, rows: Numbered<'_>) -> Result<Frame> {
        let means = &rows.splats.means;
        let around = || Frame::around(means, &RobustBounds::of(means));
        let frame = *self.frame.get_or_insert_with(around);
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
        for part in fresh.chunks((gpu.max_words() / ROW).max(1)) {
            let words: Vec<_> = part
                .par_iter()
                .map(|&i| words(rows.splats, i as usize, frame))
                .collect();
            pieces.push(Piece {
                first,
                count: part.len(),
                rows: gpu.upload("rows", &words)?,
            });
            first += part.len();
        }
        self.pieces.extend(pieces);
        self.count = first;
        Ok(frame)
    }

    /// Gather a part of the rows with these numbers, in their order.
    pub fn gather(
        &self,
        gpu: &Gpu,
        work: &mut Work,
        part: Part,
        numbers: &[u32],
    ) -> Result<Buffer> {
        let members = gpu.buffer("members", part.words * numbers.len())?;
        let order = gpu.upload("order", numbers)?;
        for piece in &self.pieces {
            let shape = [piece.first, piece.count, numbers.len()];
            let words = [ROW, part.from, part.words, 0, 0];
            let constants: Vec<u32> = shape.iter().chain(&words).map(|&n| n as u32).collect();
            let groups = numbers.len().div_ceil(THREADS);
            work.run(
                &GATHER,
                groups,
                &constants,
                &[&piece.rows, &order, &members],
            )?;
        }
        Ok(members)
    }
}

/// A row in the layout that kernels read.
fn words(splats: &Splats, i: usize, frame: Frame) -> [u32; ROW] {
    let [r, g, b] = splats.sh_of(i)[0].map(f32::to_bits);
    let mean = frame.fixed(splats.means[i]);
    let [[xl, xh], [yl, yh], [zl, zh]] = mean.map(|v| [v as u32, (v >> 32) as u32]);
    let [part, power] = mass(splats, i);
    let [u, v, w] = splats.scales[i].map(f32::to_bits);
    let [p, q, s, t] = splats.quats[i].map(f32::to_bits);
    [
        r, g, b, xl, xh, yl, yh, zl, zh, part, power, u, v, w, p, q, s, t,
    ]
}

/// An optical mass as an f32 in [1, 2] and a power of two, because masses exceed the range of f32.
fn mass(splats: &Splats, i: usize) -> [u32; 2] {
    let scales = splats.scales[i].map(f64::from);
    let mass = optical_mass(f64::from(splats.logit_opacities[i]), scales);
    if mass <= 0.0 {
        return [0, i16::MIN as u32];
    }
    let power = mass.log2().floor();
    let part = (mass / power.exp2()) as f32;
    [part.to_bits(), power as i32 as u32]
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
    use crate::testing::{gpu_in_pieces, scenes};

    /// Some rows of a scene, in any order, under new numbers.
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
        for bytes in [u64::MAX, 1 << 10] {
            let Some(gpu) = gpu_in_pieces("rows", bytes) else {
                return;
            };
            let mut held = Rows::default();
            let mut sent = |splats: &Splats, numbers: &[u32]| {
                let before = gpu.sent();
                held.follow(&gpu, Numbered { splats, numbers }).unwrap();
                (gpu.sent() - before) as usize
            };
            let first: Vec<usize> = (0..700).collect();
            let numbers: Vec<u32> = (0..700).collect();
            let splats = some(&scene, &first);
            assert_eq!(sent(&splats, &numbers), 700 * 4 * ROW);
            assert_eq!(sent(&splats, &numbers), 0);
            // Some rows stay, and two are new.
            let numbers = [699, 700, 3, 701, 42];
            let splats = some(&scene, &[699, 800, 3, 801, 42]);
            assert_eq!(sent(&splats, &numbers), 2 * 4 * ROW);
            assert_eq!(sent(&splats, &numbers), 0);

            let frame = held.frame.unwrap();
            let wanted = [42, 701, 3, 3, 700];
            let sources = [42, 801, 3, 3, 800];
            for part in [POINTS, COLORED, WEIGHED] {
                let mut work = Work::new(&gpu);
                let found = held.gather(&gpu, &mut work, part, &wanted).unwrap();
                let found = work.submit(&[(&found, found.words())]).unwrap().take();
                let want = sources.map(|row| words(&scene, row, frame));
                let want = want.iter().flat_map(|w| &w[part.from..][..part.words]);
                assert!(want.eq(&found.unwrap()[0]));
            }
        }
    }
}
