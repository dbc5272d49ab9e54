//! One stable sort of the visible splats by depth.

use rayon::prelude::*;

use super::disjoint::DisjointSlice;
use super::memory::first;

const BITS: u32 = 11;
const BINS: usize = 1 << BITS;
/// Entries per histogram: fixed, so that work is split equally for any number of threads. Fewer under Miri, which sorts
/// few.
const CHUNK: usize = if cfg!(miri) { 1 << 6 } else { 1 << 13 };

/// A splat's depth (positive floats order as their bits) and its index.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Key {
    pub depth: u32,
    pub splat: u32,
}

/// Least-significant-digit radix sort of the first `count` keys by depth; equal depths keep their order.
pub fn sort(keys: &mut Vec<Key>, spare: &mut Vec<Key>, count: usize) {
    for pass in 0..3 {
        scatter(&keys[..count], first(spare, count), pass * BITS);
        std::mem::swap(keys, spare);
    }
}

fn digit(key: &Key, shift: u32) -> usize {
    (key.depth >> shift) as usize & (BINS - 1)
}

fn scatter(from: &[Key], to: &mut [Key], shift: u32) {
    let mut starts: Vec<[u32; BINS]> = from
        .par_chunks(CHUNK)
        .with_max_len(1)
        .map(|chunk| {
            let mut bins = [0; BINS];
            for key in chunk {
                bins[digit(key, shift)] += 1;
            }
            bins
        })
        .collect();
    prefix_sums(starts.as_flattened_mut(), &mut [0; BINS]);
    let to = DisjointSlice::new(to);
    from.par_chunks(CHUNK)
        .zip(&mut starts)
        .with_max_len(1)
        .for_each(|(chunk, next)| {
            for key in chunk {
                let place = &mut next[digit(key, shift)];
                // SAFETY: the prefix sums give every key of every chunk its own place in `to`.
                unsafe { to.write(*place as usize, *key) };
                *place += 1;
            }
        });
}

/// Replaces rows of counts, one count for each of `ends`, by where each row's share of each bin begins: bins follow each
/// other, and within a bin the rows. `ends` receives the end of each bin.
pub fn prefix_sums(rows: &mut [u32], ends: &mut [u32]) {
    ends.fill(0);
    for row in rows.chunks_exact(ends.len()) {
        for (end, count) in ends.iter_mut().zip(row) {
            *end += count;
        }
    }
    let mut at = 0;
    for end in ends.iter_mut() {
        (*end, at) = (at, at + *end);
    }
    for row in rows.chunks_exact_mut(ends.len()) {
        for (end, count) in ends.iter_mut().zip(row) {
            (*count, *end) = (*end, *end + *count);
        }
    }
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
        let count = keys.len();
        sort(&mut keys, &mut Vec::new(), count);
        assert_eq!(keys[..count], expected);
    }
}
