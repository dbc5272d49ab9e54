//! What each view sees: the scene's median depth at the pixels where surface cells fall, and which of them lie
//! at it. No other pixel is worked out, so that this is far cheaper than an image and yet exactly what it would show.

use rayon::prelude::*;

use super::{Gaussians, Surface};
use crate::raster::Camera;
use crate::{Control, Result};

/// As gsplat: splats are widened by 0.3 px², opacity ends at 0.99, less than 1/255 is nothing.
const DILATION: f32 = 0.3;
const ALPHA_MAX: f32 = 0.99;
const ALPHA_MIN: f32 = 1.0 / 255.0;

/// The Gaussians of a scene that can hide anything, ready to be projected.
#[derive(Debug)]
pub struct Opaque {
    rows: Vec<Row>,
}

#[derive(Debug, Clone, Copy)]
struct Row {
    mean: [f32; 3],
    opacity: f32,
    covariance: [f32; 6],
    /// No direction has more variance.
    trace: f32,
    /// (distance/σ)² at which α falls to 1/255.
    reach: f32,
}

impl Opaque {
    pub fn of(scene: &Gaussians<'_>) -> Self {
        let rows = (0..scene.means.len())
            .into_par_iter()
            .filter(|&i| scene.opacities[i] >= ALPHA_MIN)
            .map(|i| {
                let covariance = scene.covariance(i).map(|v| v as f32);
                Row {
                    mean: scene.means[i].map(|v| v as f32),
                    opacity: scene.opacities[i],
                    covariance,
                    trace: covariance[0] + covariance[3] + covariance[5],
                    reach: 2.0 * (scene.opacities[i] / ALPHA_MIN).ln(),
                }
            })
            .collect();
        Self { rows }
    }
}

/// A splat on the image.
struct Splat {
    x: f32,
    y: f32,
    conic: [f32; 3],
    opacity: f32,
    columns: [u32; 2],
    rows: [u32; 2],
}

/// One camera's numbers.
struct Pinhole {
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
    focal: [f32; 2],
    center: [f32; 2],
    limits: [[f32; 2]; 2],
    near: f32,
    width: usize,
    height: usize,
}

impl Pinhole {
    fn of(camera: &Camera) -> Self {
        let (w, h) = (camera.width as f64, camera.height as f64);
        let limit = |c: f64, f: f64, size: f64| {
            [
                (-c / f - 0.15 * size / f) as f32,
                ((size - c) / f + 0.15 * size / f) as f32,
            ]
        };
        Self {
            rotation: [0, 1, 2].map(|r| [0, 1, 2].map(|c| camera.viewmat[r][c] as f32)),
            translation: [0, 1, 2].map(|r| camera.viewmat[r][3] as f32),
            focal: [camera.fx as f32, camera.fy as f32],
            center: [camera.cx as f32, camera.cy as f32],
            limits: [
                limit(camera.cx, camera.fx, w),
                limit(camera.cy, camera.fy, h),
            ],
            near: camera.near,
            width: camera.width,
            height: camera.height,
        }
    }

    fn to_camera(&self, p: [f32; 3]) -> [f32; 3] {
        [0, 1, 2].map(|r| {
            let a = &self.rotation[r];
            a[0] * p[0] + a[1] * p[1] + a[2] * p[2] + self.translation[r]
        })
    }

    /// Pixels whose centres lie within `reach` of `at` along an axis of `count`: [from, to).
    fn span(at: f32, reach: f32, count: usize) -> [u32; 2] {
        let index = |v: f32| (v - 0.5).clamp(-1.0, count as f32);
        let from = index(at - reach).ceil().max(0.0);
        let to = (index(at + reach).floor() + 1.0).max(0.0);
        [from as u32, (to as u32).min(count as u32)]
    }

    /// The pixel a point falls into, and its depth.
    fn pixel(&self, p: [f32; 3]) -> Option<(u32, f32)> {
        let [tx, ty, z] = self.to_camera(p);
        if z <= self.near {
            return None;
        }
        let x = self.focal[0] * tx / z + self.center[0];
        let y = self.focal[1] * ty / z + self.center[1];
        let inside = x >= 0.0 && y >= 0.0 && x < self.width as f32 && y < self.height as f32;
        inside.then(|| ((y as usize * self.width + x as usize) as u32, z))
    }

    /// The splat and its depth; None where no pixel can show it.
    fn project(&self, row: &Row) -> Option<(f32, Splat)> {
        let [tx, ty, z] = self.to_camera(row.mean);
        if z <= self.near {
            return None;
        }
        let (x, y) = (
            self.focal[0] * tx / z + self.center[0],
            self.focal[1] * ty / z + self.center[1],
        );
        let (u, v) = (
            (tx / z).clamp(self.limits[0][0], self.limits[0][1]),
            (ty / z).clamp(self.limits[1][0], self.limits[1][1]),
        );
        let (a, b) = (self.focal[0] / z, self.focal[1] / z);
        // Most Gaussians are out of sight: a bound on their extent is enough to tell.
        let out = |at: f32, size: usize| at - at.clamp(0.0, size as f32);
        let far = |d: f32, scale: f32, t: f32| {
            d * d > row.reach * (row.trace * scale * scale * (1.0 + t * t) + DILATION)
        };
        if far(out(x, self.width), a, u) || far(out(y, self.height), b, v) {
            return None;
        }
        // Rows of J·W: gradients of the pixel with respect to the world.
        let w = &self.rotation;
        let jx = [0, 1, 2].map(|k| a * (w[0][k] - u * w[2][k]));
        let jy = [0, 1, 2].map(|k| b * (w[1][k] - v * w[2][k]));
        let s = &row.covariance;
        let apply = |j: &[f32; 3]| {
            [
                s[0] * j[0] + s[1] * j[1] + s[2] * j[2],
                s[1] * j[0] + s[3] * j[1] + s[4] * j[2],
                s[2] * j[0] + s[4] * j[1] + s[5] * j[2],
            ]
        };
        let dot = |p: &[f32; 3], q: &[f32; 3]| p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
        let (sx, sy) = (apply(&jx), apply(&jy));
        let (xx, xy, yy) = (
            dot(&sx, &jx) + DILATION,
            dot(&sx, &jy),
            dot(&sy, &jy) + DILATION,
        );
        let det = xx * yy - xy * xy;
        if !(det > 0.0 && det.is_finite()) {
            return None;
        }
        let columns = Self::span(x, (row.reach * xx).sqrt(), self.width);
        let rows = Self::span(y, (row.reach * yy).sqrt(), self.height);
        if columns[0] >= columns[1] || rows[0] >= rows[1] {
            return None;
        }
        let conic = [yy / det, -xy / det, xx / det];
        Some((
            z,
            Splat {
                x,
                y,
                conic,
                opacity: row.opacity,
                columns,
                rows,
            },
        ))
    }
}

/// What one thread needs for a view; kept from view to view.
#[derive(Default)]
struct Scratch {
    splats: Vec<Splat>,
    keys: Vec<u64>,
    spare: Vec<u64>,
    /// What is left at each pixel: 1 at first where the depth is wanted, 0 elsewhere.
    light: Vec<f32>,
    depth: Vec<f32>,
}

impl Scratch {
    /// Wants every pixel, or none yet.
    fn clear(&mut self, view: &Pinhole, light: f32) {
        let size = view.width * view.height;
        self.light.clear();
        self.light.resize(size, light);
        self.depth.clear();
        self.depth.resize(size, 0.0);
        self.splats.clear();
        self.keys.clear();
    }

    /// Depth of the splat behind which less than half the light is left, 0 where there is none.
    fn trace(&mut self, scene: &Opaque, view: &Pinhole) {
        for row in &scene.rows {
            if let Some((z, splat)) = view.project(row)
                && self.touches(view, &splat)
            {
                self.keys
                    .push(u64::from(z.to_bits()) << 32 | self.splats.len() as u64);
                self.splats.push(splat);
            }
        }
        sort_by_high_half(&mut self.keys, &mut self.spare);
        for &key in &self.keys {
            let z = f32::from_bits((key >> 32) as u32);
            let splat = &self.splats[(key & 0xffff_ffff) as usize];
            draw(splat, z, view, &mut self.light, &mut self.depth);
        }
    }

    /// Whether a splat may reach a wanted pixel; wide ones are not looked through.
    fn touches(&self, view: &Pinhole, s: &Splat) -> bool {
        let row = |j: u32| j as usize * view.width;
        (s.columns[1] - s.columns[0]) * (s.rows[1] - s.rows[0]) > 64
            || (s.rows[0]..s.rows[1]).any(|j| {
                let span = row(j) + s.columns[0] as usize..row(j) + s.columns[1] as usize;
                self.light[span].iter().any(|&l| l > 0.0)
            })
    }
}

fn draw(s: &Splat, z: f32, view: &Pinhole, light: &mut [f32], depth: &mut [f32]) {
    for j in s.rows[0]..s.rows[1] {
        let dy = j as f32 + 0.5 - s.y;
        for i in s.columns[0]..s.columns[1] {
            let at = j as usize * view.width + i as usize;
            if light[at] < 0.5 {
                continue;
            }
            let dx = i as f32 + 0.5 - s.x;
            let power = 0.5 * (s.conic[0] * dx * dx + s.conic[2] * dy * dy) + s.conic[1] * dx * dy;
            let alpha = (s.opacity * (-power).exp()).min(ALPHA_MAX);
            if alpha < ALPHA_MIN || power < 0.0 {
                continue;
            }
            light[at] *= 1.0 - alpha;
            if light[at] < 0.5 {
                depth[at] = z;
            }
        }
    }
}

/// Radix sort by the upper 32 bits, stable: equal depths keep the order of the rows.
fn sort_by_high_half(keys: &mut Vec<u64>, spare: &mut Vec<u64>) {
    const BITS: u32 = 11;
    spare.resize(keys.len(), 0);
    for pass in 0..3 {
        let digit = |k: u64| (k >> (32 + pass * BITS)) as usize & ((1 << BITS) - 1);
        let mut starts = [0usize; 1 << BITS];
        for &k in keys.iter() {
            starts[digit(k)] += 1;
        }
        let mut total = 0;
        for s in &mut starts {
            total += std::mem::replace(s, total);
        }
        for &k in keys.iter() {
            let slot = &mut starts[digit(k)];
            spare[*slot] = k;
            *slot += 1;
        }
        std::mem::swap(keys, spare);
    }
}

/// Median depths of one camera, row by row.
pub fn median_depths(scene: &Opaque, camera: &Camera) -> Vec<f32> {
    let (view, mut scratch) = (Pinhole::of(camera), Scratch::default());
    scratch.clear(&view, 1.0);
    scratch.trace(scene, &view);
    scratch.depth
}

/// For each camera the cells it sees, ascending: the cell's centre falls on the image and lies within
/// max(cell size, 1 % of its depth) of the median depth in that pixel.
pub fn visible(
    scene: &Opaque,
    surface: &Surface,
    cameras: &[Camera],
    control: &Control,
) -> Result<Vec<Vec<u32>>> {
    control.begin(cameras.len() as u64);
    let centers: Vec<[f32; 3]> = surface
        .centers
        .iter()
        .map(|c| c.map(|v| v as f32))
        .collect();
    cameras
        .par_iter()
        .map_init(Scratch::default, |scratch, camera| {
            control.check()?;
            let view = Pinhole::of(camera);
            scratch.clear(&view, 0.0);
            let mut cells: Vec<(u32, u32, f32)> = Vec::new();
            for (cell, &center) in centers.iter().enumerate() {
                if let Some((pixel, z)) = view.pixel(center) {
                    scratch.light[pixel as usize] = 1.0;
                    cells.push((cell as u32, pixel, z));
                }
            }
            scratch.trace(scene, &view);
            control.advance(1);
            let near = |&(_, pixel, z): &(u32, u32, f32)| {
                let median = scratch.depth[pixel as usize];
                median > 0.0 && (z - median).abs() <= (surface.size as f32).max(0.01 * z)
            };
            Ok(cells.iter().filter(|c| near(c)).map(|c| c.0).collect())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sorts_stably_by_the_high_half() {
        let mut state = 9u64;
        let mut keys: Vec<u64> = (0..5000u64)
            .map(|i| {
                state = state
                    .wrapping_mul(6364136223846793005)
                    .wrapping_add(1442695040888963407);
                ((state >> 40) % 97 * 40_000_000) << 32 | i
            })
            .collect();
        let mut want = keys.clone();
        want.sort_unstable();
        sort_by_high_half(&mut keys, &mut Vec::new());
        assert_eq!(keys, want);
    }

    #[test]
    fn wanted_pixels_show_what_the_whole_image_does() {
        let mut means = Vec::new();
        for i in 0..40 {
            for j in 0..40 {
                let z = f64::from(i * j % 7) * 0.2;
                means.push([f64::from(i) * 0.1 - 2.0, f64::from(j) * 0.1 - 2.0, z]);
            }
        }
        let n = means.len();
        let scene = Gaussians {
            means: &means,
            quats: &vec![[0.9, 0.1, 0.3, 0.0]; n],
            scales: &vec![[0.08, 0.05, 0.01]; n],
            opacities: &vec![0.7; n],
        };
        let camera = Camera {
            viewmat: [
                [1.0, 0.0, 0.0, 0.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 4.0],
            ],
            fx: 60.0,
            fy: 60.0,
            cx: 31.0,
            cy: 24.0,
            width: 63,
            height: 47,
            near: 0.01,
        };
        let opaque = Opaque::of(&scene);
        let whole = median_depths(&opaque, &camera);
        assert!(whole.iter().filter(|&&d| d > 0.0).count() > 1000);
        let (view, mut scratch) = (Pinhole::of(&camera), Scratch::default());
        for step in [1, 7, 100] {
            scratch.clear(&view, 0.0);
            for at in (0..whole.len()).step_by(step) {
                scratch.light[at] = 1.0;
            }
            scratch.trace(&opaque, &view);
            for (at, &depth) in whole.iter().enumerate() {
                assert_eq!(scratch.depth[at], if at % step == 0 { depth } else { 0.0 });
            }
        }
    }
}
