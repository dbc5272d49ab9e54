//! One camera and the projection of one Gaussian at a time, in f32, by gsplat's conventions.
//!
//! [`crate::raster`] projects sixteen at a time from stored parameters, with f64 positions and exact minors; depth for
//! selection reads covariances made once for all views, and wants no colours, so the two share constants only.

use crate::raster::{Camera, DILATION};

/// Relative rounding error of a coordinate in the camera's frame in float32.
const ROUNDING: f32 = 1e-6;

/// A Gaussian as `Pinhole` projects it.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub struct Occluder {
    pub mean: [f32; 3],
    pub opacity: f32,
    pub covariance: [f32; 6],
    /// No direction has more variance.
    pub trace: f32,
    /// (distance/σ)² at which α falls to 1/255.
    pub reach: f32,
}

/// Bounds of neighbouring rows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block {
    pub center: [f32; 3],
    pub half: [f32; 3],
    /// Largest trace × reach, and largest reach.
    pub spread: f32,
    pub reach: f32,
}

/// A splat on the image.
pub(super) struct Splat {
    pub x: f32,
    pub y: f32,
    pub conic: [f32; 3],
    pub opacity: f32,
    pub columns: [u32; 2],
    pub rows: [u32; 2],
}

/// Parameters of one camera.
#[derive(Debug, Clone)]
pub struct Pinhole {
    pub rotation: [[f32; 3]; 3],
    pub translation: [f32; 3],
    pub focal: [f32; 2],
    pub center: [f32; 2],
    /// Limits to which x/z and y/z are clamped: [low, high] of each.
    pub limits: [[f32; 2]; 2],
    pub near: f32,
    pub width: usize,
    pub height: usize,
}

impl Pinhole {
    pub fn of(camera: &Camera) -> Self {
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

    /// Whether no row of a block can reach the image; errs on the side of keeping it.
    pub(super) fn misses(&self, block: &Block) -> bool {
        let at = self.to_camera(block.center);
        let size = |v: &[f32; 3]| v.iter().map(|x| x.abs()).sum::<f32>();
        let slack = ROUNDING * (size(&block.center) + size(&self.translation));
        let extent = [0, 1, 2].map(|r| {
            let a = &self.rotation[r];
            slack + (0..3).map(|k| a[k].abs() * block.half[k]).sum::<f32>()
        });
        let far = at[2] + extent[2];
        if far <= self.near {
            return true;
        }
        let close = (at[2] - extent[2]).max(self.near);
        let beyond = |axis: usize, size: usize| {
            let (low, high) = (at[axis] - extent[axis], at[axis] + extent[axis]);
            let first = low / if low < 0.0 { close } else { far };
            let last = high / if high > 0.0 { close } else { far };
            let (focal, center) = (self.focal[axis], self.center[axis]);
            let t = self.limits[axis][0].abs().max(self.limits[axis][1].abs());
            let scale = focal / close;
            let margin = 1.0
                + (block.spread * scale * scale * (1.0 + t * t) + DILATION * block.reach).sqrt();
            focal * last + center + margin < 0.0 || focal * first + center - margin > size as f32
        };
        beyond(0, self.width) || beyond(1, self.height)
    }

    /// Pixels whose centres lie within `reach` of `at` along an axis of `count`: [from, to).
    fn span(at: f32, reach: f32, count: usize) -> [u32; 2] {
        let index = |v: f32| (v - 0.5).clamp(-1.0, count as f32);
        let from = index(at - reach).ceil().max(0.0);
        let to = (index(at + reach).floor() + 1.0).max(0.0);
        [from as u32, (to as u32).min(count as u32)]
    }

    /// The pixel a point falls into, and its depth.
    pub fn pixel(&self, p: [f32; 3]) -> Option<(u32, f32)> {
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
    pub(super) fn project(&self, row: &Occluder) -> Option<(f32, Splat)> {
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
        // Most Gaussians are outside the image: a bound on their extent is enough to refuse them.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slopes_are_limited_to_the_image_and_15_percent_beyond_each_side() {
        for (focal, center, size) in [
            ([60.0, 60.0], [31.0, 24.0], [63, 47]),
            ([400.0, 30.0], [-5.0, 90.0], [32, 80]),
        ] {
            let view = Pinhole::of(&Camera {
                viewmat: [[0.0; 4]; 3],
                fx: focal[0],
                fy: focal[1],
                cx: center[0],
                cy: center[1],
                width: size[0],
                height: size[1],
                near: 0.01,
            });
            for k in 0..2 {
                let side = size[k] as f32;
                for (limit, pixel) in view.limits[k].into_iter().zip([-0.15 * side, 1.15 * side]) {
                    let at = view.focal[k] * limit + view.center[k];
                    assert!((at - pixel).abs() < 1e-3, "{k}: {at} {pixel}");
                }
            }
        }
    }
}
