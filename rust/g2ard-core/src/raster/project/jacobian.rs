//! Transforms from the world's axes to the camera's and the screen's.

use super::View;
use crate::raster::params::Source;
use crate::raster::simd::{Lanes, Mask, Wide};

/// The means in the camera's axes.
#[inline(always)]
pub fn in_camera<F: Lanes, S: Source>(view: &View, source: &S, group: usize) -> [F::Wide; 3] {
    let mut p = [F::Wide::splat(0.0); 3];
    for i in 0..3 {
        p[i] = F::Wide::splat(view.translation[i]);
        for k in 0..3 {
            let mean = source.mean::<F>(group, k).widen();
            p[i] = mean.fma(F::Wide::splat(view.rotation[i][k]), p[i]);
        }
    }
    p
}

#[inline(always)]
pub fn scales<F: Lanes, S: Source>(source: &S, group: usize) -> [F; 3] {
    let mut s = [F::zero(); 3];
    for k in 0..3 {
        s[k] = source.scale(group, k);
    }
    s
}

/// J·W, the projection's Jacobian times the camera's rotation, and its factors: see [`Projected`].
pub struct Jacobian<F: Lanes> {
    pub t: [F; 2],
    pub inside: [F::Mask; 2],
    pub w: [[F; 3]; 3],
    pub jw: [[F; 3]; 2],
}

impl<F: Lanes> Jacobian<F> {
    #[inline(always)]
    pub fn of(view: &View, ray: [F; 2], rz: F) -> Self {
        let mut t = ray;
        let mut inside = [ray[0].ge(ray[0]); 2];
        for (i, lim) in [view.lim_x, view.lim_y].iter().enumerate() {
            let (low, high) = (F::splat(lim[0]), F::splat(lim[1]));
            t[i] = ray[i].max(low).min(high);
            inside[i] = ray[i].ge(low).and(high.ge(ray[i]));
        }
        let mut w = [[F::zero(); 3]; 3];
        for i in 0..3 {
            for k in 0..3 {
                w[i][k] = F::splat(view.rotation[i][k] as f32);
            }
        }
        let (jx, jy) = (rz * F::splat(view.fx as f32), rz * F::splat(view.fy as f32));
        let mut jw = [[F::zero(); 3]; 2];
        for k in 0..3 {
            jw[0][k] = jx * t[0].fnma(w[2][k], w[0][k]);
            jw[1][k] = jy * t[1].fnma(w[2][k], w[1][k]);
        }
        Self { t, inside, w, jw }
    }
}

/// M = J·W·R·S: its columns are the Gaussian's axes on the screen.
#[inline(always)]
pub fn axes_on_screen<F: Lanes>(jw: &[[F; 3]; 2], r: &[[F; 3]; 3], s: &[F; 3]) -> [[F; 3]; 2] {
    let mut m = [[F::zero(); 3]; 2];
    for i in 0..2 {
        for k in 0..3 {
            let mut sum = jw[i][0] * r[0][k];
            sum = jw[i][1].fma(r[1][k], sum);
            sum = jw[i][2].fma(r[2][k], sum);
            m[i][k] = sum * s[k];
        }
    }
    m
}
