//! Back through the projection: from a splat's gradient to the stored parameters'.

use super::{HALF_LOG2_E, INRIA_FLOOR, Projected, View, colour, direction, dot, project};
use crate::raster::params::Source;
use crate::raster::simd::Lanes;
use crate::raster::{Convention, DILATION, sh};

/// The gradient with respect to what [`project`] computed for sixteen Gaussians, as [`super::gradients`] gathers it.
pub struct ScreenGradients<F: Lanes> {
    /// Σ h·(1, u, v, u², uv, v²) over pixels, h = dL/d(ln α).
    pub moments: [F; 6],
    pub rgb: [F; 3],
    pub depth: F,
}

/// The gradient with respect to the stored parameters; SH is `basis[k] · rgb[c]`, left unmultiplied.
pub struct RowGradients<F: Lanes> {
    pub mean: [F; 3],
    pub quat: [F; 4],
    pub log_scale: [F; 3],
    pub logit_opacity: F,
    pub basis: [F; 16],
    pub rgb: [F; 3],
    pub extent: Extent<F>,
}

/// Size of a Gaussian on the screen before dilation, px²; 0 behind the near plane.
pub struct Extent<F: Lanes> {
    /// The larger variance of its ellipse.
    pub largest: F,
    /// The squared length of each of its axes.
    pub axes: [F; 3],
}

impl<F: Lanes> Extent<F> {
    /// `m` is J·W·R·S: its columns are the axes. The larger eigenvalue of MMᵀ is a root of squares: nothing cancels.
    #[inline(always)]
    fn of(m: &[[F; 3]; 2], seen: F::Mask) -> Self {
        let half = F::splat(0.5);
        let (xx, xy, yy) = (dot(&m[0], &m[0]), dot(&m[0], &m[1]), dot(&m[1], &m[1]));
        let apart = half * (xx - yy);
        let largest = half.fma(xx + yy, apart.fma(apart, xy * xy).sqrt());
        Self {
            largest: largest.only(seen),
            axes: [0, 1, 2].map(|k| m[0][k].fma(m[0][k], m[1][k] * m[1][k]).only(seen)),
        }
    }
}

/// dL/d of what lies between the stored parameters and the screen, all but colour.
struct Geometry<F: Lanes> {
    p: Projected<F>,
    log_scale: [F; 3],
    /// dL/d(the Gaussian's rotation).
    dr: [[F; 3]; 3],
    /// dL/d(mean), in the camera's axes.
    camera: [F; 3],
}

#[inline(always)]
fn geometry<F: Lanes, S: Source>(
    view: &View,
    source: &S,
    group: usize,
    g: &ScreenGradients<F>,
) -> Geometry<F> {
    let p = project::<F, S>(view, source, group);
    let zero = F::zero();
    let two = F::splat(2.0);
    let [h, hu, hv, huu, huv, hvv] = g.moments;

    // In whitened coordinates y = U·d nothing cancels: dL/dmean = Uᵀ Σhy, dL/dΣ₂ = ½ Uᵀ (Σ h y yᵀ) U.
    let rk = F::splat(1.0 / HALF_LOG2_E);
    let grad_x = p.a * hu * rk;
    let grad_y = (p.b * hu + p.c * hv) * rk;
    let half_rk2 = F::splat(0.5 / (HALF_LOG2_E * HALF_LOG2_E));
    let (uu, uv, vv) = (huu * half_rk2, huv * half_rk2, hvv * half_rk2);
    let left = p.b * uu + p.c * uv;
    let right = p.b * uv + p.c * vv;
    let gxx = p.a * p.a * uu;
    let gxy = p.a * left;
    let gyy = p.b * left + p.c * right;

    let mut dm = [[zero; 3]; 2];
    for k in 0..3 {
        dm[0][k] = two * (gxx * p.m[0][k] + gxy * p.m[1][k]);
        dm[1][k] = two * (gxy * p.m[0][k] + gyy * p.m[1][k]);
    }
    if view.antialiased {
        add_antialiasing(view, &p, h, &mut dm);
    }

    let mut log_scale = [zero; 3];
    let mut dt = [[zero; 3]; 2];
    for k in 0..3 {
        log_scale[k] = dm[0][k].fma(p.m[0][k], dm[1][k] * p.m[1][k]);
        dt[0][k] = dm[0][k] * p.s[k];
        dt[1][k] = dm[1][k] * p.s[k];
    }
    let mut dr = [[zero; 3]; 3];
    let mut djw = [[zero; 3]; 2];
    for a in 0..3 {
        for k in 0..3 {
            dr[a][k] = p.jw[0][a] * dt[0][k] + p.jw[1][a] * dt[1][k];
            for i in 0..2 {
                djw[i][a] = dt[i][k].fma(p.r[a][k], djw[i][a]);
            }
        }
    }
    let camera = through_camera(view, &p, [grad_x, grad_y], g.depth, &djw);
    Geometry {
        p,
        log_scale,
        dr,
        camera,
    }
}

/// Back through the projection of one group. Lanes with zero `moments`, `rgb` and `depth` get zeros.
#[inline(always)]
pub fn unproject<F: Lanes, S: Source>(
    view: &View,
    source: &S,
    group: usize,
    g: &ScreenGradients<F>,
) -> RowGradients<F> {
    let Geometry {
        p,
        log_scale,
        dr,
        camera,
    } = geometry(view, source, group, g);
    let quat = quaternion_gradient(&p.q, p.rq, &dr);
    let mut mean = [F::zero(); 3];
    for k in 0..3 {
        mean[k] = camera[0] * p.w[0][k] + camera[1] * p.w[1][k] + camera[2] * p.w[2][k];
    }
    let (basis, rgb) = through_colour(view, source, group, g.rgb, &mut mean);
    RowGradients {
        mean,
        quat,
        log_scale,
        logit_opacity: g.moments[0] * p.rest_opacity,
        basis,
        rgb,
        extent: Extent::of(&p.m, p.depth.ge(F::splat(view.near))),
    }
}

/// Add to dL/d(mean) the part that comes through the colour's direction. Return the SH basis, and dL/d(colour) where
/// the colour was not clipped at 0.
#[inline(always)]
fn through_colour<F: Lanes, S: Source>(
    view: &View,
    source: &S,
    group: usize,
    mut rgb: [F; 3],
    mean: &mut [F; 3],
) -> ([F; 16], [F; 3]) {
    let (dir, r_distance) = direction::<F, S>(view, source, group);
    let coeffs = source.sh_coeffs();
    let mut basis = [F::zero(); 16];
    sh::basis(coeffs, dir[0], dir[1], dir[2], &mut basis);
    let value = colour::<F, S>(source, group, &basis);
    for c in 0..3 {
        rgb[c] = rgb[c].only(value[c].gt(F::zero()));
    }
    if coeffs > 1 {
        let mut weights = [F::zero(); 16];
        for k in 1..coeffs {
            for c in 0..3 {
                weights[k] = source.sh::<F>(group, k, c).fma(rgb[c], weights[k]);
            }
        }
        let d = sh::gradient(coeffs, dir[0], dir[1], dir[2], &weights);
        let radial = d[0] * dir[0] + d[1] * dir[1] + d[2] * dir[2];
        for k in 0..3 {
            mean[k] = mean[k] + (d[k] - dir[k] * radial) * r_distance;
        }
    }
    (basis, rgb)
}

/// Add to dL/dM the part of the opacity's factor √(det0 / det): det = det0 + 0.3·tr + 0.09, det0 = |minors|², minors =
/// M₀ × M₁; `h` is the gradient of the opacity's logarithm.
#[inline(always)]
fn add_antialiasing<F: Lanes>(view: &View, p: &Projected<F>, h: F, dm: &mut [[F; 3]; 2]) {
    let mut weight = h;
    if view.convention == Convention::Inria {
        weight = h.only((p.det0 / p.det).gt(F::splat(INRIA_FLOOR)));
    }
    let r_det = F::splat(1.0) / p.det;
    let r_det0 = F::splat(1.0) / p.det0.max(F::splat(f32::MIN_POSITIVE));
    let on_minors = weight * (r_det0 - r_det);
    let on_trace = weight * F::splat(DILATION) * r_det;
    for k in 0..3 {
        let (i, j) = ((k + 1) % 3, (k + 2) % 3);
        let (ni, nj) = (p.minors[i] * on_minors, p.minors[j] * on_minors);
        dm[0][k] = dm[0][k] + (p.m[1][i] * nj - p.m[1][j] * ni) - on_trace * p.m[0][k];
        dm[1][k] = dm[1][k] + (ni * p.m[0][j] - nj * p.m[0][i]) - on_trace * p.m[1][k];
    }
}

/// dL/d(mean), in the camera's axes, from the gradients of the centre on screen, of the depth and of
/// J·W = (f/z)·(Wᵢ − t·W₂): through the 1/z in front, and through t where it was not clamped.
#[inline(always)]
fn through_camera<F: Lanes>(
    view: &View,
    p: &Projected<F>,
    on_screen: [F; 2],
    depth: F,
    djw: &[[F; 3]; 2],
) -> [F; 3] {
    let focal = [F::splat(view.fx as f32), F::splat(view.fy as f32)];
    let mut camera = [F::zero(), F::zero(), depth];
    for i in 0..2 {
        let mut along = F::zero();
        let mut on_t = F::zero();
        for k in 0..3 {
            along = djw[i][k].fma(p.jw[i][k], along);
            on_t = djw[i][k].fma(p.w[2][k], on_t);
        }
        let j = focal[i] * p.rz;
        let through_t = (-(on_t * j * p.rz)).only(p.inside[i]);
        let through_ray = on_screen[i] * j;
        camera[i] = through_t + through_ray;
        camera[2] = camera[2] - through_t * p.t[i] - through_ray * p.ray[i] - along * p.rz;
    }
    camera
}

/// dL/dR → dL/dq for R(q/|q|), from the unit quaternion and 1/|q|.
#[inline(always)]
pub fn quaternion_gradient<F: Lanes>(q: &[F; 4], rq: F, g: &[[F; 3]; 3]) -> [F; 4] {
    let [w, x, y, z] = *q;
    let two = F::splat(2.0);
    let (sxy, sxz, syz) = (g[0][1] + g[1][0], g[0][2] + g[2][0], g[1][2] + g[2][1]);
    let (ax, ay, az) = (g[2][1] - g[1][2], g[0][2] - g[2][0], g[1][0] - g[0][1]);
    let d = [
        two * (x * ax + y * ay + z * az),
        two * (w * ax + y * sxy + z * sxz - two * x * (g[1][1] + g[2][2])),
        two * (w * ay + x * sxy + z * syz - two * y * (g[0][0] + g[2][2])),
        two * (w * az + x * sxz + y * syz - two * z * (g[0][0] + g[1][1])),
    ];
    let radial = w * d[0] + x * d[1] + y * d[2] + z * d[3];
    let mut out = [F::zero(); 4];
    for k in 0..4 {
        out[k] = (d[k] - q[k] * radial) * rq;
    }
    out
}
