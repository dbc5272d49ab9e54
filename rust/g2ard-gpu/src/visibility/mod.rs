//! Twin of `g2ard_core::select`'s visibility: the median depth of a view, and what it shows.
//!
//! A view takes two trips. The first projects all rows, marks those that the image may show and counts the tiles
//! they touch. With the counts known, the second sorts the marked ones by depth, spreads them over their tiles and
//! draws. While one view is drawn the next is projected. Arithmetic is f32, as on the CPU; drivers may fuse
//! operations and round divisions and exponentials otherwise, so ties within that rounding may fall elsewhere.

mod tiles;

use g2ard_core::Control;
use g2ard_core::raster::Camera;
use g2ard_core::select::{Gaussians, Opaque, Pinhole, Row, Surface, look_of};

use crate::runtime::{Buffer, Error, Gpu, Kernel, Pending, Result, Work};
use crate::scan;

const LOOK: &[&str] = &[include_str!("pinhole.wgsl"), include_str!("look.wgsl")];
const MARK: Kernel = Kernel {
    name: "visibility.look",
    sources: LOOK,
    entry: "look",
};
const DEPTHS: Kernel = Kernel {
    name: "visibility.depths",
    sources: LOOK,
    entry: "depths",
};
const GATHER: Kernel = Kernel {
    name: "visibility.gather",
    sources: LOOK,
    entry: "gather",
};
const CELLS: &[&str] = &[include_str!("pinhole.wgsl"), include_str!("cells.wgsl")];
const WANT: Kernel = Kernel {
    name: "visibility.want",
    sources: CELLS,
    entry: "want",
};
const SEEN: Kernel = Kernel {
    name: "visibility.seen",
    sources: CELLS,
    entry: "seen",
};

/// Rows of a workgroup; pieces of the scene are multiples of it.
const BLOCK: usize = 256;
const THREADS: usize = 64;
/// Words of a row, of a splat, of a cell's centre.
const ROW: usize = 12;
const SPLAT: usize = 9;
const CENTER: usize = 3;
/// Depths are told apart by these upper bits, sign not among them, where a scene is drawn in slabs.
const DEPTH_SHIFT: u32 = 19;
const DEPTH_BINS: usize = 1 << (31 - DEPTH_SHIFT);
/// Beyond every depth.
const FAR: u32 = f32::INFINITY.to_bits();
/// Pairs of splat and tile that prefix sums can count.
const MAX_PAIRS: u64 = 1 << 31;
/// Spans of pixels are 16 bits.
const MAX_SIDE: usize = u16::MAX as usize;

/// See [`g2ard_core::select::looks`].
pub fn looks(
    gpu: &Gpu,
    scene: &Gaussians<'_>,
    cameras: &[Camera],
    control: &Control,
) -> Result<Vec<[f32; 2]>> {
    let scene = Scene::upload(gpu, scene)?;
    let read = |words: &[u32]| look_of(bytemuck::cast_slice(words));
    scene.each(cameras, None, control, read)
}

/// See [`g2ard_core::select::visible`].
pub fn visible(
    gpu: &Gpu,
    scene: &Gaussians<'_>,
    surface: &Surface,
    cameras: &[Camera],
    control: &Control,
) -> Result<Vec<Vec<u32>>> {
    let scene = Scene::upload(gpu, scene)?;
    let centers: Vec<[f32; 3]> = surface
        .centers
        .iter()
        .map(|c| c.map(|v| v as f32))
        .collect();
    let cells = Cells {
        count: centers.len(),
        pieces: centers
            .chunks((gpu.max_words() / CENTER / 32).max(1) * 32)
            .map(|piece| gpu.upload("cells", piece))
            .collect::<Result<_>>()?,
        size: surface.size as f32,
    };
    scene.each(cameras, Some(&cells), control, |words| {
        let bit = |cell: &u32| words[*cell as usize / 32] >> (cell % 32) & 1 == 1;
        (0..cells.count as u32).filter(bit).collect()
    })
}

/// Centres of cells on the device, in pieces of whole words of 32.
struct Cells {
    count: usize,
    pieces: Vec<Buffer>,
    size: f32,
}

/// Rows on the device, in pieces, for all views.
struct Scene<'a> {
    gpu: &'a Gpu,
    count: usize,
    pieces: Vec<Buffer>,
}

/// A view whose rows are being marked.
struct Begun<'a> {
    view: Pinhole,
    light: Buffer,
    marked: Marked<'a>,
}

struct Marked<'a> {
    marks: Buffer,
    pending: Pending<'a>,
}

impl<'a> Scene<'a> {
    fn upload(gpu: &'a Gpu, scene: &Gaussians<'_>) -> Result<Self> {
        let opaque = Opaque::of(scene);
        let piece = (gpu.max_words() / ROW / BLOCK).max(1) * BLOCK;
        Ok(Self {
            gpu,
            count: opaque.rows.len(),
            pieces: opaque
                .rows
                .chunks(piece)
                .map(|rows| gpu.upload("rows", &rows.iter().map(words_of).collect::<Vec<_>>()))
                .collect::<Result<_>>()?,
        })
    }

    /// What `read` makes of each view's answer: its depths, or with `cells` a bit for each.
    fn each<T>(
        &self,
        cameras: &[Camera],
        cells: Option<&Cells>,
        control: &Control,
        read: impl Fn(&[u32]) -> T,
    ) -> Result<Vec<T>> {
        control.begin(cameras.len() as u64);
        let mut found = Vec::with_capacity(cameras.len());
        let mut begun = None;
        let mut drawn: Option<Pending> = None;
        for camera in cameras.iter().map(Some).chain([None]) {
            control.check()?;
            let next = camera.map(|c| self.begin(c, cells)).transpose()?;
            let drawing = match begun.take() {
                Some(view) => Some(self.finish(view, cells)?),
                None => None,
            };
            if let Some(done) = std::mem::replace(&mut drawn, drawing) {
                found.push(read(&done.take()?.concat()));
                control.advance(1);
            }
            begun = next;
        }
        if let Some(done) = drawn {
            found.push(read(&done.take()?.concat()));
            control.advance(1);
        }
        Ok(found)
    }

    fn begin(&self, camera: &Camera, cells: Option<&Cells>) -> Result<Begun<'a>> {
        let view = Pinhole::of(camera);
        let (pixels, side) = (view.width * view.height, view.width.max(view.height));
        if side > MAX_SIDE {
            return Err(Error::TooLarge {
                what: "a side of a view",
                bytes: side as u64,
                limit: MAX_SIDE as u64,
            });
        }
        let mut work = Work::new(self.gpu);
        let light = if let Some(cells) = cells {
            let light = self.gpu.buffer("light", pixels)?;
            for piece in &cells.pieces {
                let count = piece.words() / CENTER;
                let constants = Constants::new(&view, count).words();
                work.run(&WANT, count.div_ceil(THREADS), &constants, &[piece, &light])?;
            }
            light
        } else {
            self.gpu.upload("light", &vec![1f32; pixels])?
        };
        let marked = self.mark(work, &view, 0..FAR)?;
        Ok(Begun {
            view,
            light,
            marked,
        })
    }

    /// Each piece with its first row.
    fn pieces(&self) -> impl Iterator<Item = (usize, usize, &Buffer)> {
        let mut first = 0;
        self.pieces.iter().map(move |piece| {
            let count = piece.words() / ROW;
            first += count;
            (first - count, count, piece)
        })
    }

    /// Marks the rows that the view may show at depths (as bits) within `range`.
    fn mark(
        &self,
        mut work: Work<'a>,
        view: &Pinhole,
        range: std::ops::Range<u32>,
    ) -> Result<Marked<'a>> {
        let blocks = self.count.div_ceil(BLOCK);
        let marks = self.gpu.buffer("marks", self.count + 1)?;
        let tiles = self.gpu.buffer("tiles", blocks)?;
        for (first, count, piece) in self.pieces() {
            let constants = Constants {
                first,
                range: range.clone(),
                ..Constants::new(view, count)
            };
            let buffers = [piece, &marks, &tiles];
            work.run(&MARK, count.div_ceil(BLOCK), &constants.words(), &buffers)?;
        }
        let total = scan::exclusive(self.gpu, &mut work, &marks, self.count + 1)?;
        let pending = work.submit(&[(&total, 1), (&tiles, blocks)])?;
        Ok(Marked { marks, pending })
    }

    fn finish(&self, begun: Begun<'a>, cells: Option<&Cells>) -> Result<Pending<'a>> {
        let Begun {
            view,
            light,
            marked,
        } = begun;
        let depth = self.gpu.buffer("depth", view.width * view.height)?;
        let image = [&light, &depth];
        let (marks, splats, pairs) = marked.counted()?;
        let mut work = Work::new(self.gpu);
        if splats <= self.gpu.max_words() / SPLAT && pairs < MAX_PAIRS {
            self.draw(&mut work, &view, &marks, (splats, pairs), image)?;
        } else {
            for range in self.slabs(&view)? {
                let marked = self.mark(Work::new(self.gpu), &view, range)?;
                let (marks, splats, pairs) = marked.counted()?;
                if pairs >= MAX_PAIRS {
                    return Err(self.crowded(pairs));
                }
                self.draw(&mut work, &view, &marks, (splats, pairs), image)?;
            }
        }
        let Some(cells) = cells else {
            return work.submit(&[(&depth, depth.words())]);
        };
        let mut answers = Vec::new();
        for piece in &cells.pieces {
            let count = piece.words() / CENTER;
            let constants = Constants {
                cell: cells.size,
                ..Constants::new(&view, count)
            };
            let bits = self.gpu.buffer("seen", count.div_ceil(32))?;
            let bound = [(1, piece), (3, &depth), (4, &bits)];
            let groups = count.div_ceil(32).div_ceil(THREADS);
            work.run_at(&SEEN, groups, &constants.words(), &bound)?;
            answers.push(bits);
        }
        let reads: Vec<_> = answers.iter().map(|bits| (bits, bits.words())).collect();
        work.submit(&reads)
    }

    /// Ranges of depth that each hold no more splats than fit, nearest first.
    fn slabs(&self, view: &Pinhole) -> Result<Vec<std::ops::Range<u32>>> {
        let histogram = self.gpu.buffer("depths", DEPTH_BINS)?;
        let mut work = Work::new(self.gpu);
        for (_, count, piece) in self.pieces() {
            let constants = Constants::new(view, count).words();
            let bound = [(1, piece), (4, &histogram)];
            work.run_at(&DEPTHS, count.div_ceil(BLOCK), &constants, &bound)?;
        }
        let counts = work.submit(&[(&histogram, DEPTH_BINS)])?.take()?;
        let most = self.gpu.max_words() / SPLAT;
        let (mut slabs, mut first, mut held) = (Vec::new(), 0, 0);
        for (bin, &count) in counts[0].iter().enumerate() {
            let count = count as usize;
            if count > most {
                return Err(self.crowded(count as u64));
            }
            if held + count > most {
                slabs.push((first as u32) << DEPTH_SHIFT..(bin as u32) << DEPTH_SHIFT);
                (first, held) = (bin, 0);
            }
            held += count;
        }
        slabs.push((first as u32) << DEPTH_SHIFT..FAR);
        Ok(slabs)
    }

    fn crowded(&self, splats: u64) -> Error {
        Error::TooLarge {
            what: "a view's splats at one depth",
            bytes: 4 * SPLAT as u64 * splats,
            limit: 4 * self.gpu.max_words() as u64,
        }
    }
}

impl Marked<'_> {
    /// The marks, summed, how many there are, and how many tiles they touch.
    fn counted(self) -> Result<(Buffer, usize, u64)> {
        let found = self.pending.take()?;
        let count = found[0].first().map_or(0, |&n| n as usize);
        let pairs = found[1].iter().map(|&t| u64::from(t)).sum();
        Ok((self.marks, count, if count == 0 { 0 } else { pairs }))
    }
}

fn words_of(row: &Row) -> [u32; ROW] {
    let mut words = [0; ROW];
    let numbers = row.mean.iter().chain([&row.opacity]);
    let numbers = numbers
        .chain(&row.covariance)
        .chain([&row.trace, &row.reach]);
    words
        .iter_mut()
        .zip(numbers)
        .for_each(|(word, number)| *word = number.to_bits());
    words
}

/// `View` of pinhole.wgsl.
struct Constants<'a> {
    view: &'a Pinhole,
    count: usize,
    first: usize,
    range: std::ops::Range<u32>,
    cell: f32,
}

impl<'a> Constants<'a> {
    fn new(view: &'a Pinhole, count: usize) -> Self {
        Self {
            view,
            count,
            first: 0,
            range: 0..FAR,
            cell: 0.0,
        }
    }

    fn words(&self) -> Vec<u32> {
        let v = self.view;
        let mut numbers = Vec::with_capacity(28);
        for (row, shift) in v.rotation.iter().zip(v.translation) {
            numbers.extend(row);
            numbers.push(shift);
        }
        numbers.extend(v.focal);
        numbers.extend(v.center);
        numbers.extend(v.limits.as_flattened());
        let mut words: Vec<u32> = numbers.into_iter().map(f32::to_bits).collect();
        words.extend([v.width as u32, v.height as u32, v.near.to_bits()]);
        words.extend([self.count as u32, self.first as u32]);
        words.extend([self.range.start, self.range.end, self.cell.to_bits()]);
        words
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::Options;
    use crate::testing::{gpu, gpu_with, scenes};
    use g2ard_core::{Backend, Cpu};

    /// Looks from all around, from within, and from far away.
    fn cameras(center: [f64; 3], radius: f64) -> Vec<Camera> {
        (0..6)
            .map(|i| {
                let (a, d) = (f64::from(i) * 1.1, radius * [2.0, 1.2, 0.3][i as usize % 3]);
                let (s, c) = a.sin_cos();
                let turn = [
                    [c, -s, 0.0],
                    [-0.3 * s, -0.3 * c, -0.954],
                    [0.954 * s, 0.954 * c, -0.3],
                ];
                let shift = |r: usize| {
                    let at: f64 = (0..3).map(|k| turn[r][k] * center[k]).sum();
                    if r == 2 { d - at } else { -at }
                };
                Camera {
                    viewmat: [0, 1, 2].map(|r| [turn[r][0], turn[r][1], turn[r][2], shift(r)]),
                    fx: 150.0,
                    fy: 160.0,
                    cx: 71.0,
                    cy: 49.5,
                    width: 150,
                    height: 101,
                    near: 0.01,
                }
            })
            .collect()
    }

    fn compare(gpu: &Gpu, what: &str) {
        let control = Control::default();
        let (mut same, mut all) = (0, 0);
        for (name, splats) in scenes(6000) {
            let (center, radius) = match name {
                "at UTM offsets" => continue, // callers centre the scene
                _ => ([0.0, 0.0, 0.5], 5.0),
            };
            let opacities: Vec<f32> = splats
                .logit_opacities
                .iter()
                .map(|&x| 1.0 / (1.0 + (-x).exp()))
                .collect();
            let scene = Gaussians {
                means: &splats.means,
                quats: &splats.quats,
                scales: &splats.scales,
                opacities: &opacities,
            };
            let surface = Surface::of(&scene, 2000, &Cpu).unwrap();
            let cameras = cameras(center, radius);
            let want = Cpu.visible(&scene, &surface, &cameras, &control).unwrap();
            let got = visible(gpu, &scene, &surface, &cameras, &control);
            if name == "identical" && matches!(got, Err(Error::TooLarge { .. })) {
                continue; // no slab is thin enough: the CPU's
            }
            let got = got.unwrap();
            let equal: usize = want
                .iter()
                .zip(&got)
                .map(|(a, b)| {
                    let (a, b): (std::collections::HashSet<_>, std::collections::HashSet<_>) =
                        (a.iter().collect(), b.iter().collect());
                    surface.len() - a.symmetric_difference(&b).count()
                })
                .sum();
            let cells = surface.len() * cameras.len();
            let seen: usize = want.iter().map(Vec::len).sum();
            eprintln!("{what} {name}: {equal} of {cells} cells alike, {seen} of them seen");
            same += equal;
            all += cells;
            let want = Cpu.looks(&scene, &cameras, &control).unwrap();
            let got = looks(gpu, &scene, &cameras, &control).unwrap();
            for (a, b) in want.iter().zip(&got) {
                let close = |k: usize| (a[k] - b[k]).abs() <= 1e-4 * a[k].abs();
                assert!(close(0) && close(1), "{name}: {a:?} {b:?}");
            }
        }
        let share = same as f64 / all as f64;
        eprintln!("{what}: {:.4} % of visible sets equal", 100.0 * share);
        assert!(share >= 0.9999);
    }

    #[test]
    fn views_see_the_cells_they_see_on_the_cpu() {
        let Some(gpu) = gpu("visibility") else { return };
        compare(&gpu, "visibility");
    }

    #[test]
    fn views_see_the_same_in_pieces_and_slabs() {
        let max_binding = Some(1 << 16);
        let Some(gpu) = gpu_with(
            "visibility in pieces",
            Options {
                max_binding,
                ..Options::default()
            },
        ) else {
            return;
        };
        compare(&gpu, "visibility in pieces");
    }

    #[test]
    fn a_crowded_tile_is_drawn_to_its_end() {
        let Some(gpu) = gpu("a crowded tile") else {
            return;
        };
        // A crowd in one corner, and behind it what fills the image.
        let mut means = vec![[-0.49, -0.49, 0.0]; 70_000];
        means.push([0.0, 0.0, 1.0]);
        let n = means.len();
        let mut scales = vec![[0.01f32; 3]; n];
        scales[n - 1] = [2.0, 2.0, 0.01];
        let scene = Gaussians {
            means: &means,
            quats: &vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: &scales,
            opacities: &vec![0.9; n],
        };
        let camera = Camera {
            viewmat: [
                [1.0, 0.0, 0.0, 0.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 1.0],
            ],
            fx: 16.0,
            fy: 16.0,
            cx: 8.0,
            cy: 8.0,
            width: 16,
            height: 16,
            near: 0.01,
        };
        let control = Control::default();
        let want = Cpu.looks(&scene, &[camera], &control).unwrap();
        assert_eq!(want, [[1.0, 2.0]]);
        assert_eq!(looks(&gpu, &scene, &[camera], &control).unwrap(), want);
    }

    #[test]
    fn the_same_twice() {
        let Some(gpu) = gpu("visibility, twice") else {
            return;
        };
        let (_, splats) = scenes(3000).swap_remove(0);
        let scene = Gaussians {
            means: &splats.means,
            quats: &splats.quats,
            scales: &splats.scales,
            opacities: &vec![0.4; splats.len()],
        };
        let cameras = cameras([0.0; 3], 5.0);
        let look = || looks(&gpu, &scene, &cameras, &Control::default()).unwrap();
        assert_eq!(look(), look());
    }
}
