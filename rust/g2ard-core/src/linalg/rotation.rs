//! Quaternion ↔ rotation. Quaternions are wxyz throughout.

/// Row-major: `m[row][column]`.
pub type Mat3 = [[f64; 3]; 3];

/// The rotation of a quaternion of any length. Zero (or one that is not finite) means no rotation.
pub fn rotation_from_quat(q: [f64; 4]) -> Mat3 {
    let largest = q.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    if largest == 0.0 || !q.iter().all(|v| v.is_finite()) {
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    }
    // Dividing by the largest first: squares of 1e±200 would leave the range of f64.
    let q = q.map(|v| v / largest);
    let length = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
    let [w, x, y, z] = q.map(|v| v / length);
    [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ]
}

fn det(m: &Mat3) -> f64 {
    m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
        - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
}

/// Shepperd's method: divides by the largest of the four components, so it never meets 0/0.
/// A left-handed frame has its last column flipped; the first non-zero component comes out positive.
pub fn quat_from_rotation(m: &Mat3) -> [f64; 4] {
    let mut m = *m;
    if det(&m) < 0.0 {
        for row in &mut m {
            row[2] = -row[2];
        }
    }
    let trace = m[0][0] + m[1][1] + m[2][2];
    let candidates = [trace, m[0][0], m[1][1], m[2][2]];
    let k = (1..4).fold(0, |best, i| {
        if candidates[i] > candidates[best] {
            i
        } else {
            best
        }
    });
    let q = match k {
        0 => [
            1.0 + trace,
            m[2][1] - m[1][2],
            m[0][2] - m[2][0],
            m[1][0] - m[0][1],
        ],
        1 => [
            m[2][1] - m[1][2],
            1.0 + 2.0 * m[0][0] - trace,
            m[0][1] + m[1][0],
            m[0][2] + m[2][0],
        ],
        2 => [
            m[0][2] - m[2][0],
            m[0][1] + m[1][0],
            1.0 + 2.0 * m[1][1] - trace,
            m[1][2] + m[2][1],
        ],
        _ => [
            m[1][0] - m[0][1],
            m[0][2] + m[2][0],
            m[1][2] + m[2][1],
            1.0 + 2.0 * m[2][2] - trace,
        ],
    };
    let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    let first = q.iter().copied().find(|v| *v != 0.0).unwrap_or(1.0);
    q.map(|v| v / length * first.signum())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn max_difference(a: &Mat3, b: &Mat3) -> f64 {
        (0..9).fold(0.0, |m: f64, i| {
            m.max((a[i / 3][i % 3] - b[i / 3][i % 3]).abs())
        })
    }

    #[test]
    fn round_trips_everywhere_and_near_a_half_turn() {
        let mut cases = Vec::new();
        for i in 0..7 {
            for tiny in [0.0, 1e-16, 1e-8, 1e-3, 0.4] {
                let axis = [f64::from(i & 1), f64::from(i & 2), f64::from((i & 4) + 1)];
                cases.push([tiny, axis[0], axis[1], axis[2]]);
                cases.push([1.0, tiny * axis[0], -tiny * axis[1], tiny * axis[2]]);
            }
        }
        for q in cases {
            let r = rotation_from_quat(q);
            let back = rotation_from_quat(quat_from_rotation(&r));
            assert!(max_difference(&r, &back) <= 1e-14, "{q:?}");
            let single = quat_from_rotation(&r).map(|v| f64::from(v as f32));
            assert!(max_difference(&r, &rotation_from_quat(single)) <= 1e-6);
        }
    }

    #[test]
    fn length_does_not_matter() {
        let q = [0.3, -0.4, 0.5, 0.6];
        let unit = rotation_from_quat(q);
        for factor in [1e-300, 1e-30, 1e30, 1e300] {
            assert!(max_difference(&unit, &rotation_from_quat(q.map(|v| v * factor))) <= 1e-14);
        }
        let identity = rotation_from_quat([0.0; 4]);
        assert_eq!(identity, rotation_from_quat([1.0, 0.0, 0.0, 0.0]));
        assert_eq!(identity, rotation_from_quat([f64::NAN, 0.0, 0.0, 0.0]));
    }

    #[test]
    fn a_mirrored_frame_is_made_right_handed() {
        let mirrored = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]];
        assert_eq!(quat_from_rotation(&mirrored), [1.0, 0.0, 0.0, 0.0]);
    }
}
