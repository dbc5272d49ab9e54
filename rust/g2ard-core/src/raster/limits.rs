//! Measured limits of this machine, to compare the raster step with (`python -m benchmarks run raster`).

use std::time::Instant;

use rayon::prelude::*;

use super::simd::{Isa, Kernel, LANES, Lanes, Lanes16, dispatch};

/// Fused multiply-adds of all threads together, in 10⁹ flops a second (an FMA is two), and bytes read from memory, in
/// 10⁹ a second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    pub fma_gflops: f64,
    pub read_gb_s: f64,
}

/// Independent chains: enough to hide an FMA's latency, few enough for the registers.
const CHAINS: usize = 12;
const TURNS: usize = 40_000;
const REPEATS: usize = 12;
/// Bytes read by each thread: well past any cache.
const BYTES: usize = 96 << 20;

struct Multiply;

impl Kernel for Multiply {
    type Output = f32;

    #[inline(always)]
    fn run<F: Lanes>(self) -> f32 {
        let (a, b) = (F::splat(0.999_9), F::splat(1e-4));
        let mut chains = [F::splat(0.5); CHAINS];
        for _ in 0..TURNS {
            for chain in &mut chains {
                *chain = chain.fma(a, b);
            }
        }
        total(&chains)
    }
}

struct Read<'a>(&'a [Lanes16]);

impl Kernel for Read<'_> {
    type Output = f32;

    #[inline(always)]
    fn run<F: Lanes>(self) -> f32 {
        let mut sums = [F::zero(); 8];
        for rows in self.0.chunks_exact(8) {
            for k in 0..8 {
                sums[k] = sums[k] + F::load(&rows[k]);
            }
        }
        total(&sums)
    }
}

#[inline(always)]
fn total<F: Lanes>(lanes: &[F]) -> f32 {
    let mut sum = F::zero();
    for l in lanes {
        sum = sum + *l;
    }
    let mut row = Lanes16::default();
    sum.store(&mut row);
    row.0.iter().sum()
}

/// The best of a dozen runs of a few milliseconds on every thread of the current pool.
pub fn measure(isa: Isa) -> Limits {
    let threads = rayon::current_num_threads();
    let flops = (2 * LANES * CHAINS * TURNS * threads) as f64;
    let rows = vec![Lanes16([1.0; LANES]); BYTES / size_of::<Lanes16>() * threads];
    let parts: Vec<&[Lanes16]> = rows.chunks(BYTES / size_of::<Lanes16>()).collect();
    let (mut compute, mut memory) = (f64::INFINITY, f64::INFINITY);
    for _ in 0..REPEATS {
        let clock = Instant::now();
        std::hint::black_box(rayon::broadcast(|_| dispatch(isa, Multiply)));
        compute = compute.min(clock.elapsed().as_secs_f64());
        let clock = Instant::now();
        let sums: Vec<f32> = parts
            .par_iter()
            .map(|part| dispatch(isa, Read(part)))
            .collect();
        std::hint::black_box(sums);
        memory = memory.min(clock.elapsed().as_secs_f64());
    }
    Limits {
        fma_gflops: flops / compute / 1e9,
        read_gb_s: (BYTES * threads) as f64 / memory / 1e9,
    }
}
