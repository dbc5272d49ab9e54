//! Gaussians → screen splats, sixteen at a time (EWA: Σ₂ = J W R S Sᵀ Rᵀ Wᵀ Jᵀ + 0.3 I).

mod jacobian;
mod screen;
mod unproject;

use super::params::Source;
use super::simd::{LANES, LOG2_E, Lanes, Lanes16, Mask, Wide};
use super::{ALPHA_MIN, Camera, Convention, DILATION, Settings};

use jacobian::{Jacobian, axes_on_screen, in_camera, scales};

pub use screen::Project;
pub use unproject::{RowGradients, ScreenGradients, quaternion_gradient, unproject};

/// ½·log2(e): exponents are kept in powers of two, so exp(−½ dᵀΣ₂⁻¹d) = 2^−(u² + v²).
pub const HALF_LOG2_E: f32 = 0.5 * LOG2_E;
/// Beyond this determinant (px⁴) f32 runs out; such a splat is wider than 10⁸ images and is culled.
const DET_MAX: f32 = 1e33;
/// INRIA's floor under det Σ₂ / det(Σ₂ + 0.3 I).
const INRIA_FLOOR: f32 = 2.5e-5;

/// A camera's numbers in the form the kernels take.
#[derive(Debug, Clone, Copy)]
pub struct View {
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
    position: [f64; 3],
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    width: f32,
    height: f32,
    near: f32,
    /// x/z and y/z are clamped to these in the Jacobian: 1.3 half-fields of view about the principal point's image.
    lim_x: [f32; 2],
    lim_y: [f32; 2],
    convention: Convention,
    antialiased: bool,
}

impl View {
    pub fn new(camera: &Camera, settings: &Settings) -> Self {
        let v = &camera.viewmat;
        let (w, h) = (camera.width as f64, camera.height as f64);
        let (mx, my) = (0.15 * w / camera.fx, 0.15 * h / camera.fy);
        Self {
            rotation: v.map(|r| [r[0], r[1], r[2]]),
            translation: v.map(|r| r[3]),
            position: camera.position(),
            fx: camera.fx,
            fy: camera.fy,
            cx: camera.cx,
            cy: camera.cy,
            width: camera.width as f32,
            height: camera.height as f32,
            near: camera.near,
            lim_x: [
                (-camera.cx / camera.fx - mx) as f32,
                ((w - camera.cx) / camera.fx + mx) as f32,
            ],
            lim_y: [
                (-camera.cy / camera.fy - my) as f32,
                ((h - camera.cy) / camera.fy + my) as f32,
            ],
            convention: settings.convention,
            antialiased: settings.antialiased,
        }
    }
}

/// Values of one Gaussian that blending needs: a cache line.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub struct Splat {
    /// Centre in pixels; f64, for an f32 pixel coordinate is only good to 3e-5.
    pub x: f64,
    pub y: f64,
    /// u = a·dx + b·dy, v = c·dy, and u² + v² is the exponent in powers of two.
    pub a: f32,
    pub b: f32,
    pub c: f32,
    /// log2 of the opacity (times the antialiasing factor).
    pub log2_opacity: f32,
    pub rgb: [f32; 3],
    pub depth: f32,
    /// The Gaussian's row.
    pub row: u32,
    /// Number of tiles that it meets, and the number of its first slot within its chunk.
    pub tiles: u32,
    pub slot: u32,
}

/// Intermediate values that the forward and the backward projection share.
pub struct Projected<F: Lanes> {
    /// Lanes that can touch the image.
    pub visible: F::Mask,
    pub x: F::Wide,
    pub y: F::Wide,
    pub depth: F,
    pub rz: F,
    /// x/z and y/z; `t` is clamped, `inside` says where it was not.
    pub ray: [F; 2],
    pub t: [F; 2],
    pub inside: [F::Mask; 2],
    /// The camera's rotation and J·W.
    pub w: [[F; 3]; 3],
    pub jw: [[F; 3]; 2],
    /// Unit quaternion and 1/|q|, 0 for a zero quaternion.
    pub q: [F; 4],
    pub rq: F,
    pub r: [[F; 3]; 3],
    pub s: [F; 3],
    /// J·W·R and J·W·R·S.
    pub m: [[F; 3]; 2],
    pub minors: [F; 3],
    pub det0: F,
    pub det: F,
    pub a: F,
    pub b: F,
    pub c: F,
    pub log2_opacity: F,
    /// 1 − opacity.
    pub rest_opacity: F,
    pub radius: F,
    /// Half the width and height of the ellipse at α = 1/255, pixels.
    pub half: [F; 2],
}

/// exp(−|x|)-based logistic: (log2 σ(x), 1 − σ(x)).
#[inline(always)]
fn logistic<F: Lanes>(x: F) -> (F, F) {
    let e = (-x.abs()).exp();
    let one = F::splat(1.0);
    let r = one / (one + e);
    let rest = F::select(x.gt(F::zero()), e * r, r);
    let log2 = -(e.log2_1p()) + x.min(F::zero()) * F::splat(LOG2_E);
    (log2, rest)
}

#[inline(always)]
pub fn project<F: Lanes, S: Source>(view: &View, source: &S, group: usize) -> Projected<F> {
    let one = F::splat(1.0);
    let p = in_camera::<F, S>(view, source, group);
    let depth = F::narrow(p[2]);
    let near = F::splat(view.near);
    let mut visible = match view.convention {
        Convention::Gsplat => depth.ge(near),
        Convention::Inria => depth.gt(near),
    };
    // Lanes behind the camera go on with z = 1, so that nothing below is infinite.
    let behind = F::select(visible, F::zero(), one).widen();
    let in_front = F::select(visible, one, F::zero()).widen();
    let z = p[2].fma(in_front, behind);
    let rz_wide = F::Wide::splat(1.0) / z;
    let (ray_x, ray_y) = (p[0] * rz_wide, p[1] * rz_wide);
    let x = ray_x.fma(F::Wide::splat(view.fx), F::Wide::splat(view.cx));
    let y = ray_y.fma(F::Wide::splat(view.fy), F::Wide::splat(view.cy));
    let ray = [F::narrow(ray_x), F::narrow(ray_y)];
    let rz = F::narrow(rz_wide);

    let Jacobian { t, inside, w, jw } = Jacobian::of(view, ray, rz);
    let (q, rq) = unit_quaternion::<F, S>(source, group);
    let r = rotation(&q);
    let s = scales(source, group);
    let m = axes_on_screen(&jw, &r, &s);
    let minors = cross(&m[0], &m[1]);
    let blur = F::splat(DILATION);
    let (xx, xy, yy) = (dot(&m[0], &m[0]), dot(&m[0], &m[1]), dot(&m[1], &m[1]));
    // Cauchy–Binet: det(MMᵀ) is the sum of squared minors. xx·yy − xy² would lose every digit on a needle.
    let det0 = dot(&minors, &minors);
    let det = det0 + blur.fma(xx + yy, blur * blur);
    let (xx, yy) = (xx + blur, yy + blur);
    visible = visible.and(F::splat(DET_MAX).ge(det));

    let (log2_sigma, rest_opacity) = logistic(source.logit_opacity::<F>(group));
    let log2_opacity = antialiased(view, log2_sigma, det0, det);
    let reach = log2_opacity - F::splat(ALPHA_MIN.log2());
    visible = visible.and(reach.ge(F::zero()));

    let k2 = F::splat(HALF_LOG2_E);
    let c = (k2 / yy).sqrt();
    let a = (k2 * yy / det).sqrt();
    let b = -(xy / yy * a);
    let mut radius = F::splat(f32::INFINITY);
    if view.convention == Convention::Inria {
        radius = inria_radius(xx + yy, det);
    }
    let out_x = (xx * reach.max(F::zero()) / k2).sqrt();
    let out_y = (yy * reach.max(F::zero()) / k2).sqrt();
    visible = visible
        .and(on_image(F::narrow(x), out_x, view.width))
        .and(on_image(F::narrow(y), out_y, view.height));
    Projected {
        visible,
        x,
        y,
        depth,
        rz,
        ray,
        t,
        inside,
        w,
        jw,
        q,
        rq,
        r,
        s,
        m,
        minors,
        det0,
        det,
        a,
        b,
        c,
        log2_opacity,
        rest_opacity,
        radius,
        half: [out_x, out_y],
    }
}

#[inline(always)]
fn cross<F: Lanes>(a: &[F; 3], b: &[F; 3]) -> [F; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// Half the side of the square that INRIA's kernel draws within: three standard deviations, rounded up.
#[inline(always)]
fn inria_radius<F: Lanes>(trace: F, det: F) -> F {
    let mid = F::splat(0.5) * trace;
    let lambda = mid + (mid.fma(mid, -det)).max(F::splat(0.1)).sqrt();
    let r3 = F::splat(3.0) * lambda.sqrt();
    -((-r3).floor())
}

#[inline(always)]
fn dot<F: Lanes>(a: &[F; 3], b: &[F; 3]) -> F {
    a[2].fma(b[2], a[1].fma(b[1], a[0] * b[0]))
}

/// Whether [centre − extent, centre + extent] meets the pixel centres 0.5 … size − 0.5, with room for rounding.
#[inline(always)]
fn on_image<F: Lanes>(centre: F, extent: F, size: f32) -> F::Mask {
    let extent = extent.fma(F::splat(1.0001), F::splat(0.01));
    let after = (centre + extent).ge(F::splat(0.5));
    after.and(F::splat(size - 0.5).ge(centre - extent))
}

/// The logarithm of an opacity, times √(det0 / det) if antialiased.
#[inline(always)]
fn antialiased<F: Lanes>(view: &View, log2_opacity: F, det0: F, det: F) -> F {
    if !view.antialiased {
        return log2_opacity;
    }
    let mut ratio = det0 / det;
    if view.convention == Convention::Inria {
        ratio = ratio.max(F::splat(INRIA_FLOOR));
    }
    log2_opacity + half_log2(ratio)
}

/// ½·log2(x), lane by lane: only antialiasing needs it.
#[inline(always)]
fn half_log2<F: Lanes>(x: F) -> F {
    let mut row = Lanes16::default();
    x.store(&mut row);
    for l in 0..LANES {
        row.0[l] = 0.5 * row.0[l].log2();
    }
    F::load(&row)
}

#[inline(always)]
pub fn unit_quaternion<F: Lanes, S: Source>(source: &S, group: usize) -> ([F; 4], F) {
    let mut q = [F::zero(); 4];
    for k in 0..4 {
        q[k] = source.quat::<F>(group, k);
    }
    // Divided by the largest part first: squares of 1e±30 leave f32.
    let largest = q[0].abs().max(q[1].abs()).max(q[2].abs().max(q[3].abs()));
    let some = largest.gt(F::zero());
    let shrink = (F::splat(1.0) / F::select(some, largest, F::splat(1.0))).only(some);
    for k in 0..4 {
        q[k] = q[k] * shrink;
    }
    q[0] = F::select(some, q[0], F::splat(1.0));
    let norm2 = q[3].fma(q[3], q[2].fma(q[2], q[1].fma(q[1], q[0] * q[0])));
    let rn = F::splat(1.0) / norm2.sqrt();
    for k in 0..4 {
        q[k] = q[k] * rn;
    }
    (q, rn * shrink)
}

/// The rotation of unit quaternions, in lanes of f32. [`crate::linalg::rotation_from_quat`] is the scalar f64 one, which
/// normalises too: SIMD lanes cannot share its code, nor f32 its bits.
#[inline(always)]
pub fn rotation<F: Lanes>(q: &[F; 4]) -> [[F; 3]; 3] {
    let [w, x, y, z] = *q;
    let (one, two) = (F::splat(1.0), F::splat(2.0));
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, xz, yz) = (x * y, x * z, y * z);
    let (wx, wy, wz) = (w * x, w * y, w * z);
    [
        [one - two * (yy + zz), two * (xy - wz), two * (xz + wy)],
        [two * (xy + wz), one - two * (xx + zz), two * (yz - wx)],
        [two * (xz - wy), two * (yz + wx), one - two * (xx + yy)],
    ]
}

/// The unit direction from the camera, and 1/distance.
#[inline(always)]
pub fn direction<F: Lanes, S: Source>(view: &View, source: &S, group: usize) -> ([F; 3], F) {
    let mut d = [F::zero(); 3];
    for k in 0..3 {
        let from = F::Wide::splat(-view.position[k]);
        d[k] = F::narrow(source.mean::<F>(group, k).widen() + from);
    }
    let length2 = d[2].fma(d[2], d[1].fma(d[1], d[0] * d[0]));
    let r = F::splat(1.0) / length2.max(F::splat(1e-30)).sqrt();
    ([d[0] * r, d[1] * r, d[2] * r], r)
}

/// 0.5 + Σₖ basisₖ·shₖ, not clamped.
#[inline(always)]
pub fn colour<F: Lanes, S: Source>(source: &S, group: usize, basis: &[F; 16]) -> [F; 3] {
    let mut rgb = [F::splat(0.5); 3];
    for k in 0..source.sh_coeffs() {
        for c in 0..3 {
            rgb[c] = basis[k].fma(source.sh::<F>(group, k, c), rgb[c]);
        }
    }
    rgb
}

#[cfg(test)]
impl Splat {
    /// See [`Ellipses::level`].
    pub fn level(&self) -> f32 {
        (self.log2_opacity - ALPHA_MIN.log2()).max(0.0) * 1.000_1 + 1e-4
    }

    /// Half the width and height of that ellipse: Σ_xx ∝ (b² + c²)/(a·c)², Σ_yy ∝ 1/c².
    pub fn half_extents(&self) -> [f32; 2] {
        let root = (self.b * self.b + self.c * self.c).sqrt();
        let level = self.level().sqrt();
        [level * root / (self.a * self.c), level / self.c]
    }
}

const _: () = assert!(size_of::<Splat>() == 64);
