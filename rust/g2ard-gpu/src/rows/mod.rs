//! The rows of a run on the device, uploaded once a round. Groups are sent as the numbers of their members, which the
//! device gathers.

use g2ard_core::Splats;
use g2ard_core::simplify::optical_mass;
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

/// The rows of a round, which the device holds.
#[derive(Clone, Copy)]
pub struct Run<'a> {
    pub gpu: &'a Gpu,
    pub splats: &'a Splats,
    pub frame: Frame,
    pieces: &'a [Piece],
}

/// Rows that the device has, in pieces that each fit into a buffer.
#[derive(Debug, Default)]
pub struct Rows {
    /// Frame of the first round's rows; later rows are merged from them.
    frame: Option<Frame>,
    pieces: Vec<Piece>,
}

#[derive(Debug)]
struct Piece {
    first: usize,
    count: usize,
    rows: Buffer,
}

impl Rows {
    /// Upload the rows unless the device has them.
    pub fn of<'a>(&'a mut self, gpu: &'a Gpu, splats: &'a Splats) -> Result<Run<'a>> {
        let around = || Frame::around(&splats.means);
        let frame = *self.frame.get_or_insert_with(around);
        if self.pieces.is_empty() {
            let most = (gpu.max_words() / ROW).max(1);
            let piece = |first: usize| {
                let rows = first..splats.len().min(first + most);
                let count = rows.len();
                let words: Vec<_> = rows
                    .into_par_iter()
                    .map(|i| words(splats, i, frame))
                    .collect();
                let rows = gpu.upload("rows", &words)?;
                Ok(Piece { first, count, rows })
            };
            self.pieces = (0..splats.len())
                .step_by(most)
                .map(piece)
                .collect::<Result<_>>()?;
        }
        Ok(Run {
            gpu,
            splats,
            frame,
            pieces: &self.pieces,
        })
    }

    /// Forget the rows of a round.
    pub fn clear(&mut self) {
        self.pieces.clear();
    }
}

impl Run<'_> {
    /// Gather a part of these rows, in their order.
    pub fn gather(&self, work: &mut Work, part: Part, rows: &[u32]) -> Result<Buffer> {
        let members = self.gpu.buffer("members", part.words * rows.len())?;
        let order = self.gpu.upload("order", rows)?;
        for piece in self.pieces {
            let shape = [piece.first, piece.count, rows.len()];
            let words = [ROW, part.from, part.words];
            let constants: Vec<u32> = shape.iter().chain(&words).map(|&n| n as u32).collect();
            let groups = rows.len().div_ceil(THREADS);
            let buffers = [&piece.rows, &order, &members];
            work.run(&GATHER, groups, &constants, &buffers)?;
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
    use crate::testing::{WHOLE, compare_on_gpu, scenes};

    #[test]
    fn rows_are_sent_once_a_round_and_all_are_found() {
        let (_, scene) = scenes(900).swap_remove(0);
        compare_on_gpu(&[WHOLE, 1 << 10], |gpu| {
            let mut held = Rows::default();
            let sent = |held: &mut Rows| {
                let before = gpu.sent();
                held.of(gpu, &scene).unwrap();
                (gpu.sent() - before) as usize
            };
            assert_eq!(sent(&mut held), 900 * 4 * ROW);
            assert_eq!(sent(&mut held), 0);
            held.clear();
            assert_eq!(sent(&mut held), 900 * 4 * ROW);
            let run = held.of(gpu, &scene).unwrap();
            for part in [POINTS, COLORED, WEIGHED] {
                let mut work = Work::new(gpu);
                let wanted = [42, 801, 3, 3, 800];
                let found = run.gather(&mut work, part, &wanted).unwrap();
                let found = work.submit(&[(&found, found.words())]).unwrap().take();
                let want = wanted.map(|row| words(&scene, row as usize, run.frame));
                let want = want.iter().flat_map(|w| &w[part.from..][..part.words]);
                assert!(want.eq(&found.unwrap()[0]));
            }
        });
    }
}
