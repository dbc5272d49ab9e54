//! Small dense linear algebra in f64: symmetric 3×3 eigen, quaternions, affine least squares.

mod affine;
mod eigen;
mod rotation;

pub use affine::affine_energy;
pub use eigen::{Eigen, symmetric_eigen};
pub use rotation::{Mat3, quat_from_rotation, rotation_from_quat};

/// A symmetric 3×3 matrix: xx, xy, xz, yy, yz, zz.
pub type Sym3 = [f64; 6];

pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

pub fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// d dᵀ.
pub fn outer(d: [f64; 3]) -> Sym3 {
    [
        d[0] * d[0],
        d[0] * d[1],
        d[0] * d[2],
        d[1] * d[1],
        d[1] * d[2],
        d[2] * d[2],
    ]
}

/// R diag(s²) Rᵀ: the covariance of a Gaussian with rotation `r` and standard deviations `s`.
pub fn covariance(r: &Mat3, s: [f64; 3]) -> Sym3 {
    let v = [s[0] * s[0], s[1] * s[1], s[2] * s[2]];
    let entry = |i: usize, j: usize| {
        r[i][0] * v[0] * r[j][0] + r[i][1] * v[1] * r[j][1] + r[i][2] * v[2] * r[j][2]
    };
    [
        entry(0, 0),
        entry(0, 1),
        entry(0, 2),
        entry(1, 1),
        entry(1, 2),
        entry(2, 2),
    ]
}
