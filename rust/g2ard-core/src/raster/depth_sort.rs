//! One stable sort of the visible splats by depth.

use rayon::prelude::*;

use super::disjoint::DisjointSlice;

const BITS: u32 = 11;
const BINS: usize = 1 << BITS;
/// Entries per histogram: fixed, so that work is split equally for any number of threads. Fewer under Miri, which sorts
/// few.
const CHUNK: usize = if cfg!(miri) { 1 << 6 } else { 1 << 14 };

/// A splat's depth (positive floats order as their bits) and its index.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Key {
    pub depth: u32,
    pub splat: u32,
}

/// Least-significant-digit radix sort by depth; equal depths keep their order.
pub fn sort(keys: &mut Vec<Key>, spare: &mut Vec<Key>) {
    spare.clear();
    spare.resize(keys.len(), Key::default());
    for pass in 0..3 {
        scatter(keys, spare, pass * BITS);
        std::mem::swap(keys, spare);
    }
}

fn digit(key: &Key, shift: u32) -> usize {
    (key.depth >> shift) as usize & (BINS - 1)
}

fn scatter(from: &[Key], to: &mut [Key], shift: u32) {
    let mut starts: Vec<[u32; BINS]> = from
        .par_chunks(CHUNK)
        .map(|chunk| {
            let mut bins = [0; BINS];
            for key in chunk {
                bins[digit(key, shift)] += 1;
            }
            bins
        })
        .collect();
    let mut at = 0;
    for bin in 0..BINS {
        for chunk in &mut starts {
            let count = chunk[bin];
            chunk[bin] = at;
            at += count;
        }
    }
    let to = DisjointSlice::new(to);
    from.par_chunks(CHUNK)
        .zip(&mut starts)
        .for_each(|(chunk, next)| {
            for key in chunk {
                let place = &mut next[digit(key, shift)];
                // SAFETY: the prefix sums give every key of every chunk its own place in `to`.
                unsafe { to.write(*place as usize, *key) };
                *place += 1;
            }
        });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Lcg;

    #[test]
    fn sorts_stably() {
        let mut random = Lcg(1);
        let mut keys: Vec<Key> = (0..if cfg!(miri) { 200 } else { 100_000 })
            .map(|splat| {
                let depth = (random.uniform_f32() * 3.0).floor() + (random.integer() >> 14) as f32;
                Key {
                    depth: depth.to_bits(),
                    splat,
                }
            })
            .collect();
        let mut expected = keys.clone();
        expected.sort_by_key(|k| k.depth);
        sort(&mut keys, &mut Vec::new());
        assert_eq!(keys, expected);
    }
}
