//! Boxes that share a scene: which of them a pair of a Gaussian and a pixel belongs to.
//!
//! A pair belongs to the box that holds the point of the pixel's ray at the Gaussian's depth. That point is linear in the
//! depth, so along a ray a box is a half-open interval of depths. Two boxes that share a face compute its depth from the
//! same numbers, so every pair has exactly one of the boxes that a kd tree cuts. A ray passes through these in the order
//! in which the tree is walked from the camera: drawn in that order, boxes blend all pairs in the order of the whole scene.

use rayon::prelude::*;

use super::grid::{TileRect, pixel_of};
use super::simd::{LANES, Lanes16, Mask, Vector};
use super::{Camera, DILATION, ROWS, Settings};
use crate::{Error, Result};

/// A half-open box in the world, infinite where it is open.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    pub low: [f64; 3],
    pub high: [f64; 3],
}

impl Region {
    pub fn validate(&self) -> Result<()> {
        let ordered = self
            .low
            .iter()
            .zip(&self.high)
            .all(|(low, high)| low <= high);
        refuse!(!ordered => "box", "low corners up to high ones", format!("{:?} to {:?}", self.low, self.high));
        Ok(())
    }

    /// The depths, the last one excluded, at which a ray is in the box. Direction: the ray's change per unit of depth.
    #[inline]
    fn depths(&self, position: [f64; 3], direction: [f64; 3]) -> [f32; 2] {
        let (mut from, mut to) = (0f32, f32::INFINITY);
        for k in 0..3 {
            let (low, high) = (self.low[k] - position[k], self.high[k] - position[k]);
            // Never `to <= from` between two boxes' shared face: both round the same quotient.
            if direction[k] > 0.0 {
                from = from.max((low / direction[k]) as f32);
                to = to.min((high / direction[k]) as f32);
            } else if direction[k] < 0.0 {
                from = from.max((high / direction[k]) as f32);
                to = to.min((low / direction[k]) as f32);
            } else if low > 0.0 || high <= 0.0 {
                to = 0.0;
            }
        }
        [from, to]
    }

    /// The square of a point's distance from the box.
    fn distance2(&self, p: [f64; 3]) -> f64 {
        let gap = |k: usize| (self.low[k] - p[k]).max(p[k] - self.high[k]).max(0.0);
        (0..3).map(|k| gap(k) * gap(k)).sum()
    }
}

/// The rays of a camera's pixels.
pub struct Rays<'a> {
    camera: &'a Camera,
    position: [f64; 3],
}

impl<'a> Rays<'a> {
    pub fn of(camera: &'a Camera) -> Self {
        Self {
            camera,
            position: camera.position(),
        }
    }

    /// The depths at which the ray through a pixel's centre is in a box.
    #[inline]
    fn depths(&self, region: &Region, x: usize, y: usize) -> [f32; 2] {
        let (c, r) = (self.camera, &self.camera.viewmat);
        let dx = (x as f64 + 0.5 - c.cx) / c.fx;
        let dy = (y as f64 + 0.5 - c.cy) / c.fy;
        let direction = [0, 1, 2].map(|k| r[0][k] * dx + r[1][k] * dy + r[2][k]);
        region.depths(self.position, direction)
    }
}

/// The depths at which the rays of a tile's pixels are in a box.
pub struct DepthRanges {
    from: [Lanes16; ROWS],
    to: [Lanes16; ROWS],
    /// Around all of them; empty if no ray meets the box.
    pub least: f32,
    pub most: f32,
}

impl DepthRanges {
    pub fn of(region: &Region, rays: &Rays, rect: &TileRect) -> Self {
        let mut ranges = Self {
            from: [Lanes16::default(); ROWS],
            to: [Lanes16::default(); ROWS],
            least: f32::INFINITY,
            most: 0.0,
        };
        for row in 0..ROWS {
            for l in 0..LANES {
                let (x, y) = pixel_of(row, l);
                if x >= rect.columns || y >= rect.rows {
                    continue;
                }
                let [from, to] = rays.depths(region, rect.x + x, rect.y + y);
                if from < to {
                    (ranges.from[row].0[l], ranges.to[row].0[l]) = (from, to);
                    (ranges.least, ranges.most) = (ranges.least.min(from), ranges.most.max(to));
                }
            }
        }
        ranges
    }
}

/// Which of a tile's pairs count.
pub trait Within: Copy {
    /// The pixels among `hit` in which a splat of this depth counts.
    fn at<B: Vector>(self, hit: B::Mask, depth: f32, row: usize, part: usize) -> B::Mask;
}

/// All of them.
#[derive(Clone, Copy)]
pub struct Everywhere;

impl Within for Everywhere {
    #[inline(always)]
    fn at<B: Vector>(self, hit: B::Mask, _: f32, _: usize, _: usize) -> B::Mask {
        hit
    }
}

impl Within for &DepthRanges {
    #[inline(always)]
    fn at<B: Vector>(self, hit: B::Mask, depth: f32, row: usize, part: usize) -> B::Mask {
        let z = B::splat(depth);
        hit.and(z.ge(B::load_part(&self.from[row], part)))
            .and(B::load_part(&self.to[row], part).gt(z))
    }
}

/// The most light left in an unfinished pixel whose ray meets the box; 0 without such a pixel.
pub fn light_on(
    region: &Region,
    camera: &Camera,
    light: &[f32],
    settings: &Settings,
) -> Result<f32> {
    region.validate()?;
    camera.validate()?;
    Error::unless_equal("light", light.len(), camera.width * camera.height, "values")?;
    let rays = Rays::of(camera);
    let rows = light.par_chunks(camera.width).enumerate().map(|(y, row)| {
        let mut most = settings.transmittance_min;
        for (x, &t) in row.iter().enumerate() {
            if t > most {
                let [from, to] = rays.depths(region, x, y);
                if from.max(camera.near) < to {
                    most = t;
                }
            }
        }
        most
    });
    let most = rows.reduce(|| 0.0, f32::max);
    Ok(if most > settings.transmittance_min {
        most
    } else {
        0.0
    })
}

/// Which rows may have pairs in a box in some view: (N,). A footprint (α ≥ 1/255) at depth z is an ellipse in the plane of
/// that depth; it is bounded by a disc around the mean.
pub fn reaching(
    region: &Region,
    cameras: &[Camera],
    means: &[[f32; 3]],
    largest_scales: &[f32],
    opacities: &[f32],
) -> Result<Vec<bool>> {
    region.validate()?;
    for camera in cameras {
        camera.validate()?;
    }
    Error::unless_equal("scales", largest_scales.len(), means.len(), "values")?;
    Error::unless_equal("opacities", opacities.len(), means.len(), "values")?;
    let lenses: Vec<Lens> = cameras.iter().map(Lens::of).collect();
    let reaches = |(row, mean): (usize, &[f32; 3])| {
        let mean = mean.map(f64::from);
        let distance2 = region.distance2(mean);
        // α = 1/255 is at q = 2 ln(255·opacity).
        let q = 2.0 * (255.0 * f64::from(opacities[row])).ln() + 1e-3;
        if q <= 0.0 {
            return false;
        }
        distance2 == 0.0 || {
            let scale = f64::from(largest_scales[row]);
            cameras.iter().zip(&lenses).any(|(camera, lens)| {
                let z = camera.in_camera(mean)[2];
                z >= 0.999 * f64::from(camera.near) && distance2 <= q * lens.variance(scale, z)
            })
        }
    };
    Ok(means.par_iter().enumerate().map(reaches).collect())
}

/// What bounds the size of footprints in a view.
struct Lens {
    /// ‖J‖·z over the shorter focal length, squared.
    spread2: f64,
    /// The dilation's variance at depth 1.
    dilation: f64,
}

impl Lens {
    fn of(camera: &Camera) -> Self {
        let widest = |size: usize, c: f64, f: f64| {
            let size = size as f64;
            c.abs().max((size - c).abs()) / f + 0.15 * size / f
        };
        let x = widest(camera.width, camera.cx, camera.fx);
        let y = widest(camera.height, camera.cy, camera.fy);
        let (longer, shorter) = (camera.fx.max(camera.fy), camera.fx.min(camera.fy));
        Self {
            spread2: (1.0 + x * x + y * y) * (longer / shorter).powi(2),
            dilation: f64::from(DILATION) / (shorter * shorter),
        }
    }

    /// At most the larger variance of a footprint in the plane of depth z, scene units².
    fn variance(&self, scale: f64, z: f64) -> f64 {
        1.0001 * (self.spread2 * scale * scale + self.dilation * z * z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;

    /// Cuts a box at one place of one axis, or as near to it as the box reaches.
    fn cut(region: Region, axis: usize, at: f64) -> [Region; 2] {
        let at = at.clamp(region.low[axis], region.high[axis]);
        let (mut below, mut above) = (region, region);
        below.high[axis] = at;
        above.low[axis] = at;
        [below, above]
    }

    #[test]
    fn each_depth_of_a_ray_is_in_one_box() {
        let mut random = Lcg(11);
        let everything = Region {
            low: [f64::NEG_INFINITY; 3],
            high: [f64::INFINITY; 3],
        };
        for round in 0..200 {
            let mut boxes = vec![everything];
            let mut cuts = Vec::new();
            for _ in 0..6 {
                let axis = (random.uniform_f32() * 3.0) as usize % 3;
                let at = f64::from(random.uniform_f32() - 0.5);
                cuts.push((axis, at));
                let whole = boxes.remove((random.uniform_f32() * boxes.len() as f32) as usize);
                boxes.extend(cut(whole, axis, at));
            }
            let mut position = [0; 3].map(|_| random.between(-1.0, 1.0));
            let mut direction = [0; 3].map(|_| random.between(-1.0, 1.0));
            let (axis, at) = cuts[round % cuts.len()];
            if round % 2 == 0 {
                position[axis] = at;
            }
            if round % 3 == 0 {
                direction[axis] = 0.0;
            }
            // Depths at random, and those of the faces with their neighbours.
            let mut depths: Vec<f32> = (0..50).map(|_| random.uniform_f32() * 2.0 + 0.01).collect();
            for (axis, at) in cuts {
                let z = ((at - position[axis]) / direction[axis]) as f32;
                depths.extend([z.next_down(), z, z.next_up()]);
            }
            for z in depths.into_iter().filter(|z| *z > 0.0 && z.is_finite()) {
                let holds = |b: &&Region| {
                    let [from, to] = b.depths(position, direction);
                    from <= z && z < to
                };
                assert_eq!(boxes.iter().filter(holds).count(), 1, "depth {z}");
            }
        }
    }
}
