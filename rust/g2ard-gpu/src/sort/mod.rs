//! A stable radix sort on the device.

use crate::runtime::{Buffer, Gpu, Kernel, Result, Work};
use crate::scan;

const SOURCES: &[&str] = &[include_str!("sort.wgsl")];
const COUNT: Kernel = Kernel::new("sort.count", SOURCES, "count_digits");
const SCATTER: Kernel = Kernel::new("sort.scatter", SOURCES, "scatter");
const BLOCK: usize = 1024;
const DIGIT: usize = 4;

/// 64-bit keys of two words each, and one word of payload per key.
pub struct Keyed {
    pub keys: Buffer,
    pub words: Buffer,
}

impl Keyed {
    pub fn new(gpu: &Gpu, count: usize) -> Result<Self> {
        Ok(Self {
            keys: gpu.buffer("keys", 2 * count)?,
            words: gpu.buffer("rows", count)?,
        })
    }
}

/// Sort the first `count` of `keyed` by the bits in `bits`, ascending; equal keys keep their order.
pub fn sort(
    gpu: &Gpu,
    work: &mut Work,
    keyed: Keyed,
    count: usize,
    bits: std::ops::Range<usize>,
) -> Result<Keyed> {
    let blocks = count.div_ceil(BLOCK);
    let counts = gpu.buffer("digit counts", blocks << DIGIT)?;
    let (mut from, mut to) = (keyed, Keyed::new(gpu, count)?);
    for shift in bits.step_by(DIGIT) {
        let pass = [count as u32, shift as u32, blocks as u32, 0];
        work.run(&COUNT, blocks, &pass, &[&from.keys, &counts])?;
        scan::exclusive(gpu, work, &counts, blocks << DIGIT)?;
        let buffers = [&from.keys, &counts, &from.words, &to.keys, &to.words];
        work.run(&SCATTER, blocks, &pass, &buffers)?;
        std::mem::swap(&mut from, &mut to);
    }
    Ok(from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::gpu;
    use g2ard_core::random::Lcg;

    #[test]
    fn sorts_stably_by_the_bits_asked_for() {
        let Some(gpu) = gpu() else { return };
        let mut random = Lcg(2);
        for (count, kinds, bits) in [
            (1usize, 1u64, 0..64),
            (1000, 7, 0..64),
            (5000, 1 << 40, 0..64),
            (200_000, 1 << 20, 0..22),
            (70_000, 300, 32..44),
        ] {
            let keys: Vec<u64> = (0..count)
                .map(|_| random.below(kinds) << bits.start | u64::from(kinds > 1 << 30) << 63)
                .collect();
            let rows: Vec<u32> = (0..count as u32).collect();
            let keyed = Keyed {
                keys: gpu.upload("keys", &keys).unwrap(),
                words: gpu.upload("rows", &rows).unwrap(),
            };
            let mut work = Work::new(&gpu);
            let sorted = sort(&gpu, &mut work, keyed, count, bits).unwrap();
            let reads = [(&sorted.keys, 2 * count), (&sorted.words, count)];
            let found = work.submit(&reads).unwrap().take().unwrap();
            let mut want: Vec<(u64, u32)> = keys.into_iter().zip(rows).collect();
            want.sort_unstable();
            let keys: Vec<u64> = bytemuck::pod_collect_to_vec(&found[0]);
            assert!(keys.into_iter().zip(found[1].clone()).eq(want), "{count}");
        }
    }
}
