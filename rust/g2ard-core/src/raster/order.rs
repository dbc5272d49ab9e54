//! One stable sort of the visible splats by depth.

use rayon::prelude::*;

const BITS: u32 = 11;
const BINS: usize = 1 << BITS;
/// Entries per histogram: fixed, so that the passes split alike for any number of threads.
const CHUNK: usize = 1 << 14;

/// A splat's depth (positive floats order as their bits) and its index.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Key {
    pub depth: u32,
    pub splat: u32,
}

/// Asks for what is read soon.
#[inline(always)]
pub fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a prefetch of a valid address has no effect but on the cache.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

/// A write target shared by threads that write disjoint elements.
#[derive(Clone, Copy)]
pub(crate) struct Shared<T>(*mut T);

// SAFETY: every user writes elements that no other thread touches; see each call.
unsafe impl<T: Send> Sync for Shared<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Send for Shared<T> {}

impl<T> Shared<T> {
    pub fn new(slice: &mut [T]) -> Self {
        Self(slice.as_mut_ptr())
    }
    /// # Safety
    /// `i` is inside the slice, which is still borrowed, and no other thread touches element `i` meanwhile.
    #[inline(always)]
    pub unsafe fn write(self, i: usize, value: T) {
        // SAFETY: the caller's promise.
        unsafe { self.0.add(i).write(value) }
    }
    /// # Safety
    /// As for [`Self::write`].
    #[inline(always)]
    pub unsafe fn at(self, i: usize) -> *mut T {
        // SAFETY: the caller's promise.
        unsafe { self.0.add(i) }
    }
    /// # Safety
    /// As for [`Self::write`], for the `len` elements from `i`.
    #[inline(always)]
    #[allow(clippy::mut_from_ref)]
    pub unsafe fn slice<'a>(self, i: usize, len: usize) -> &'a mut [T] {
        // SAFETY: the caller's promise.
        unsafe { std::slice::from_raw_parts_mut(self.0.add(i), len) }
    }
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
    let to = Shared::new(to);
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

    #[test]
    fn sorts_stably() {
        let mut state = 1u32;
        let mut keys: Vec<Key> = (0..100_000)
            .map(|splat| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let depth = (f32::from_bits(0x3f80_0000 | (state >> 9)) * 3.0).floor()
                    + (state >> 22) as f32;
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
