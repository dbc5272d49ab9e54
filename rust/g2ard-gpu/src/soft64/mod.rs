//! Double precision for devices that have none: `soft64.wgsl`, and linear algebra on it.

pub const SOFT64: &str = include_str!("soft64.wgsl");
pub const LINEAR: &str = include_str!("linear.wgsl");

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::{Gpu, Kernel, Work};
    use crate::testing::gpu;
    use g2ard_core::linalg::symmetric_eigen;
    use g2ard_core::random::Lcg;

    const OPERATIONS: &str = r"
        @group(0) @binding(1) var<storage, read> pairs: array<vec4<u32>>;
        @group(0) @binding(2) var<storage, read_write> found: array<F64>;

        @compute @workgroup_size(64)
        fn each(@builtin(global_invocation_id) id: vec3<u32>) {
            let i = id.x;
            if i >= arrayLength(&pairs) { return; }
            let a = pairs[i].xy;
            let b = pairs[i].zw;
            found[8u * i] = add(a, b);
            found[8u * i + 1u] = sub(a, b);
            found[8u * i + 2u] = mul(a, b);
            found[8u * i + 3u] = div(a, b);
            found[8u * i + 4u] = root(mag(a));
            found[8u * i + 5u] = F64(u32(lt(a, b)), u32(total_lt(a, b)));
            found[8u * i + 6u] = F64(narrow(a), 0u);
            found[8u * i + 7u] = widen(narrow(a));
        }
    ";

    const EIGENS: &str = r"
        @group(0) @binding(1) var<storage, read> matrices: array<array<F64, 6>>;
        @group(0) @binding(2) var<storage, read_write> found: array<Eigen>;

        @compute @workgroup_size(64)
        fn each(@builtin(global_invocation_id) id: vec3<u32>) {
            if id.x < arrayLength(&matrices) {
                found[id.x] = symmetric_eigen(matrices[id.x]);
            }
        }
    ";

    fn answers(gpu: &Gpu, kernel: &Kernel, input: &[f64], each: usize, out: usize) -> Vec<u64> {
        let rows = input.len() / each;
        let input = gpu.upload("input", input).unwrap();
        let found = gpu.buffer("found", 2 * out * rows).unwrap();
        let mut work = Work::new(gpu);
        work.run(kernel, rows.div_ceil(64), &[], &[&input, &found])
            .unwrap();
        let words = work.submit(&[(&found, 2 * out * rows)]).unwrap().take();
        bytemuck::pod_collect_to_vec(&words.unwrap()[0])
    }

    /// Numbers whose sums cancel, whose products round both ways, and zeros of both signs.
    fn odd_numbers(count: usize) -> Vec<f64> {
        let mut random = Lcg(3);
        let mut numbers: Vec<f64> = (0..count)
            .map(|i| {
                let wide = [0, 0, 3, 60, 400][i % 5];
                let x = (random.uniform() - 0.5)
                    * 2f64.powi(random.below(2 * wide + 1) as i32 - wide as i32);
                match i % 7 {
                    0 => f64::from_bits(x.to_bits() & !0x3fff_ffff),
                    1 => (x * 64.0).round(),
                    2 => x + 1.0,
                    _ => x,
                }
            })
            .collect();
        for i in (0..count - 3).step_by(6) {
            numbers[i + 1] = match i % 4 {
                0 if numbers[i] != 0.0 => -f64::from_bits(numbers[i].to_bits() ^ 1),
                1 => numbers[i],
                2 => -0.0,
                _ => -numbers[i],
            };
        }
        numbers
    }

    #[test]
    fn operations_are_the_cpus_bit_for_bit() {
        let Some(gpu) = gpu("soft64 operations") else {
            return;
        };
        let kernel = Kernel {
            name: "test.operations",
            sources: &[SOFT64, OPERATIONS],
            entry: "each",
        };
        let numbers = odd_numbers(200_000);
        let found = answers(&gpu, &kernel, &numbers, 2, 8);
        for (pair, got) in numbers.chunks(2).zip(found.chunks(8)) {
            let (a, b) = (pair[0], pair[1]);
            let single = a as f32;
            let mut want = [a + b, a - b, a * b, a / b, a.abs().sqrt()];
            if b == 0.0 {
                want[3] = f64::INFINITY.copysign(a * b.signum()); // no kernel divides by zero
                if a == 0.0 {
                    want[3] = (0.0f64).copysign(a * b.signum());
                }
            }
            want.iter_mut().for_each(|w| {
                if w.is_subnormal() {
                    *w = 0f64.copysign(*w);
                }
            });
            for (k, w) in want.iter().enumerate() {
                assert_eq!(
                    f64::from_bits(got[k]).to_bits(),
                    w.to_bits(),
                    "{k}: {a:e} {b:e}"
                );
            }
            let order = u64::from(a < b) | u64::from(a.total_cmp(&b).is_lt()) << 32;
            assert_eq!(got[5], order, "{a:e} {b:e}");
            if !single.is_subnormal() && single.is_finite() {
                assert_eq!(got[6], u64::from(single.to_bits()), "{a:e}");
                assert_eq!(got[7], f64::from(single).to_bits(), "{a:e}");
            }
        }
    }

    #[test]
    fn eigenvectors_are_the_cpus_bit_for_bit() {
        let Some(gpu) = gpu("soft64 eigenvectors") else {
            return;
        };
        let kernel = Kernel {
            name: "test.eigens",
            sources: &[SOFT64, LINEAR, EIGENS],
            entry: "each",
        };
        let mut random = Lcg(5);
        let mut matrices = vec![[0.0; 6], [1.0, 0.0, 0.0, 3.0, 0.0, 2.0], [1.0; 6]];
        for i in 0..3000 {
            let size = 2f64.powi(random.below(200) as i32 - 100);
            let flat = [1.0, 1e-4, 1e-9, 0.0][i % 4];
            let d = [
                random.uniform() - 0.5,
                (random.uniform() - 0.5) * flat,
                (random.uniform() - 0.5) * flat,
            ];
            let e = [
                random.uniform() - 0.5,
                random.uniform() - 0.5,
                (random.uniform() - 0.5) * flat,
            ];
            let m = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];
            matrices.push(m.map(|(i, j)| size * (d[i] * d[j] + e[i] * e[j])));
        }
        let found = answers(&gpu, &kernel, matrices.as_flattened(), 6, 12);
        for (m, got) in matrices.iter().zip(found.chunks(12)) {
            let e = symmetric_eigen(m);
            let want: Vec<u64> = e
                .values
                .iter()
                .chain(e.vectors.as_flattened())
                .map(|v| v.to_bits())
                .collect();
            assert_eq!(got, want, "{m:?}");
        }
    }
}
