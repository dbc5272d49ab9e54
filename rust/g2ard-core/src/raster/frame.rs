//! The passes in order, and the buffers they share: one view's worth, reused from call to call.

use std::time::Instant;

use rayon::prelude::*;

use super::accumulate::{Accumulate, Accumulated, Share, total};
use super::backward::{self, Backward, Incoming, SUMS};
use super::forward::{BATCH, Forward, Pixels, Place, Staged};
use super::gradients::{Gather, Gradients, Sink};
use super::order::{self, Key, Shared};
use super::params::{Params, Source};
use super::project::{Project, Splat, View};
use super::sensitivity::{GatherSensitivity, MOMENTS, Sensitivity, TRIANGLE};
use super::simd::{Isa, LANES, Row, dispatch};
use super::tiles::Bins;
use super::{BLOCKS, Camera, Settings};
use crate::{Error, Result};

/// Groups of sixteen rows projected as one piece of work.
const CHUNK: usize = 64;

/// Where the forward pass writes: row-major, `height × width` (× 3 interleaved).
#[derive(Debug)]
pub struct Image<'a> {
    pub rgb: &'a mut [f32],
    /// 1 − the light left.
    pub alpha: &'a mut [f32],
    /// Σ αT·z: *not* divided by alpha.
    pub depth: Option<&'a mut [f32]>,
    /// Depth of the first splat behind which less than half the light is left; 0 where there is none.
    pub median: Option<&'a mut [f32]>,
}

/// dL/d(image), dL/d(alpha), dL/d(depth), in the layouts of [`Image`].
#[derive(Debug, Clone, Copy)]
pub struct ImageGradients<'a> {
    pub rgb: &'a [f32],
    pub alpha: Option<&'a [f32]>,
    pub depth: Option<&'a [f32]>,
}

/// How much work the last forward pass was.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    pub visible: usize,
    pub pairs: usize,
    /// (pair, 4×4 block) evaluations that contributed to a pixel, in pixels (16 a block).
    pub evaluated: u64,
}

/// Seconds the passes of the last calls took.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Passes {
    pub project: f64,
    pub sort: f64,
    pub bin: f64,
    pub forward: f64,
    /// Tiles, from the image's gradient to the slots.
    pub backward: f64,
    /// From the slots to the parameters, and whatever the caller does with their gradient there.
    pub gather: f64,
}

/// Seconds since `from`, which becomes now.
fn lap(from: &mut Instant) -> f64 {
    let now = Instant::now();
    let seconds = now.duration_since(*from).as_secs_f64();
    *from = now;
    seconds
}

/// One chunk of rows after the backward pass: its visible splats and where their sums lie.
pub(crate) struct ChunkSums<'a> {
    pub view: &'a View,
    pub first_group: usize,
    pub last_group: usize,
    pub splats: &'a [Splat],
    pub slots: &'a [[f32; SUMS]],
    pub written: &'a [u8],
}

struct Frame {
    camera: Camera,
    settings: Settings,
    view: View,
    background: [f32; 3],
    rows: usize,
}

/// Renders one view and remembers what its backward pass needs; every buffer is reused by the next view.
pub struct Rasterizer {
    isa: Isa,
    frame: Option<Frame>,
    splats: Vec<Splat>,
    halves: Vec<[f32; 2]>,
    /// (first splat, number visible) of each chunk of rows.
    chunks: Vec<(usize, usize)>,
    order: Vec<Key>,
    spare: Vec<Key>,
    bins: Bins,
    /// First batch of each tile, and how many the forward pass looked at.
    batches: Vec<(usize, usize)>,
    words: Vec<[u64; BLOCKS]>,
    transmittance: Vec<[Row; BLOCKS]>,
    last: Vec<[Row; BLOCKS]>,
    slots: Vec<[f32; SUMS]>,
    shares: Vec<Share>,
    written: Vec<u8>,
    passes: Passes,
}

#[derive(Default)]
struct Scratch {
    staged: Staged,
    pixels: Pixels,
    incoming: Incoming,
}

impl Default for Rasterizer {
    fn default() -> Self {
        Self::new(Isa::detect())
    }
}

impl Rasterizer {
    pub fn new(isa: Isa) -> Self {
        Self {
            isa,
            frame: None,
            splats: Vec::new(),
            halves: Vec::new(),
            chunks: Vec::new(),
            order: Vec::new(),
            spare: Vec::new(),
            bins: Bins::default(),
            batches: Vec::new(),
            words: Vec::new(),
            transmittance: Vec::new(),
            last: Vec::new(),
            slots: Vec::new(),
            shares: Vec::new(),
            written: Vec::new(),
            passes: Passes::default(),
        }
    }

    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Renders a view.
    pub fn forward(
        &mut self,
        params: &Params,
        camera: &Camera,
        settings: &Settings,
        background: [f32; 3],
        image: &mut Image,
    ) -> Result<()> {
        params.validate()?;
        camera.validate()?;
        settings.validate()?;
        let pixels = camera.width * camera.height;
        for (name, got, expected) in [
            ("image", image.rgb.len(), 3 * pixels),
            ("alpha", image.alpha.len(), pixels),
            (
                "depth",
                image.depth.as_ref().map_or(pixels, |d| d.len()),
                pixels,
            ),
            (
                "median",
                image.median.as_ref().map_or(pixels, |d| d.len()),
                pixels,
            ),
        ] {
            if got != expected {
                return Err(Error::invalid(name, format!("{expected} values"), got));
            }
        }
        self.prepare(*params, camera, settings, background);
        let mut clock = Instant::now();
        if image.depth.is_some() || image.median.is_some() {
            self.blend::<true>(image);
        } else {
            self.blend::<false>(image);
        }
        self.passes.forward = lap(&mut clock);
        Ok(())
    }

    /// Goes back from the last forward pass; `params` must be the very ones it rendered.
    pub fn backward(
        &mut self,
        params: &Params,
        image: &ImageGradients,
        out: &mut Gradients,
    ) -> Result<()> {
        params.validate()?;
        out.validate(params)?;
        let sink = out.sink(params.sh_coeffs);
        self.backward_into(*params, image, sink)
    }

    pub(crate) fn backward_into<S: Source, K: Sink>(
        &mut self,
        source: S,
        image: &ImageGradients,
        sink: K,
    ) -> Result<()> {
        let Some(frame) = &self.frame else {
            return Err(Error::invalid(
                "backward",
                "a forward pass before it",
                "none",
            ));
        };
        let pixels = frame.camera.width * frame.camera.height;
        for (name, got, expected) in [
            ("rows", source.len(), frame.rows),
            ("image gradient", image.rgb.len(), 3 * pixels),
            (
                "alpha gradient",
                image.alpha.map_or(pixels, <[f32]>::len),
                pixels,
            ),
            (
                "depth gradient",
                image.depth.map_or(pixels, <[f32]>::len),
                pixels,
            ),
        ] {
            if got != expected {
                return Err(Error::invalid(name, expected.to_string(), got));
            }
        }
        let mut clock = Instant::now();
        if image.depth.is_some() {
            self.unblend::<true>(image);
        } else {
            self.unblend::<false>(image);
        }
        self.passes.backward = lap(&mut clock);
        let Some(frame) = &self.frame else {
            return Ok(());
        };
        self.chunks.par_iter().for_each(|&(first, count)| {
            let gather = Gather {
                view: &frame.view,
                source,
                sink,
                splats: &self.splats[first..first + count],
                slots: &self.slots,
                written: &self.written,
            };
            dispatch(self.isa, gather);
        });
        self.passes.gather = lap(&mut clock);
        Ok(())
    }

    /// Renders any source, image only.
    pub(crate) fn forward_from<S: Source>(
        &mut self,
        source: S,
        camera: &Camera,
        settings: &Settings,
        background: [f32; 3],
        image: &mut Image,
    ) {
        self.prepare(source, camera, settings, background);
        let mut clock = Instant::now();
        self.blend::<false>(image);
        self.passes.forward = lap(&mut clock);
    }

    /// Fills the slots, then calls `finish(chunk, slots of the chunk's splats)` for every chunk of rows, in parallel,
    /// and returns what the calls do, in order.
    pub(crate) fn backward_by_chunk<T: Send>(
        &mut self,
        image: &ImageGradients,
        finish: impl Fn(&ChunkSums) -> T + Sync,
    ) -> Vec<T> {
        let mut clock = Instant::now();
        self.unblend::<false>(image);
        self.passes.backward = lap(&mut clock);
        let Some(frame) = &self.frame else {
            return Vec::new();
        };
        let groups = frame.rows.div_ceil(LANES);
        let finish = |(chunk, &(first, count)): (usize, &(usize, usize))| {
            finish(&ChunkSums {
                view: &frame.view,
                first_group: chunk * CHUNK,
                last_group: groups.min((chunk + 1) * CHUNK),
                splats: &self.splats[first..first + count],
                slots: &self.slots,
                written: &self.written,
            })
        };
        let results = self.chunks.par_iter().enumerate().map(finish).collect();
        self.passes.gather = lap(&mut clock);
        results
    }

    /// Renders a view without an image and adds what every Gaussian contributes to it.
    pub fn accumulate(
        &mut self,
        params: &Params,
        camera: &Camera,
        settings: &Settings,
        sums: &mut Accumulated,
    ) -> Result<()> {
        params.validate()?;
        camera.validate()?;
        settings.validate()?;
        if sums.weight.len() != params.len() {
            return Err(Error::invalid(
                "accumulate",
                format!("sums of {} rows", params.len()),
                sums.weight.len(),
            ));
        }
        let colourless = Params {
            sh_n: &[],
            sh_coeffs: 1,
            ..*params
        };
        self.prepare(colourless, camera, settings, [0.0; 3]);
        self.accumulate_tiles();
        for &(first, count) in &self.chunks {
            for splat in &self.splats[first..first + count] {
                let (weight, transmittance, hits, dominant, peak) =
                    total(splat, &self.shares, &self.written);
                let row = splat.row as usize;
                sums.weight[row] += weight;
                sums.transmittance[row] += transmittance;
                sums.hits[row] += hits;
                sums.dominant[row] += dominant;
                sums.peak[row] = sums.peak[row].max(peak);
            }
        }
        smallest_pixels(params, camera, &mut sums.pixel_size);
        self.frame = None; // nothing was blended that a backward pass could go back from
        Ok(())
    }

    /// Renders a view over black and adds to every Gaussian's F, 21 values of the upper triangle a row: see
    /// [`super::sensitivity`].
    pub fn sensitivity(
        &mut self,
        params: &Params,
        camera: &Camera,
        settings: &Settings,
        sums: &mut [f64],
    ) -> Result<()> {
        if settings.antialiased {
            return Err(Error::invalid("sensitivity", "no antialiasing", "some"));
        }
        if sums.len() != TRIANGLE * params.len() {
            let expected = format!("{TRIANGLE} values for each of {} rows", params.len());
            return Err(Error::invalid("sensitivity", expected, sums.len()));
        }
        let pixels = camera.width * camera.height;
        let mut image = Image {
            rgb: &mut vec![0.0; 3 * pixels],
            alpha: &mut vec![0.0; pixels],
            depth: None,
            median: None,
        };
        self.forward(params, camera, settings, [0.0; 3], &mut image)?;
        let slots = self.sensitivity_tiles();
        let Some(frame) = &self.frame else {
            return Ok(());
        };
        let out = Shared::new(sums);
        self.chunks.par_iter().for_each(|&(first, count)| {
            let gather = GatherSensitivity {
                view: &frame.view,
                source: *params,
                splats: &self.splats[first..first + count],
                slots: &slots,
                written: &self.written,
                out,
            };
            dispatch(self.isa, gather);
        });
        Ok(())
    }

    /// How long the last calls' passes took.
    pub fn passes(&self) -> Passes {
        self.passes
    }

    pub fn counts(&self) -> Counts {
        let words = self
            .batches
            .iter()
            .flat_map(|&(first, done)| &self.words[first..first + done]);
        let blocks: u64 = words.flatten().map(|w| u64::from(w.count_ones())).sum();
        Counts {
            visible: self.order.len(),
            pairs: self.bins.pairs.len(),
            evaluated: blocks * LANES as u64,
        }
    }

    /// Projects, sorts and bins.
    pub(crate) fn prepare<S: Source>(
        &mut self,
        source: S,
        camera: &Camera,
        settings: &Settings,
        background: [f32; 3],
    ) {
        let view = View::new(camera, settings);
        self.frame = Some(Frame {
            camera: *camera,
            settings: *settings,
            view,
            background,
            rows: source.len(),
        });
        let mut clock = Instant::now();
        self.project(&view, source);
        self.passes.project = lap(&mut clock);
        self.collect_keys();
        order::sort(&mut self.order, &mut self.spare);
        self.passes.sort = lap(&mut clock);
        self.bins.fill(
            self.isa,
            &self.order,
            &mut self.splats,
            &self.halves,
            &self.chunks,
            camera.tiles(),
        );
        self.passes.bin = lap(&mut clock);
        self.batches.clear();
        let mut first = 0;
        for tile in self.bins.starts.windows(2) {
            self.batches.push((first, 0));
            first += ((tile[1] - tile[0]) as usize).div_ceil(BATCH);
        }
        self.words.resize(first, [0; BLOCKS]);
    }

    fn project<S: Source>(&mut self, view: &View, source: S) {
        let groups = source.len().div_ceil(LANES);
        let isa = self.isa;
        self.splats.resize(groups * LANES, Splat::default());
        self.halves.resize(groups * LANES, [0.0; 2]);
        let halves = self.halves.par_chunks_mut(CHUNK * LANES);
        self.splats
            .par_chunks_mut(CHUNK * LANES)
            .zip(halves)
            .enumerate()
            .map(|(chunk, (out, halves))| {
                let first = chunk * CHUNK;
                let last = groups.min(first + CHUNK);
                (
                    first * LANES,
                    dispatch(
                        isa,
                        Project {
                            view,
                            source,
                            first,
                            last,
                            out,
                            halves,
                        },
                    ),
                )
            })
            .collect_into_vec(&mut self.chunks);
    }

    fn collect_keys(&mut self) {
        self.order.clear();
        for &(first, count) in &self.chunks {
            let visible = self.splats[first..first + count].iter().enumerate();
            self.order.extend(visible.map(|(i, splat)| Key {
                depth: splat.depth.to_bits(),
                splat: (first + i) as u32,
            }));
        }
    }

    /// Blends every tile into the image.
    pub(crate) fn blend<const DEPTH: bool>(&mut self, image: &mut Image) {
        let Some(frame) = &self.frame else { return };
        let (camera, background) = (frame.camera, frame.background);
        let tiles_x = camera.tiles().0;
        let tiles = self.batches.len();
        self.transmittance.resize(tiles, [Row::default(); BLOCKS]);
        self.last.resize(tiles, [Row::default(); BLOCKS]);
        let words = Shared::new(&mut self.words);
        let rgb = Shared::new(image.rgb);
        let alpha = Shared::new(image.alpha);
        let depth = image.depth.as_deref_mut().map(Shared::new);
        let median = image.median.as_deref_mut().map(Shared::new);
        let (bins, splats, isa) = (&self.bins, &self.splats, self.isa);
        let tile_states = self
            .batches
            .par_iter_mut()
            .zip(&mut self.transmittance)
            .zip(&mut self.last);
        tile_states.enumerate().for_each_init(
            Scratch::default,
            |scratch, (tile, ((batch, transmittance), last))| {
                let pairs = &bins.pairs[bins.starts[tile] as usize..bins.starts[tile + 1] as usize];
                let place = Place::of(tile, tiles_x, camera.width, camera.height);
                // SAFETY: every tile has its own batches, and the pixels written below are its own.
                let words = unsafe { words.slice(batch.0, pairs.len().div_ceil(BATCH)) };
                let forward = Forward::<DEPTH> {
                    pairs,
                    splats,
                    place,
                    settings: &frame.settings,
                    words,
                    transmittance,
                    last,
                    pixels: &mut scratch.pixels,
                    staged: &mut scratch.staged,
                };
                batch.1 = dispatch(isa, forward);
                let pixels = &scratch.pixels;
                for y in 0..place.rows {
                    let first = (place.y + y) * camera.width + place.x;
                    // SAFETY: as above.
                    let (rgb, alpha) = unsafe {
                        (
                            rgb.slice(3 * first, 3 * place.columns),
                            alpha.slice(first, place.columns),
                        )
                    };
                    for (x, (rgb, alpha)) in rgb.chunks_exact_mut(3).zip(alpha).enumerate() {
                        let (block, l) = (y / 4 * 4 + x / 4, y % 4 * 4 + x % 4);
                        let t = transmittance[block].0[l];
                        *alpha = 1.0 - t;
                        for c in 0..3 {
                            rgb[c] = pixels.rgb[c][block].0[l] + t * background[c];
                        }
                    }
                    for (plane, rows) in [(depth, &pixels.depth), (median, &pixels.median)] {
                        let Some(plane) = plane else { continue };
                        // SAFETY: as above.
                        let row = unsafe { plane.slice(first, place.columns) };
                        for (x, value) in row.iter_mut().enumerate() {
                            *value = rows[y / 4 * 4 + x / 4].0[y % 4 * 4 + x % 4];
                        }
                    }
                }
            },
        );
    }

    /// Fills the slots with every pair's share of the gradient.
    fn unblend<const DEPTH: bool>(&mut self, image: &ImageGradients) {
        self.clear_slots();
        let Some(frame) = &self.frame else { return };
        let camera = &frame.camera;
        let tiles_x = camera.tiles().0;
        let slots = Shared::new(&mut self.slots);
        let written = Shared::new(&mut self.written);
        let (bins, splats, isa) = (&self.bins, &self.splats, self.isa);
        let states = self
            .batches
            .par_iter()
            .zip(&self.transmittance)
            .zip(&self.last);
        states.enumerate().for_each_init(
            Scratch::default,
            |scratch, (tile, ((batch, transmittance), last))| {
                let pairs = &bins.pairs[bins.starts[tile] as usize..bins.starts[tile + 1] as usize];
                if pairs.is_empty() {
                    return;
                }
                let place = Place::of(tile, tiles_x, camera.width, camera.height);
                let incoming = &mut scratch.incoming;
                incoming.load(backward::RGB, image.rgb, 3, camera.width, &place);
                if let Some(alpha) = image.alpha {
                    incoming.load(backward::ALPHA, alpha, 1, camera.width, &place);
                }
                if let Some(depth) = image.depth {
                    incoming.load(backward::DEPTH, depth, 1, camera.width, &place);
                }
                let backward = Backward::<DEPTH> {
                    pairs,
                    splats,
                    place,
                    settings: &frame.settings,
                    background: frame.background,
                    words: &self.words[batch.0..batch.0 + batch.1],
                    transmittance,
                    last,
                    incoming,
                    staged: &mut scratch.staged,
                    slots,
                    written,
                };
                dispatch(isa, backward);
            },
        );
    }

    fn accumulate_tiles(&mut self) {
        let pairs = self.bins.pairs.len();
        self.shares.resize(pairs, Share::default());
        self.written.clear();
        self.written.resize(pairs, 0);
        let Some(frame) = &self.frame else { return };
        let camera = &frame.camera;
        let tiles_x = camera.tiles().0;
        let slots = Shared::new(&mut self.shares);
        let written = Shared::new(&mut self.written);
        let (bins, splats, isa) = (&self.bins, &self.splats, self.isa);
        (0..self.batches.len())
            .into_par_iter()
            .for_each_init(Staged::default, |staged, tile| {
                let accumulate = Accumulate {
                    pairs: &bins.pairs[bins.starts[tile] as usize..bins.starts[tile + 1] as usize],
                    splats,
                    place: Place::of(tile, tiles_x, camera.width, camera.height),
                    settings: &frame.settings,
                    staged,
                    slots,
                    written,
                };
                dispatch(isa, accumulate);
            });
    }

    fn sensitivity_tiles(&mut self) -> Vec<[f32; MOMENTS]> {
        self.clear_slots();
        let mut sums = vec![[0.0; MOMENTS]; self.bins.pairs.len()];
        let Some(frame) = &self.frame else {
            return sums;
        };
        let camera = &frame.camera;
        let tiles_x = camera.tiles().0;
        let slots = Shared::new(&mut sums);
        let written = Shared::new(&mut self.written);
        let (bins, splats, isa) = (&self.bins, &self.splats, self.isa);
        let states = self
            .batches
            .par_iter()
            .zip(&self.transmittance)
            .zip(&self.last);
        states.enumerate().for_each_init(
            Staged::default,
            |staged, (tile, ((batch, transmittance), last))| {
                let sensitivity = Sensitivity {
                    pairs: &bins.pairs[bins.starts[tile] as usize..bins.starts[tile + 1] as usize],
                    splats,
                    place: Place::of(tile, tiles_x, camera.width, camera.height),
                    settings: &frame.settings,
                    words: &self.words[batch.0..batch.0 + batch.1],
                    transmittance,
                    last,
                    staged,
                    slots,
                    written,
                };
                dispatch(isa, sensitivity);
            },
        );
        sums
    }

    /// Slots keep stale sums: `written` says which of them count.
    fn clear_slots(&mut self) {
        let pairs = self.bins.pairs.len();
        self.slots.resize(pairs, [0.0; SUMS]);
        self.written.clear();
        self.written.resize(pairs, 0);
    }
}

/// Lowers each row's pixel size to depth / focal length where the mean falls inside the image.
fn smallest_pixels(params: &Params, camera: &Camera, sizes: &mut [f32]) {
    let focal = camera.fx.max(camera.fy);
    let (width, height) = (camera.width as f64, camera.height as f64);
    sizes
        .par_iter_mut()
        .zip(params.means.par_chunks_exact(3))
        .for_each(|(size, mean)| {
            let p = camera.viewmat.map(|r| {
                r[0] * f64::from(mean[0])
                    + r[1] * f64::from(mean[1])
                    + r[2] * f64::from(mean[2])
                    + r[3]
            });
            if p[2] < f64::from(camera.near) {
                return;
            }
            let x = camera.fx * p[0] / p[2] + camera.cx;
            let y = camera.fy * p[1] / p[2] + camera.cy;
            if (0.0..=width).contains(&x) && (0.0..=height).contains(&y) {
                *size = size.min((p[2] / focal) as f32);
            }
        });
}
