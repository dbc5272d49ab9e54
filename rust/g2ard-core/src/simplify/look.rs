//! What views see of a whole scene, in little memory: packed rows, of which a view projects those about its frustum.

use rayon::prelude::*;

use super::{Means, Ordered, SceneRef};
use crate::Result;
use crate::raster::accumulate::WEIGHT;
use crate::raster::order::Shared;
use crate::raster::params::{Source, check_count};
use crate::raster::simd::{LANES, Lanes, Row};
use crate::raster::{Camera, DILATION, Rasterizer, Settings};

/// Standard deviations at which an opacity of 1 falls to α = 1/255, and a little more.
const REACH: f64 = 3.4;
/// Scales and logits are cut to where f32 can follow their squares and exponentials.
const SCALES: (f32, f32) = (1.8e-35, 2.3e17);
const LOGITS: (f32, f32) = (-80.0, 80.0);

/// Σ αT and the smallest pixels of N Gaussians over the views added so far. Neither the order of the rows nor the
/// number of threads decides anything: equal depths are drawn in the order of the scene's content.
pub struct Look {
    groups: Vec<Group>,
    /// The input row of each packed row.
    rows: Vec<u32>,
    origin: [f64; 3],
    /// What f64 means are taken relative to; f32 means stay as they are.
    shift: [f64; 3],
    weight: Vec<f64>,
    pixel: Vec<f32>,
    rasterizer: Rasterizer,
}

impl Look {
    pub fn new(scene: &SceneRef) -> Result<Self> {
        check_count(scene.len())?;
        let Ordered { rows, origin, .. } = Ordered::new(scene)?;
        let shift = match scene.means {
            Means::F32(_) => [0.0; 3],
            Means::F64(_) => origin,
        };
        let groups = rows.par_chunks(LANES).map(|r| Group::of(scene, r, shift));
        Ok(Self {
            groups: groups.collect(),
            weight: vec![0.0; rows.len()],
            pixel: vec![f32::INFINITY; rows.len()],
            rows,
            origin,
            shift,
            rasterizer: Rasterizer::default(),
        })
    }

    /// The scene's median point.
    pub fn origin(&self) -> [f64; 3] {
        self.origin
    }

    /// Adds a view in the scene's coordinates.
    pub fn add(&mut self, camera: &Camera, settings: &Settings) -> Result<()> {
        camera.validate()?;
        settings.validate()?;
        let mut camera = *camera;
        for r in &mut camera.viewmat {
            r[3] += r[0] * self.shift[0] + r[1] * self.shift[1] + r[2] * self.shift[2];
        }
        let frustum = Frustum::of(&camera);
        let numbers = 0..self.groups.len() as u32;
        let live: Vec<u32> = numbers
            .into_par_iter()
            .filter(|&g| frustum.meets(&self.groups[g as usize]))
            .collect();
        self.find_pixels(&camera, &live);
        let past_end = match live.last() {
            Some(&g) => (LANES * (g as usize + 1)).saturating_sub(self.rows.len()),
            None => return Ok(()),
        };
        let source = Packed {
            groups: &self.groups,
            live: &live,
            rows: live.len() * LANES - past_end,
        };
        let weight = Shared::new(&mut self.weight);
        self.rasterizer
            .accumulate_from::<WEIGHT, _>(source, &camera, settings, |row, total| {
                let row = live[row / LANES] as usize * LANES + row % LANES;
                // SAFETY: every row is told of once in a view.
                unsafe { *weight.at(row) += total.weight };
            });
        Ok(())
    }

    /// Rows that some view saw.
    pub fn seen(&self) -> usize {
        self.weight.par_iter().filter(|w| **w > 0.0).count()
    }

    /// Σ αT and the size of a pixel, scene units, ∞ where no view has the mean in its image; by input row.
    pub fn by_row(&self) -> (Vec<f32>, Vec<f32>) {
        let mut weight = vec![0.0; self.rows.len()];
        let mut pixel = vec![0.0; self.rows.len()];
        for (i, &row) in self.rows.iter().enumerate() {
            weight[row as usize] = self.weight[i] as f32;
            pixel[row as usize] = self.pixel[i];
        }
        (weight, pixel)
    }

    /// Lowers each row's pixel size to depth / focal length where the mean falls inside the image.
    fn find_pixels(&mut self, camera: &Camera, live: &[u32]) {
        let focal = camera.fx.max(camera.fy);
        let (width, height) = (camera.width as f64, camera.height as f64);
        let count = self.pixel.len();
        let pixel = Shared::new(&mut self.pixel);
        live.par_iter().for_each(|&g| {
            let group = &self.groups[g as usize];
            let first = g as usize * LANES;
            // SAFETY: no two groups share rows.
            let sizes = unsafe { pixel.slice(first, LANES.min(count - first)) };
            for (l, size) in sizes.iter_mut().enumerate() {
                let mean = [0, 1, 2].map(|k| f64::from(group.values[k].0[l]));
                let p = in_camera(camera, mean);
                let x = camera.fx * p[0] / p[2] + camera.cx;
                let y = camera.fy * p[1] / p[2] + camera.cy;
                let inside = (0.0..=width).contains(&x) && (0.0..=height).contains(&y);
                if p[2] >= f64::from(camera.near) && inside {
                    *size = size.min((p[2] / focal) as f32);
                }
            }
        });
    }
}

/// Sixteen rows, and the box that holds what they can show.
struct Group {
    /// Mean, quaternion, scales (linear, so that a unit twice as long rounds alike), logit; the last row again in lanes past the end.
    values: [Row; 11],
    centre: [f32; 3],
    /// Half the sides of the means' box.
    half: [f32; 3],
    /// The largest scale.
    scale: f32,
}

impl Group {
    fn of(scene: &SceneRef, rows: &[u32], shift: [f64; 3]) -> Self {
        let mut values = [Row::default(); 11];
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        let mut scale = 0f32;
        for l in 0..LANES {
            let row = rows[l.min(rows.len() - 1)] as usize;
            let mean = scene.means.get(row);
            for k in 0..3 {
                let m = (mean[k] - shift[k]) as f32;
                values[k].0[l] = m;
                (low[k], high[k]) = (low[k].min(m), high[k].max(m));
                let s = scene.scales[row][k].clamp(SCALES.0, SCALES.1);
                values[7 + k].0[l] = s;
                scale = scale.max(s);
            }
            for k in 0..4 {
                values[3 + k].0[l] = scene.quats[row][k];
            }
            values[10].0[l] = scene.logit_opacities[row].clamp(LOGITS.0, LOGITS.1);
        }
        let centre = [0, 1, 2].map(|k| 0.5 * low[k] + 0.5 * high[k]);
        Self {
            values,
            centre,
            half: [0, 1, 2].map(|k| (high[k] - centre[k]).max(centre[k] - low[k])),
            scale,
        }
    }
}

/// The groups a view can see, one after another.
#[derive(Clone, Copy)]
struct Packed<'a> {
    groups: &'a [Group],
    live: &'a [u32],
    rows: usize,
}

impl Packed<'_> {
    #[inline(always)]
    fn value<F: Lanes>(&self, group: usize, value: usize) -> F {
        F::load(&self.groups[self.live[group] as usize].values[value])
    }
}

impl Source for Packed<'_> {
    #[inline(always)]
    fn len(&self) -> usize {
        self.rows
    }
    #[inline(always)]
    fn sh_coeffs(&self) -> usize {
        1
    }
    #[inline(always)]
    fn mean<F: Lanes>(&self, group: usize, axis: usize) -> F {
        self.value(group, axis)
    }
    #[inline(always)]
    fn quat<F: Lanes>(&self, group: usize, part: usize) -> F {
        self.value(group, 3 + part)
    }
    #[inline(always)]
    fn scale<F: Lanes>(&self, group: usize, axis: usize) -> F {
        self.value(group, 7 + axis)
    }
    #[inline(always)]
    fn logit_opacity<F: Lanes>(&self, group: usize) -> F {
        self.value(group, 10)
    }
    /// No image, no colours.
    #[inline(always)]
    fn sh<F: Lanes>(&self, _group: usize, _k: usize, _c: usize) -> F {
        F::zero()
    }
}

/// Which boxes can touch the image: generous, never wrong.
struct Frustum<'a> {
    camera: &'a Camera,
    near: f64,
    focal: f64,
    /// ‖J‖ / focal · z at most, by the clamped rays of the projection's Jacobian.
    spread: f64,
}

impl<'a> Frustum<'a> {
    fn of(camera: &'a Camera) -> Self {
        let widest = |size: usize, c: f64, f: f64| {
            let size = size as f64;
            c.abs().max((size - c).abs()) / f + 0.15 * size / f
        };
        let x = widest(camera.width, camera.cx, camera.fx);
        let y = widest(camera.height, camera.cy, camera.fy);
        Self {
            camera,
            near: 0.999 * f64::from(camera.near),
            focal: camera.fx.max(camera.fy),
            spread: (1.0 + x * x + y * y).sqrt(),
        }
    }

    fn meets(&self, group: &Group) -> bool {
        let c = self.camera;
        let middle = in_camera(c, group.centre.map(f64::from));
        let half = [0, 1, 2].map(|r: usize| {
            let row = &c.viewmat[r];
            let side = |k: usize| row[k].abs() * f64::from(group.half[k]);
            side(0) + side(1) + side(2) + 1e-5 * middle[r].abs()
        });
        let far = middle[2] + half[2];
        if far < self.near {
            return false;
        }
        let near = (middle[2] - half[2]).max(self.near);
        let sigma = self.focal / near * self.spread * f64::from(group.scale);
        let radius = REACH * (sigma * sigma + f64::from(DILATION)).sqrt() + 2.0;
        let touches = |axis: usize, focal: f64, centre: f64, size: usize| {
            let (low, high) = (middle[axis] - half[axis], middle[axis] + half[axis]);
            let low = focal * low / if low < 0.0 { near } else { far };
            let high = focal * high / if high > 0.0 { near } else { far };
            high + centre + radius >= 0.0 && low + centre - radius <= size as f64
        };
        touches(0, c.fx, c.cx, c.width) && touches(1, c.fy, c.cy, c.height)
    }
}

fn in_camera(camera: &Camera, p: [f64; 3]) -> [f64; 3] {
    camera
        .viewmat
        .map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::{Accumulated, Params};

    type Arrays = (Vec<[f32; 3]>, Vec<[f32; 4]>, Vec<[f32; 3]>, Vec<f32>);

    /// 1,003 Gaussians of very different sizes around the origin: means, quaternions, scales, logits.
    fn scene() -> Arrays {
        let mut state = 7u64;
        let mut random = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 24) as f32
        };
        let n = 1003;
        let mut triple = |a: f32, b: f32| [0; 3].map(|_| a + (b - a) * random());
        let means = (0..n).map(|_| triple(-3.0, 3.0)).collect();
        let scales = (0..n).map(|_| triple(-6.0, -0.5).map(f32::exp)).collect();
        let quats = (0..n).map(|_| triple(-1.0, 1.0));
        let quats = quats.map(|q| [0.5, q[0], q[1], q[2]]).collect();
        let logits = (0..n).map(|_| triple(-5.0, 5.0)[0]).collect();
        (means, quats, scales, logits)
    }

    /// A scene of those arrays, but for its means and scales.
    fn made<'a>(means: Means<'a>, scales: &'a [[f32; 3]], rows: &'a Arrays) -> SceneRef<'a> {
        SceneRef {
            means,
            quats: &rows.1,
            scales,
            logit_opacities: &rows.3,
            sh0: &rows.0,
            sh_rest: &[],
            rest: 0,
        }
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
        };
        let scene = made(Means::F32(means), scales, &rows);
        let (mut look, mut whole) = (Look::new(&scene).unwrap(), Accumulated::new(means.len()));
        let (mut rasterizer, mut met) = (Rasterizer::default(), 0);
        for camera in cameras() {
            let settings = Settings::default();
            look.add(&camera, &settings).unwrap();
            rasterizer
                .accumulate(&params, &camera, &settings, &mut whole)
                .unwrap();
            let frustum = Frustum::of(&camera);
            met += look.groups.iter().filter(|g| frustum.meets(g)).count();
        }
        let (weight, pixel) = look.by_row();
        assert_eq!(pixel, whole.pixel_size);
        for (i, (&got, &want)) in weight.iter().zip(&whole.weight).enumerate() {
            let want = want as f32; // of log scales, which round
            assert!(
                (got - want).abs() <= 1e-3 + 1e-4 * want,
                "{i}: {got} {want}"
            );
        }
        assert!(met < 12 * look.groups.len() * 9 / 10, "{met} groups met");
        assert_eq!(
            look.seen(),
            whole.weight.iter().filter(|w| **w > 0.0).count()
        );
    }

    #[test]
    fn a_unit_that_is_a_power_of_two_changes_no_bit() {
        let rows = scene();
        let by_row = |unit: f32| {
            let times = |rows: &[[f32; 3]]| rows.iter().map(|r| r.map(|x| unit * x)).collect();
            let (means, scales): (Vec<_>, Vec<_>) = (times(&rows.0), times(&rows.2));
            let mut look = Look::new(&made(Means::F32(&means), &scales, &rows)).unwrap();
            for mut camera in cameras() {
                for r in &mut camera.viewmat {
                    r[3] *= f64::from(unit);
                }
                camera.near *= unit;
                look.add(&camera, &Settings::default()).unwrap();
            }
            let (weight, pixel) = look.by_row();
            (
                weight,
                pixel.into_iter().map(|p| p / unit).collect::<Vec<_>>(),
            )
        };
        let here = by_row(1.0);
        for exponent in [-10, -1, 1, 3, 10] {
            assert_eq!(by_row(2f32.powi(exponent)), here, "2^{exponent}");
        }
    }

    #[test]
    fn map_coordinates_are_as_good_as_any() {
        let rows = scene();
        let offset = [400_000.0, 4_000_000.0, 100.0];
        let here: Vec<[f64; 3]> = rows.0.iter().map(|m| m.map(f64::from)).collect();
        let moved: Vec<[f64; 3]> = here
            .iter()
            .map(|m| [0, 1, 2].map(|k| m[k] + offset[k]))
            .collect();
        let by_row = |means: &[[f64; 3]], shift: [f64; 3]| {
            let mut look = Look::new(&made(Means::F64(means), &rows.2, &rows)).unwrap();
            for mut camera in cameras() {
                for r in &mut camera.viewmat {
                    r[3] -= r[0] * shift[0] + r[1] * shift[1] + r[2] * shift[2];
                }
                look.add(&camera, &Settings::default()).unwrap();
            }
            look.by_row().0
        };
        let (a, b) = (by_row(&here, [0.0; 3]), by_row(&moved, offset));
        let total: f32 = a.iter().sum();
        let apart: f32 = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum();
        assert!(apart < 1e-3 * total, "{apart} of {total}");
    }
}
