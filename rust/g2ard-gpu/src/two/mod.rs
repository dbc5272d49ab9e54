//! Arithmetic on pairs of f32 where f32 is too coarse, and coordinates as integers.

use g2ard_core::spatial::RobustBounds;
use rayon::prelude::*;

/// WGSL source that precedes kernels.
pub const TWO: &str = include_str!("two.wgsl");

/// The number that two words from the device represent.
pub fn number(words: &[u32]) -> f64 {
    f64::from(f32::from_bits(words[0])) + f64::from(f32::from_bits(words[1]))
}

/// Coordinates as 64-bit multiples of a power of two. Their differences are exact on every device, however far the
/// scene lies from its origin.
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    origin: [f64; 3],
    /// The unit is two to this power.
    pub exponent: i32,
}

/// Bits of the farthest coordinate.
const BITS: i32 = 60;

/// Points farther out than this many radii of the scene are clamped; no cell of the lattice reaches as far.
const FARTHEST: f64 = (1 << 24) as f64;

impl Frame {
    pub fn around(points: &[[f64; 3]]) -> Self {
        let bounds = RobustBounds::of(points);
        let far =
            |p: &[f64; 3]| (0..3).fold(0f64, |far, k| far.max((p[k] - bounds.origin[k]).abs()));
        let farthest = points.par_iter().map(far).reduce(|| 0.0, f64::max);
        let reach = farthest.clamp(bounds.radius, FARTHEST * bounds.radius);
        Self {
            origin: bounds.origin,
            exponent: reach.log2().ceil() as i32 - BITS,
        }
    }

    pub fn unit(&self) -> f64 {
        2f64.powi(self.exponent)
    }

    pub fn fixed(&self, point: [f64; 3]) -> [i64; 3] {
        let most = (1i64 << (BITS + 1)) as f64;
        let unit = self.unit();
        let along = |k: usize| ((point[k] - self.origin[k]) / unit).clamp(-most, most);
        [0, 1, 2].map(|k| along(k).round() as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::{Gpu, Kernel, Work};
    use crate::testing::gpu;
    use g2ard_core::linalg::{outer, symmetric_eigen};
    use g2ard_core::random::Lcg;

    /// Largest relative error of an operation, in terms of the larger operand: slightly over 2⁻⁴⁵.
    const DIGITS: f64 = 3e-14;

    /// A number in the layout that kernels read.
    fn two(x: f64) -> [f32; 2] {
        let high = x as f32;
        [high, (x - f64::from(high)) as f32]
    }

    /// Run `body`, which writes `out` numbers from `found[to]` on, for each of some rows of type `row`: its number is i.
    fn answers<T: bytemuck::NoUninit>(
        gpu: &Gpu,
        [name, row, body]: [&'static str; 3],
        input: &[T],
        [rows, out]: [usize; 2],
    ) -> Vec<f64> {
        let source = format!(
            "@group(0) @binding(0) var<uniform> zero: vec4<u32>;
            @group(0) @binding(1) var<storage, read> rows: array<{row}>;
            @group(0) @binding(2) var<storage, read_write> found: array<Two>;

            @compute @workgroup_size(64)
            fn each(@builtin(global_invocation_id) id: vec3<u32>) {{
                hidden = zero.x;
                if id.x >= arrayLength(&rows) {{ return; }}
                let to = {out}u * id.x;
                let row = rows[id.x];
                {body}
            }}"
        );
        let sources = Vec::leak(vec![TWO, String::leak(source)]);
        let kernel = Kernel::new(name, sources, "each");
        let input = gpu.upload("input", input).unwrap();
        let found = gpu.buffer("found", 2 * out * rows).unwrap();
        let mut work = Work::new(gpu);
        let buffers = [&input, &found];
        work.run(&kernel, rows.div_ceil(64), &[0], &buffers)
            .unwrap();
        let words = work.submit(&[(&found, 2 * out * rows)]).unwrap().take();
        words.unwrap()[0].chunks(2).map(number).collect()
    }

    const OPERATIONS: [&str; 3] = [
        "test.operations",
        "vec4<f32>",
        "let a = row.xy;
        let b = row.zw;
        found[to] = add(a, b);
        found[to + 1u] = sub(a, b);
        found[to + 2u] = mul(a, b);
        found[to + 3u] = div(a, b);
        found[to + 4u] = root(mag(a));",
    ];

    const DIFFERENCES: [&str; 3] = [
        "test.differences",
        "vec4<u32>",
        "found[to] = scaled(difference(row.xy, row.zw), -50);",
    ];

    const EIGENS: [&str; 3] = [
        "test.eigens",
        "array<Two, 6>",
        "let e = symmetric_eigen(row);
        for (var k = 0u; k < 3u; k++) {
            found[to + k] = e.values[k];
            for (var j = 0u; j < 3u; j++) { found[to + 3u + 3u * k + j] = e.vectors[k][j]; }
        }",
    ];

    #[test]
    fn operations_keep_their_digits() {
        let Some(gpu) = gpu() else { return };
        let mut random = Lcg(3);
        let mut numbers: Vec<f64> = (0..200_000)
            .map(|i| {
                let wide = [0, 0, 3, 12][i % 4];
                let power = random.below(2 * wide + 1) as i32 - wide as i32;
                let x = random.centred() * 2f64.powi(power);
                if i % 7 == 0 { x + 1.0 } else { x }
            })
            .collect();
        for i in (0..numbers.len()).step_by(6) {
            numbers[i + 1] = -numbers[i] * (1.0 + 1e-9); // what cancels
        }
        let pairs: Vec<_> = numbers.iter().map(|&x| two(x)).collect();
        let rows = numbers.len() / 2;
        let found = answers(&gpu, OPERATIONS, &pairs, [rows, 5]);
        for (pair, got) in pairs.chunks(2).zip(found.chunks(5)) {
            let [a, b] = [0, 1].map(|k: usize| f64::from(pair[k][0]) + f64::from(pair[k][1]));
            let want = [a + b, a - b, a * b, a / b, a.abs().sqrt()];
            let larger = a.abs().max(b.abs());
            for (k, (got, want)) in got.iter().zip(want).enumerate() {
                let beside = if k < 2 { larger } else { want.abs() };
                let apart = (got - want).abs();
                assert!(apart <= DIGITS * beside, "{k}: {a:e} {b:e}: {apart:e}");
            }
        }
    }

    #[test]
    fn differences_are_exact() {
        let Some(gpu) = gpu() else { return };
        let mut random = Lcg(4);
        let numbers: Vec<i64> = (0..20_000)
            .map(|i| {
                let x = (random.centred() * 2f64.powi(62)) as i64;
                x >> (i / 2 % 60)
            })
            .collect();
        let rows = numbers.len() / 2;
        let found = answers(&gpu, DIFFERENCES, &numbers, [rows, 1]);
        for (pair, got) in numbers.chunks(2).zip(found) {
            let want = (pair[0] - pair[1]) as f64 * 2f64.powi(-50);
            assert!((got - want).abs() <= DIGITS * want.abs(), "{pair:?}");
        }
    }

    #[test]
    fn eigenvectors_belong_to_their_values() {
        let Some(gpu) = gpu() else { return };
        let mut random = Lcg(5);
        let mut matrices = vec![[0.0; 6], [1.0, 0.0, 0.0, 3.0, 0.0, 2.0], [1.0; 6]];
        for i in 0..3000 {
            let flat = [1.0, 1e-4, 1e-9, 0.0][i % 4];
            let mut next = |scale: f64| random.centred() * scale;
            let (d, e) = (
                outer([next(1.0), next(flat), next(flat)]),
                outer([next(1.0), next(1.0), next(flat)]),
            );
            matrices.push([0, 1, 2, 3, 4, 5].map(|k| d[k] + e[k]));
        }
        let input: Vec<_> = matrices.as_flattened().iter().map(|&x| two(x)).collect();
        let rows = matrices.len();
        let found = answers(&gpu, EIGENS, &input, [rows, 12]);
        for (m, got) in matrices.iter().zip(found.chunks(12)) {
            let want = symmetric_eigen(m);
            let size = want.values[0].abs();
            let mut back = [0.0; 6];
            for k in 0..3 {
                let apart = (got[k] - want.values[k]).abs();
                assert!(apart <= 10.0 * DIGITS * size, "{m:?}: {apart:e}");
                let axis = outer([0, 1, 2].map(|j| got[3 + 3 * k + j]));
                (0..6).for_each(|i| back[i] += got[k] * axis[i]);
            }
            for i in 0..6 {
                let apart = (back[i] - m[i]).abs();
                assert!(apart <= 10.0 * DIGITS * size, "{m:?}: {apart:e}");
            }
        }
    }
}
