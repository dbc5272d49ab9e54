//! Visibility of a whole scene in little memory: each view projects only the groups of rows around its frustum.

mod groups;

use std::any::Any;
use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use crate::raster::accumulate::{SQUARED, Total};
use crate::raster::bounds::Bounds;
use crate::raster::disjoint::DisjointSlice;
use crate::raster::frustum::Frustum;
use crate::raster::grid::TileGrid;
use crate::raster::params::check_count;
use crate::raster::simd::LANES;
use crate::raster::{Camera, Rasterizer, Settings};
use crate::scene::{Means, Ordered, SceneRef};
use crate::{Control, Cpu, Result};
use groups::{Group, VisibleGroup, VisibleGroups};

/// Kernels over a scene that views look at. An implementation may differ from [`Cpu`]'s within a stated tolerance.
pub trait VisibilityKernels: Sync {
    /// Adds views in the scene's coordinates.
    fn add_views(
        &self,
        sums: &mut VisibilityAccumulator,
        cameras: &[Camera],
        settings: &Settings,
        control: &Control,
    ) -> Result<()>;
}

impl VisibilityKernels for Cpu {
    fn add_views(
        &self,
        sums: &mut VisibilityAccumulator,
        cameras: &[Camera],
        settings: &Settings,
        control: &Control,
    ) -> Result<()> {
        control.begin(cameras.len() as u64);
        for camera in cameras {
            control.check()?;
            sums.add(camera, settings)?;
            control.advance(1);
        }
        Ok(())
    }
}

/// Σ αT² and the smallest pixel of each of N Gaussians over the views added so far. The result depends neither on the
/// order of the rows nor on the number of threads: equal depths are drawn in the order of the scene's content.
pub struct VisibilityAccumulator {
    groups: Vec<Group>,
    bounds: Vec<Bounds>,
    /// Around [`BLOCK`] groups each.
    blocks: Vec<Bounds>,
    ordered: Arc<Ordered>,
    /// Origin of f64 means; f32 means are used as they are.
    shift: [f64; 3],
    weight: Vec<f64>,
    pixel_size: Vec<f32>,
    /// The largest pixel size of each group: a view from farther away lowers none.
    largest: Vec<f32>,
    rasterizer: Rasterizer,
    /// Most groups that a band of the image may meet, unless one row of tiles meets more.
    groups_per_band: usize,
    /// Data that a device keeps of the scene between calls.
    pub held: Option<Box<dyn Any + Send + Sync>>,
}

impl VisibilityAccumulator {
    pub fn new(scene: &SceneRef, ordered: Arc<Ordered>) -> Result<Self> {
        check_count(scene.len())?;
        let shift = match scene.means {
            Means::F32(_) => [0.0; 3],
            Means::F64(_) => ordered.bounds.origin,
        };
        let rows = ordered.rows.par_chunks(LANES);
        let (groups, bounds): (Vec<_>, Vec<_>) = rows.map(|r| Group::of(scene, r, shift)).unzip();
        Ok(Self {
            largest: vec![f32::INFINITY; groups.len()],
            blocks: bounds.par_chunks(BLOCK).map(Bounds::around).collect(),
            bounds,
            groups,
            weight: vec![0.0; scene.len()],
            pixel_size: vec![f32::INFINITY; scene.len()],
            ordered,
            shift,
            rasterizer: Rasterizer::default(),
            groups_per_band: GROUPS_PER_BAND,
            held: None,
        })
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.weight.len()
    }

    /// Mean, quaternion, scales and logit of a Gaussian, numbered in the order of the scene's content.
    pub fn row(&self, number: usize) -> [f32; 11] {
        self.groups[number / LANES].row(number % LANES)
    }

    /// A camera in the coordinates of the shifted means.
    pub fn relative(&self, camera: &Camera) -> Camera {
        let mut camera = *camera;
        for r in &mut camera.viewmat {
            r[3] += r[0] * self.shift[0] + r[1] * self.shift[1] + r[2] * self.shift[2];
        }
        camera
    }

    /// Adds views whose Σ αT² per Gaussian, `weights`, another device computed.
    pub fn add_sums(&mut self, cameras: &[Camera], weights: &[f32]) {
        for (sum, &weight) in self.weight.iter_mut().zip(weights) {
            *sum += f64::from(weight);
        }
        for camera in cameras {
            let camera = self.relative(camera);
            let frustum = Frustum::of(&camera);
            let visible = self.visible_groups(&frustum);
            self.lower_pixel_sizes(&camera, &frustum, &visible);
        }
    }

    /// Adds the Σ αT² of a view, in the scene's coordinates, to each Gaussian's, and lowers their pixel sizes.
    ///
    /// The image is drawn in bands of rows, each from the groups that it meets.
    pub fn add(&mut self, camera: &Camera, settings: &Settings) -> Result<()> {
        camera.validate()?;
        settings.validate()?;
        let camera = self.relative(camera);
        let frustum = Frustum::of(&camera);
        let visible = self.visible_groups(&frustum);
        self.lower_pixel_sizes(&camera, &frustum, &visible);
        let grid = TileGrid::of(&camera);
        for rows in bands(&visible, grid.rows, self.groups_per_band) {
            let [first, last] = [rows.start as u16, rows.end as u16 - 1];
            let in_band: Vec<u32> = visible
                .iter()
                .filter(|group| group.tile_rows[0] <= last && group.tile_rows[1] >= first)
                .map(|group| group.number)
                .collect();
            let grid = grid.with_rows(rows);
            self.add_band(&camera, settings, grid, &in_band)?;
        }
        Ok(())
    }

    /// The groups that a view can see, ascending.
    fn visible_groups(&self, frustum: &Frustum) -> Vec<VisibleGroup> {
        let blocks = self.blocks.par_iter().zip(self.bounds.par_chunks(BLOCK));
        blocks
            .enumerate()
            .filter(|(_, (block, _))| block.tile_rows(frustum).is_some())
            .flat_map_iter(|(block, (_, groups))| {
                groups.iter().enumerate().filter_map(move |(at, group)| {
                    let tile_rows = group.tile_rows(frustum)?;
                    let number = (block * BLOCK + at) as u32;
                    Some(VisibleGroup { number, tile_rows })
                })
            })
            .collect()
    }

    /// Adds what the rows of tiles in `grid` show of the groups `in_band`, ascending.
    fn add_band(
        &mut self,
        camera: &Camera,
        settings: &Settings,
        grid: TileGrid,
        in_band: &[u32],
    ) -> Result<()> {
        let Some(&last) = in_band.last() else {
            return Ok(());
        };
        let past_end = (LANES * (last as usize + 1)).saturating_sub(self.weight.len());
        let source = VisibleGroups {
            groups: &self.groups,
            visible: in_band,
            rows: in_band.len() * LANES - past_end,
        };
        let weight = DisjointSlice::new(&mut self.weight);
        let add = |row: usize, total: Total| {
            let row = in_band[row / LANES] as usize * LANES + row % LANES;
            // SAFETY: the call comes once for every row.
            unsafe { *weight.at(row) += total.weight };
        };
        self.rasterizer
            .accumulate_from::<SQUARED, _>(source, camera, settings, grid, add)
    }

    /// Rows that some view saw.
    pub fn seen(&self) -> usize {
        self.weight.par_iter().filter(|w| **w > 0.0).count()
    }

    /// Σ αT² and the size of a pixel, scene units, ∞ where no view has the mean in its image; by input row.
    pub fn by_row(&self) -> (Vec<f32>, Vec<f32>) {
        let mut weight = vec![0.0; self.weight.len()];
        let mut pixel_size = vec![0.0; self.weight.len()];
        for (i, &row) in self.ordered.rows.iter().enumerate() {
            weight[row as usize] = self.weight[i] as f32;
            pixel_size[row as usize] = self.pixel_size[i];
        }
        (weight, pixel_size)
    }

    /// Lowers each visible row's pixel size to that of this view.
    fn lower_pixel_sizes(&mut self, camera: &Camera, frustum: &Frustum, visible: &[VisibleGroup]) {
        let count = self.pixel_size.len();
        let pixel_size = DisjointSlice::new(&mut self.pixel_size);
        let largest = DisjointSlice::new(&mut self.largest);
        visible.par_iter().for_each(|g| {
            let (number, first) = (g.number as usize, g.number as usize * LANES);
            // SAFETY: no two groups share rows, and each is there once.
            let (sizes, largest) = unsafe {
                let rows = LANES.min(count - first);
                (
                    pixel_size.slice(first, rows),
                    &mut largest.slice(number, 1)[0],
                )
            };
            let nearest = self.bounds[number].depth(frustum);
            if camera.pixel_size(nearest) >= *largest {
                return;
            }
            for (lane, size) in sizes.iter_mut().enumerate() {
                camera.lower_pixel_size(self.groups[number].mean(lane), size);
            }
            *largest = sizes.iter().fold(0.0, |a, &b| b.max(a));
        });
    }
}

/// Groups that are tested together before each is.
const BLOCK: usize = 16;

/// A band's projections, lists of tiles and keys take about 130 bytes per Gaussian.
const GROUPS_PER_BAND: usize = 1 << 14;

/// Splits the image's rows of tiles into bands that meet at most `most` groups each, or have a single row. A group that
/// meets two bands is projected for both.
fn bands(visible: &[VisibleGroup], rows: usize, most: usize) -> Vec<Range<usize>> {
    let (mut starts, mut ends) = (vec![0; rows], vec![0; rows]);
    for group in visible {
        starts[usize::from(group.tile_rows[0])] += 1;
        ends[usize::from(group.tile_rows[1])] += 1;
    }
    let (mut bands, mut first, mut met) = (Vec::new(), 0, 0);
    let mut inside = 0; // groups that meet the row
    for row in 0..rows {
        inside += starts[row];
        met += starts[row];
        if row > first && met > most {
            bands.push(first..row);
            (first, met) = (row, inside);
        }
        inside -= ends[row];
    }
    bands.push(first..rows);
    bands
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;
    use crate::raster::{Accumulated, Params};

    type Arrays = (Vec<[f32; 3]>, Vec<[f32; 4]>, Vec<[f32; 3]>, Vec<f32>);

    /// 1,003 Gaussians of very different sizes around the origin: means, quaternions, scales, logits.
    fn scene() -> Arrays {
        let mut source = Lcg(7);
        let mut random = || source.uniform_f32();
        let n = 1003;
        let mut triple = |a: f32, b: f32| [0; 3].map(|_| a + (b - a) * random());
        let means = (0..n).map(|_| triple(-3.0, 3.0)).collect();
        let scales = (0..n).map(|_| triple(-6.0, -0.5).map(f32::exp)).collect();
        let quats = (0..n).map(|_| triple(-1.0, 1.0));
        let quats = quats.map(|q| [0.5, q[0], q[1], q[2]]).collect();
        let logits = (0..n).map(|_| triple(-5.0, 5.0)[0]).collect();
        (means, quats, scales, logits)
    }

    fn made(rows: &Arrays) -> SceneRef<'_> {
        SceneRef {
            means: Means::F32(&rows.0),
            quats: &rows.1,
            scales: &rows.2,
            logit_opacities: &rows.3,
            sh0: &rows.0,
            sh_rest: &[],
            rest: 0,
        }
    }

    fn accumulator(scene: &SceneRef) -> VisibilityAccumulator {
        VisibilityAccumulator::new(scene, Arc::new(Ordered::new(scene).unwrap())).unwrap()
    }

    fn cameras() -> Vec<Camera> {
        let turned = |angle: f64, z: f64| {
            let (s, c) = angle.sin_cos();
            Camera {
                viewmat: [[c, 0.0, s, 0.1], [0.0, 1.0, 0.0, -0.2], [-s, 0.0, c, z]],
                fx: 90.0,
                fy: 80.0,
                cx: 40.0,
                cy: 33.0,
                width: 85,
                height: 64,
                near: 0.05,
            }
        };
        (0..12)
            .map(|i| turned(0.5 * f64::from(i), f64::from(i % 4)))
            .collect()
    }

    #[test]
    fn sees_what_the_whole_raster_sees() {
        let rows = scene();
        let (means, quats, scales, logits) = &rows;
        let log_scales: Vec<f32> = scales.as_flattened().iter().map(|s| s.ln()).collect();
        let params = Params {
            means: means.as_flattened(),
            quats: quats.as_flattened(),
            log_scales: &log_scales,
            logit_opacities: logits,
            sh0: means.as_flattened(),
            sh_n: &[],
            sh_coeffs: 1,
            bounds: None,
        };
        let scene = made(&rows);
        let (mut views, mut whole) = (accumulator(&scene), Accumulated::new(means.len()));
        let (mut rasterizer, mut met) = (Rasterizer::default(), 0);
        let mut squared = vec![0.0; means.len()];
        for camera in cameras() {
            let settings = Settings::default();
            views.add(&camera, &settings).unwrap();
            rasterizer
                .accumulate(&params, &camera, &settings, &mut whole)
                .unwrap();
            let sums = DisjointSlice::new(&mut squared);
            let add = |row: usize, total: Total| {
                // SAFETY: the call comes once for every row.
                unsafe { *sums.at(row) += total.weight };
            };
            let grid = TileGrid::of(&camera);
            rasterizer
                .accumulate_from::<SQUARED, _>(params, &camera, &settings, grid, add)
                .unwrap();
            let frustum = Frustum::of(&camera);
            let alone = views.bounds.iter().map(|b| b.tile_rows(&frustum).is_some());
            let visible: Vec<usize> = (0..).zip(alone).filter(|g| g.1).map(|g| g.0).collect();
            let found = views.visible_groups(&frustum);
            assert!(found.iter().map(|g| g.number as usize).eq(visible));
            met += found.len();
        }
        let (weight, pixel_size) = views.by_row();
        assert_eq!(pixel_size, whole.pixel_size);
        for (i, (&got, &want)) in weight.iter().zip(&squared).enumerate() {
            let want = want as f32; // of log scales, which round
            assert!(
                (got - want).abs() <= 1e-3 + 1e-4 * want,
                "{i}: {got} {want}"
            );
        }
        assert!(met < 12 * views.groups.len() * 9 / 10, "{met} groups met");
        assert_eq!(
            views.seen(),
            whole.weight.iter().filter(|w| **w > 0.0).count()
        );
    }

    #[test]
    fn bands_show_what_the_whole_image_does() {
        let rows = scene();
        let scene = made(&rows);
        let (mut whole, mut split) = (accumulator(&scene), accumulator(&scene));
        split.groups_per_band = 10;
        for camera in cameras() {
            whole.add(&camera, &Settings::default()).unwrap();
            split.add(&camera, &Settings::default()).unwrap();
        }
        assert_eq!(whole.by_row(), split.by_row());
    }
}
