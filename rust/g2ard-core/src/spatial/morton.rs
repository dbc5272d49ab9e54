//! Morton (Z) order: points near each other in space lie near each other in memory.

use rayon::prelude::*;

use super::RobustBounds;

/// Bits per axis of a code.
pub const BITS: u32 = 21;
const LAST: f64 = ((1u32 << BITS) - 1) as f64;

/// The finest cell: the bounds' cube is 2²¹ of them wide.
pub fn unit(bounds: &RobustBounds) -> f64 {
    2.0 * bounds.radius / (1u64 << BITS) as f64
}

/// Every third bit of the result is a bit of `v`.
fn spread(v: u64) -> u64 {
    let mut x = v & 0x1f_ffff;
    x = (x | x << 32) & 0x001f_0000_0000_ffff;
    x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

fn gather(v: u64) -> u64 {
    let mut x = v & 0x1249_2492_4924_9249;
    x = (x | x >> 2) & 0x10c3_0c30_c30c_30c3;
    x = (x | x >> 4) & 0x100f_00f0_0f00_f00f;
    x = (x | x >> 8) & 0x001f_0000_ff00_00ff;
    x = (x | x >> 16) & 0x001f_0000_0000_ffff;
    (x | x >> 32) & 0x1f_ffff
}

pub fn encode(cell: [u64; 3]) -> u64 {
    spread(cell[0]) | spread(cell[1]) << 1 | spread(cell[2]) << 2
}

pub fn decode(code: u64) -> [u64; 3] {
    [gather(code), gather(code >> 1), gather(code >> 2)]
}

/// Lattice coordinates of `p`, cells of `size` counted from the lower corner of the bounds' cube.
fn cell(p: [f64; 3], bounds: &RobustBounds, size: f64) -> [f64; 3] {
    [0, 1, 2].map(|k| ((p[k] - bounds.origin[k] + bounds.radius) / size).floor())
}

/// The code of the cell that holds `p`; None where it lies outside the lattice.
pub fn code_inside(p: [f64; 3], bounds: &RobustBounds, size: f64) -> Option<u64> {
    let cell = cell(p, bounds, size);
    let inside = cell.iter().all(|&c| (0.0..=LAST).contains(&c));
    inside.then(|| encode(cell.map(|c| c as u64)))
}

/// The 63-bit code of a point's finest cell; points beyond the bounds are clamped onto their faces.
pub fn code(point: [f64; 3], bounds: &RobustBounds) -> u64 {
    encode(cell(point, bounds, unit(bounds)).map(|c| c.clamp(0.0, LAST) as u64))
}

/// The code of every point.
pub fn codes(points: &[[f64; 3]], bounds: &RobustBounds) -> Vec<u64> {
    points.par_iter().map(|&p| code(p, bounds)).collect()
}

/// The code of every point on a lattice of 2¹⁶ cells a side between the 1st and 99th percentile of each axis, which
/// fits a flat scene closer than the cube of [`codes`]; points that are not finite set no bounds.
pub fn codes_in_box(points: &[[f32; 3]]) -> Vec<u64> {
    const LAST: f32 = 65_535.0;
    let ranges = [0, 1, 2].map(|axis| {
        let finite = points.iter().map(|p| p[axis]).filter(|v| v.is_finite());
        let mut values: Vec<f32> = finite.collect();
        if values.is_empty() {
            return (0.0, 1.0);
        }
        values.sort_unstable_by(f32::total_cmp);
        let low = values[values.len() / 100];
        let high = values[values.len() - 1 - values.len() / 100];
        (low, LAST / (high - low).max(f32::MIN_POSITIVE))
    });
    let cell = |p: &[f32; 3]| {
        [0, 1, 2].map(|axis| ((p[axis] - ranges[axis].0) * ranges[axis].1).clamp(0.0, LAST) as u64)
    };
    points.par_iter().map(|p| encode(cell(p))).collect()
}

/// The rows in the order of their codes, ties by row.
pub fn order(codes: &[u64]) -> Vec<u32> {
    let mut keyed: Vec<(u64, u32)> = codes
        .par_iter()
        .enumerate()
        .map(|(i, &c)| (c, i as u32))
        .collect();
    keyed.par_sort_unstable();
    keyed.into_par_iter().map(|(_, i)| i).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn encode_inverts_decode_and_interleaves() {
        for cell in [[0, 0, 0], [1, 2, 3], [0x1f_ffff, 0, 0x15_5555]] {
            assert_eq!(decode(encode(cell)), cell);
        }
        assert_eq!(encode([1, 0, 0]), 1);
        assert_eq!(encode([0, 1, 0]), 2);
        assert_eq!(encode([0, 0, 2]), 32);
    }

    #[test]
    fn order_is_stable_and_far_points_are_clamped() {
        let points = [[0.0; 3], [1e30; 3], [-1e30; 3], [0.0; 3]];
        let bounds = RobustBounds {
            origin: [0.0; 3],
            radius: 1.0,
        };
        assert_eq!(order(&codes(&points, &bounds)), [2, 0, 3, 1]);
        assert_eq!(code_inside(points[1], &bounds, 1e-6), None);
    }
}
