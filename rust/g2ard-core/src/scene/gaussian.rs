//! One Gaussian's geometry in f64.

use crate::Splats;
use crate::linalg::{
    Mat3, Sym3, covariance, quat_from_rotation, rotation_from_quat, symmetric_eigen,
};

/// Variances below this share of the largest are raised to it: a rank-1 or rank-2 group stays finite.
const VARIANCE_FLOOR: f64 = 1e-14;

/// Mean, orientation and standard deviations along its axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaussian {
    pub mean: [f64; 3],
    pub rotation: Mat3,
    pub scales: [f64; 3],
}

impl Gaussian {
    pub fn of(splats: &Splats, i: usize) -> Self {
        Self {
            mean: splats.means[i],
            rotation: rotation_from_quat(splats.quats[i].map(f64::from)),
            scales: splats.scales[i].map(f64::from),
        }
    }

    pub fn covariance(&self) -> Sym3 {
        covariance(&self.rotation, self.scales)
    }

    /// Scales descend; axis 3 is the normal.
    pub fn from_moments(mean: [f64; 3], cov: &Sym3) -> Self {
        let e = symmetric_eigen(cov);
        let floor = (VARIANCE_FLOOR * e.values[0]).max(f64::from(f32::MIN_POSITIVE).powi(2));
        let [a, b, c] = e.vectors;
        Self {
            mean,
            rotation: [0, 1, 2].map(|r| [a[r], b[r], c[r]]),
            scales: e.values.map(|v| v.max(floor).sqrt()),
        }
    }

    /// Scales as f32, finite.
    pub fn stored_scales(&self) -> [f32; 3] {
        self.scales.map(|v| v.min(f64::from(f32::MAX)) as f32)
    }

    pub fn quat(&self) -> [f32; 4] {
        quat_from_rotation(&self.rotation).map(|v| v as f32)
    }

    /// Axes in order of descending scale.
    pub fn axes_by_scale(&self) -> [usize; 3] {
        let mut order = [0, 1, 2];
        order.sort_by(|&i, &j| self.scales[j].total_cmp(&self.scales[i]));
        order
    }

    /// Makes the area `ratio` times as large along the two longer axes; the surface stays as thin.
    pub fn widen(&mut self, ratio: f64) {
        let [a, b, _] = self.axes_by_scale();
        self.scales[a] *= ratio.sqrt();
        self.scales[b] *= ratio.sqrt();
    }

    pub fn axis(&self, k: usize) -> [f64; 3] {
        self.rotation.map(|row| row[k])
    }
}
