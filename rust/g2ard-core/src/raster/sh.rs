//! Real spherical harmonics of degree 0–3, in 3DGS's order and signs, and their derivatives.

use super::simd::Lanes;

pub const C0: f32 = 0.282_094_79;
const C1: f32 = 0.488_602_51;
const C2: [f32; 3] = [1.092_548_4, 0.315_391_57, 0.546_274_2];
const C3: [f32; 4] = [0.590_043_6, 2.890_611_4, 0.457_045_8, 0.373_176_33];

/// The first `coeffs` basis functions at the unit vector (x, y, z); the others are not written.
#[inline(always)]
pub fn basis<F: Lanes>(coeffs: usize, x: F, y: F, z: F, out: &mut [F; 16]) {
    let s = F::splat;
    out[0] = s(C0);
    if coeffs > 1 {
        out[1] = s(-C1) * y;
        out[2] = s(C1) * z;
        out[3] = s(-C1) * x;
    }
    if coeffs > 4 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        out[4] = s(C2[0]) * x * y;
        out[5] = s(-C2[0]) * y * z;
        out[6] = s(C2[1]) * (s(2.0) * zz - xx - yy);
        out[7] = s(-C2[0]) * x * z;
        out[8] = s(C2[2]) * (xx - yy);
        if coeffs > 9 {
            out[9] = s(-C3[0]) * y * (s(3.0) * xx - yy);
            out[10] = s(C3[1]) * x * y * z;
            out[11] = s(-C3[2]) * y * (s(4.0) * zz - xx - yy);
            out[12] = s(C3[3]) * z * (s(2.0) * zz - s(3.0) * (xx + yy));
            out[13] = s(-C3[2]) * x * (s(4.0) * zz - xx - yy);
            out[14] = s(0.5 * C3[1]) * z * (xx - yy);
            out[15] = s(-C3[0]) * x * (xx - s(3.0) * yy);
        }
    }
}

/// Σₖ weights[k]·∇basisₖ at (x, y, z), as if the functions were polynomials over all of space.
#[inline(always)]
pub fn gradient<F: Lanes>(coeffs: usize, x: F, y: F, z: F, w: &[F; 16]) -> [F; 3] {
    let s = F::splat;
    if coeffs == 1 {
        return [F::zero(); 3];
    }
    let mut gx = s(-C1) * w[3];
    let mut gy = s(-C1) * w[1];
    let mut gz = s(C1) * w[2];
    if coeffs > 4 {
        let a = s(C2[0]);
        let (b, c) = (s(2.0 * C2[1]), s(2.0 * C2[2]));
        gx = gx + a * (y * w[4] - z * w[7]) + x * (c * w[8] - b * w[6]);
        gy = gy + a * (x * w[4] - z * w[5]) - y * (b * w[6] + c * w[8]);
        gz = gz - a * (y * w[5] + x * w[7]) + s(2.0) * b * z * w[6];
    }
    if coeffs > 9 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (xy, yz, xz) = (x * y, y * z, x * z);
        let (a, b, c, d) = (s(C3[0]), s(C3[1]), s(C3[2]), s(C3[3]));
        gx = gx - s(6.0) * a * xy * w[9] + b * yz * w[10] + s(2.0) * c * xy * w[11]
            - s(6.0) * d * xz * w[12]
            - c * (s(4.0) * zz - s(3.0) * xx - yy) * w[13]
            + b * xz * w[14]
            - s(3.0) * a * (xx - yy) * w[15];
        gy = gy - s(3.0) * a * (xx - yy) * w[9] + b * xz * w[10]
            - c * (s(4.0) * zz - xx - s(3.0) * yy) * w[11]
            - s(6.0) * d * yz * w[12]
            + s(2.0) * c * xy * w[13]
            - b * yz * w[14]
            + s(6.0) * a * xy * w[15];
        gz = gz + b * xy * w[10] - s(8.0) * c * yz * w[11]
            + d * (s(6.0) * zz - s(3.0) * (xx + yy)) * w[12]
            - s(8.0) * c * xz * w[13]
            + s(0.5) * b * (xx - yy) * w[14];
    }
    [gx, gy, gz]
}
