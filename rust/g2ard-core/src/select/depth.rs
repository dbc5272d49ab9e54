//! The scene's median depth at requested pixels. No other pixel is computed: much cheaper than an image, with exactly
//! its values.

use super::occluders::Occluders;
use super::pinhole::{Pinhole, Splat};
use crate::raster::ALPHA_MIN;
use crate::scene::limits::MAX_OPACITY;

/// Upper limit of α, as in gsplat.
const ALPHA_MAX: f32 = MAX_OPACITY as f32;

/// Buffers of one thread for a view, reused from view to view.
#[derive(Default)]
pub(super) struct Scratch {
    splats: Vec<Splat>,
    keys: Vec<u64>,
    spare: Vec<u64>,
    /// Transmittance at each pixel: initially 1 in requested pixels and 0 elsewhere.
    pub light: Vec<f32>,
    pub depth: Vec<f32>,
}

impl Scratch {
    /// Prepare for a view: `light` 1 requests every pixel, 0 none yet.
    pub fn clear(&mut self, view: &Pinhole, light: f32) {
        let size = view.width * view.height;
        self.light.clear();
        self.light.resize(size, light);
        self.depth.clear();
        self.depth.resize(size, 0.0);
        self.splats.clear();
        self.keys.clear();
    }

    /// Depth of the splat at which transmittance falls below one half; 0 if it never does.
    pub fn trace(&mut self, scene: &Occluders, view: &Pinhole) {
        for row in scene.rows_in(view) {
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

    /// Whether a splat may reach a requested pixel; wide splats are accepted untested.
    fn touches(&self, view: &Pinhole, s: &Splat) -> bool {
        let row = |j: u32| j as usize * view.width;
        (s.columns[1] - s.columns[0]) * (s.rows[1] - s.rows[0]) > 64
            || (s.rows[0]..s.rows[1]).any(|j| {
                let span = row(j) + s.columns[0] as usize..row(j) + s.columns[1] as usize;
                self.light[span].iter().any(|&l| l > 0.0)
            })
    }
}

/// Blends a splat into the light left at each pixel. Where it falls below one half, the splat's `z` is the depth, and
/// farther splats are ignored.
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

/// Radix sort by the upper 32 bits, stable: equal depths keep the order of the rows. One view is one thread's, so this
/// sort is serial; [`crate::raster`]'s sorts one view with all threads.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;
    use crate::raster::{Camera, DILATION};
    use crate::select::Gaussians;

    /// Median depths of one camera, row by row.
    fn median_depths(scene: &Occluders, camera: &Camera) -> Vec<f32> {
        let (view, mut scratch) = (Pinhole::of(camera), Scratch::default());
        scratch.clear(&view, 1.0);
        scratch.trace(scene, &view);
        scratch.depth
    }

    #[test]
    fn sorts_stably_by_the_high_half() {
        let mut random = Lcg(9);
        let mut keys: Vec<u64> = (0..5000)
            .map(|i| (u64::from(random.integer()) % 97 * 40_000_000) << 32 | i)
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
        let opaque = Occluders::of(&scene);
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

    #[test]
    fn no_splat_that_a_pixel_can_show_is_refused() {
        let mut random = Lcg(6);
        let mut uniform = |low, high| random.between(low, high);
        let (mut shown, mut outside) = (0, 0);
        for _ in 0..3000 {
            let (a, b) = (uniform(-3.0, 3.0), uniform(-1.5, 1.5));
            let ((sa, ca), (sb, cb)) = (a.sin_cos(), b.sin_cos());
            let turn = [
                [ca, 0.0, -sa],
                [sa * sb, cb, ca * sb],
                [sa * cb, -sb, ca * cb],
            ];
            let camera = Camera {
                viewmat: turn.map(|r| [r[0], r[1], r[2], uniform(-2.0, 4.0)]),
                fx: 40.0,
                fy: 44.0,
                cx: 15.5,
                cy: 11.0,
                width: 32,
                height: 24,
                near: 0.1,
            };
            let view = Pinhole::of(&camera);
            let mean = [0; 3].map(|_| uniform(-2.0, 2.0));
            let at = camera.in_camera(mean);
            let scene = Gaussians {
                means: &[mean],
                quats: &[[uniform(-1.0, 1.0) as f32, 0.3, -0.2, 0.5]],
                scales: &[[0; 3].map(|_| uniform(-6.0, -1.5).exp() as f32)],
                opacities: &[uniform(0.1, 1.0) as f32],
            };
            let row = Occluders::of(&scene).rows[0];
            if at[2] <= 0.1 {
                assert!(view.project(&row).is_none());
                continue;
            }
            let centre = [
                camera.fx * at[0] / at[2] + camera.cx,
                camera.fy * at[1] / at[2] + camera.cy,
            ];
            // Without anisotropy or perspective of the extent: α on the least circle around the centre is a lower bound.
            let near = |v: f64, size: f64| v.clamp(0.5, size - 0.5) - v;
            let gap = near(centre[0], 32.0).abs().max(near(centre[1], 24.0).abs()) + 0.5;
            let spread = f64::from(DILATION).sqrt();
            let alpha = f64::from(row.opacity) * (-(gap / spread).powi(2)).exp();
            let projected = view.project(&row);
            if let Some((z, splat)) = &projected {
                shown += 1;
                assert!((f64::from(*z) - at[2]).abs() < 1e-4);
                assert!((f64::from(splat.x) - centre[0]).abs() < 1e-2 + 1e-4 * centre[0].abs());
                assert!((f64::from(splat.y) - centre[1]).abs() < 1e-2 + 1e-4 * centre[1].abs());
            }
            if alpha > 2.0 * f64::from(ALPHA_MIN) {
                assert!(projected.is_some(), "{centre:?} {alpha}");
                outside += i32::from(gap > 0.6);
            }
        }
        assert!(shown > 150 && outside > 10, "{shown} {outside}");
    }

    #[test]
    fn cells_in_front_of_or_behind_the_surface_are_not_seen() {
        use crate::select::{Surface, ViewKernels};
        use crate::{Control, Cpu};
        let (mut means, mut centers) = (Vec::new(), Vec::new());
        for i in 0..30 {
            for j in 0..30 {
                means.push([f64::from(i) * 0.1 - 1.5, f64::from(j) * 0.1 - 1.5, 0.0]);
            }
        }
        for z in [0.0, 0.5, -0.5, 0.02] {
            centers.push([0.1, 0.2, z]);
        }
        let n = means.len();
        let scene = Gaussians {
            means: &means,
            quats: &vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: &vec![[0.1, 0.1, 0.001]; n],
            opacities: &vec![0.99; n],
        };
        let surface = Surface {
            normals: vec![[0.0, 0.0, 1.0]; 4],
            confidence: vec![1.0; 4],
            weights: vec![0.25; 4],
            size: 0.05,
            centers,
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
        let seen = Cpu
            .visible_cells(&scene, &surface, 0.01, &[camera], &Control::default())
            .unwrap();
        assert_eq!(seen, [vec![0, 3]]);
    }

    #[test]
    fn blocks_out_of_sight_leave_nothing_out() {
        let mut random = Lcg(5);
        let mut uniform = |low, high| random.between(low, high);
        let n = 6000;
        let means: Vec<[f64; 3]> = (0..n).map(|_| [0; 3].map(|_| uniform(-9.0, 9.0))).collect();
        let scales: Vec<[f32; 3]> = (0..n)
            .map(|_| [0; 3].map(|_| uniform(-4.0, 0.7).exp() as f32))
            .collect();
        let scene = Gaussians {
            means: &means,
            quats: &vec![[0.3, 0.8, -0.2, 0.5]; n],
            scales: &scales,
            opacities: &(0..n).map(|_| uniform(0.0, 1.0) as f32).collect::<Vec<_>>(),
        };
        let blocks = Occluders::of(&scene);
        let mut whole = Occluders::of(&scene);
        for block in &mut whole.blocks {
            block.half = [f32::INFINITY; 3];
        }
        let mut skipped = 0;
        for _ in 0..40 {
            let (a, b) = (uniform(-3.2, 3.2), uniform(-1.5, 1.5));
            let ((sa, ca), (sb, cb)) = (a.sin_cos(), b.sin_cos());
            let turn = [
                [ca, 0.0, -sa],
                [sa * sb, cb, ca * sb],
                [sa * cb, -sb, ca * cb],
            ];
            let camera = Camera {
                viewmat: turn.map(|r| [r[0], r[1], r[2], uniform(-6.0, 6.0)]),
                fx: uniform(20.0, 200.0),
                fy: uniform(20.0, 200.0),
                cx: uniform(0.0, 40.0),
                cy: uniform(0.0, 30.0),
                width: 40,
                height: 30,
                near: 0.01,
            };
            let view = Pinhole::of(&camera);
            skipped += blocks.blocks.iter().filter(|b| view.misses(b)).count();
            assert_eq!(
                median_depths(&blocks, &camera),
                median_depths(&whole, &camera)
            );
        }
        assert!(skipped > 40 * blocks.blocks.len() / 4, "{skipped}");
    }
}
