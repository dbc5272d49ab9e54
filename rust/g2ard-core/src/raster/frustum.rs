//! A conservative test whether boxes can touch an image, over groups of rows, in f64.
//!
//! [`crate::select::Pinhole`] has its own test in f32, with the slack that f32 needs. It bounds Gaussians by their own
//! traces and reaches, like its projection, whereas this one only knows the largest scale.

use super::{Camera, DILATION, TILE};

/// Standard deviations at which an opacity of 1 falls to α = 1/255, and a little more.
const REACH: f64 = 3.4;

/// The test for one camera: it may keep a box that touches nothing, but never rejects one that touches the image.
pub struct Frustum<'a> {
    camera: &'a Camera,
    near: f64,
    focal: f64,
    /// ‖J‖ / focal · z at most, by the clamped rays of the projection's Jacobian.
    spread: f64,
}

impl<'a> Frustum<'a> {
    pub fn of(camera: &'a Camera) -> Self {
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

    /// The first and the last row of tiles that Gaussians can touch, given the box of their means by its centre and
    /// half its sides, and their largest scale; None if they cannot touch the image.
    pub fn tile_rows(&self, centre: [f32; 3], half: [f32; 3], scale: f32) -> Option<[u16; 2]> {
        let c = self.camera;
        let (middle, reach) = self.in_camera(centre, half);
        let far = middle[2] + reach[2];
        if far < self.near {
            return None;
        }
        let near = (middle[2] - reach[2]).max(self.near);
        let sigma = self.focal / near * self.spread * f64::from(scale);
        let radius = REACH * (sigma * sigma + f64::from(DILATION)).sqrt() + 2.0;
        let touched = |axis: usize, focal: f64, centre: f64, size: usize| {
            let (low, high) = (middle[axis] - reach[axis], middle[axis] + reach[axis]);
            let low = focal * low / if low < 0.0 { near } else { far };
            let high = focal * high / if high > 0.0 { near } else { far };
            let (low, high) = (low + centre - radius, high + centre + radius);
            (high >= 0.0 && low <= size as f64).then_some([low, high])
        };
        touched(0, c.fx, c.cx, c.width)?;
        let last = ((c.height - 1) / TILE) as f64;
        let rows = touched(1, c.fy, c.cy, c.height)?;
        Some(rows.map(|y| (y / TILE as f64).clamp(0.0, last) as u16))
    }

    /// The least depth of a point in a box, or less.
    pub fn depth(&self, centre: [f32; 3], half: [f32; 3]) -> f64 {
        let (middle, reach) = self.in_camera(centre, half);
        middle[2] - reach[2]
    }

    /// A box in camera coordinates, along their axes: its middle and half its sides, with slack.
    #[inline]
    fn in_camera(&self, centre: [f32; 3], half: [f32; 3]) -> ([f64; 3], [f64; 3]) {
        let c = self.camera;
        let middle = c.in_camera(centre.map(f64::from));
        let reach = [0, 1, 2].map(|r: usize| {
            let row = &c.viewmat[r];
            let side = |k: usize| row[k].abs() * f64::from(half[k]);
            side(0) + side(1) + side(2) + 1e-5 * middle[r].abs()
        });
        (middle, reach)
    }
}
