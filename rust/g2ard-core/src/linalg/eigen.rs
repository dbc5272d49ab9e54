//! Cyclic Jacobi: slower than the closed form, but it keeps every digit where eigenvalues meet.

use super::Sym3;

/// Eigenvalues in descending order; `vectors[k]` is the unit vector of `values[k]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Eigen {
    pub values: [f64; 3],
    pub vectors: [[f64; 3]; 3],
}

/// Sweeps until the off-diagonal is gone; four or five do for any 3×3 matrix.
const MAX_SWEEPS: usize = 32;

/// A = Σ_k λ_k v_k v_kᵀ. Every step is homogeneous in A, so scaling A by a power of two scales λ exactly.
pub fn symmetric_eigen(m: &Sym3) -> Eigen {
    let mut a = [[m[0], m[1], m[2]], [m[1], m[3], m[4]], [m[2], m[4], m[5]]];
    let mut v = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for _ in 0..MAX_SWEEPS {
        if a[0][1] == 0.0 && a[0][2] == 0.0 && a[1][2] == 0.0 {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            rotate(&mut a, &mut v, p, q);
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a[j][j].total_cmp(&a[i][i]));
    Eigen {
        values: order.map(|k| a[k][k]),
        vectors: order.map(|k| v[k]),
    }
}

/// One Jacobi rotation that zeroes a[p][q]; the rows of `v` are the vectors.
fn rotate(a: &mut [[f64; 3]; 3], v: &mut [[f64; 3]; 3], p: usize, q: usize) {
    let apq = a[p][q];
    let (app, aqq) = (a[p][p], a[q][q]);
    let small = 100.0 * apq.abs();
    if app.abs() + small == app.abs() && aqq.abs() + small == aqq.abs() {
        (a[p][q], a[q][p]) = (0.0, 0.0); // below the last digit of both
        return;
    }
    let theta = (aqq - app) / (2.0 * apq);
    // For |θ| > 1e150 the square would overflow; t = 1/(2θ) is exact there.
    let t = if theta.abs() > 1e150 {
        0.5 / theta
    } else {
        theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt())
    };
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    a[p][p] = app - t * apq;
    a[q][q] = aqq + t * apq;
    (a[p][q], a[q][p]) = (0.0, 0.0);
    let r = 3 - p - q;
    let (arp, arq) = (a[r][p], a[r][q]);
    (a[r][p], a[r][q]) = (c * arp - s * arq, s * arp + c * arq);
    (a[p][r], a[q][r]) = (a[r][p], a[r][q]);
    for i in 0..3 {
        let (x, y) = (v[p][i], v[q][i]);
        (v[p][i], v[q][i]) = (c * x - s * y, s * x + c * y);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linalg::{covariance, rotation_from_quat};
    use crate::random::Lcg;

    fn norm(m: &Sym3) -> f64 {
        let off = m[1] * m[1] + m[2] * m[2] + m[4] * m[4];
        (m[0] * m[0] + m[3] * m[3] + m[5] * m[5] + 2.0 * off).sqrt()
    }

    /// ‖VΛVᵀ − A‖ / ‖A‖ and ‖VᵀV − I‖.
    fn errors(m: &Sym3) -> (f64, f64) {
        let e = symmetric_eigen(m);
        let mut back = [0.0; 6];
        for k in 0..3 {
            let o = crate::linalg::outer(e.vectors[k]);
            for i in 0..6 {
                back[i] += e.values[k] * o[i];
            }
        }
        for i in 0..6 {
            back[i] -= m[i];
        }
        let mut ortho = 0.0;
        for i in 0..3 {
            for j in 0..3 {
                let want = f64::from(u8::from(i == j));
                ortho += (crate::linalg::dot(e.vectors[i], e.vectors[j]) - want).powi(2);
            }
        }
        assert!(e.values[0] >= e.values[1] && e.values[1] >= e.values[2]);
        (norm(&back) / norm(m).max(f64::MIN_POSITIVE), ortho.sqrt())
    }

    #[test]
    fn keeps_every_digit_where_eigenvalues_meet() {
        let mut random = Lcg(1);
        let mut next = || random.centred();
        let spectra = [
            [1.0, 1.0, 1.0],
            [1.0, 1.0, 1.0 + 1e-6],
            [1.0, 1e-8, 1e-8],
            [1.0, 0.0, 0.0],
            [3.0, 2.0, 1e-14],
            [1e30, 1e10, 1e-10],
        ];
        for values in spectra {
            for _ in 0..200 {
                let r = rotation_from_quat([next(), next(), next(), next()]);
                let m = covariance(&r, values.map(f64::sqrt));
                let (residual, ortho) = errors(&m);
                assert!(
                    residual <= 1e-14 && ortho <= 1e-14,
                    "{values:?}: {residual:e} {ortho:e}"
                );
            }
        }
    }

    #[test]
    fn scales_exactly_by_powers_of_two() {
        let m = [2.3, 0.7, -0.1, 1.9, 0.33, 0.5];
        let (a, b) = (symmetric_eigen(&m), symmetric_eigen(&m.map(|x| x * 1024.0)));
        assert_eq!(a.values.map(|x| x * 1024.0), b.values);
        assert_eq!(a.vectors, b.vectors);
    }

    #[test]
    fn zero_and_diagonal() {
        assert_eq!(symmetric_eigen(&[0.0; 6]).values, [0.0; 3]);
        let e = symmetric_eigen(&[1.0, 0.0, 0.0, 3.0, 0.0, 2.0]);
        assert_eq!(e.values, [3.0, 2.0, 1.0]);
        assert_eq!(e.vectors[0], [0.0, 1.0, 0.0]);
    }
}
