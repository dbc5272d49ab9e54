//! Prefix sums on the device.

use crate::runtime::{Buffer, Gpu, Kernel, Result, Work};

const SOURCES: &[&str] = &[include_str!("scan.wgsl")];
const SCAN: Kernel = Kernel::new("scan", SOURCES, "scan");
const ADD: Kernel = Kernel::new("scan.add", SOURCES, "add_totals");
const BLOCK: usize = 1024;

/// Replace the first `count` words by the sums of the words before them; the returned word is the total.
pub fn exclusive(gpu: &Gpu, work: &mut Work, values: &Buffer, count: usize) -> Result<Buffer> {
    let blocks = count.div_ceil(BLOCK).max(1);
    let totals = gpu.buffer("scan", blocks)?;
    let buffers = [values, &totals];
    work.run(&SCAN, blocks, &[count as u32], &buffers)?;
    if blocks == 1 {
        return Ok(totals);
    }
    let all = exclusive(gpu, work, &totals, blocks)?;
    work.run(&ADD, blocks, &[count as u32], &buffers)?;
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::gpu;
    use g2ard_core::random::Lcg;

    #[test]
    fn sums_what_came_before() {
        let Some(gpu) = gpu() else { return };
        let mut random = Lcg(1);
        for count in [0usize, 1, 1023, 1024, 1025, 300_000, 1_100_000] {
            let values: Vec<u32> = (0..count).map(|_| random.below(1000) as u32).collect();
            let buffer = gpu.upload("values", &values).unwrap();
            let mut work = Work::new(&gpu);
            let total = exclusive(&gpu, &mut work, &buffer, count).unwrap();
            let found = work.submit(&[(&buffer, count), (&total, 1)]).unwrap();
            let found = found.take().unwrap();
            let mut sum = 0;
            for (value, got) in values.iter().zip(&found[0]) {
                assert_eq!(*got, sum);
                sum += value;
            }
            assert_eq!(found[1], [sum], "{count}");
        }
    }
}
