//! A slice that several threads write to at the same time, each to its own elements.

use std::marker::PhantomData;

/// A write target shared by threads that write disjoint elements; bounds are checked in builds with debug assertions.
#[derive(Clone, Copy)]
pub(crate) struct DisjointSlice<'a, T> {
    start: *mut T,
    len: usize,
    borrowed: PhantomData<&'a mut [T]>,
}

// SAFETY: every user writes elements that no other thread touches; see each call.
unsafe impl<T: Send> Sync for DisjointSlice<'_, T> {}
// SAFETY: as above.
unsafe impl<T: Send> Send for DisjointSlice<'_, T> {}

impl<'a, T> DisjointSlice<'a, T> {
    pub fn new(slice: &'a mut [T]) -> Self {
        Self {
            start: slice.as_mut_ptr(),
            len: slice.len(),
            borrowed: PhantomData,
        }
    }
    /// # Safety
    /// `i` is inside the slice, and no other thread touches element `i` meanwhile.
    #[inline(always)]
    pub unsafe fn write(self, i: usize, value: T) {
        // SAFETY: the caller's promise.
        unsafe { self.at(i).write(value) }
    }
    /// # Safety
    /// As for [`Self::write`].
    #[inline(always)]
    pub unsafe fn at(self, i: usize) -> *mut T {
        debug_assert!(i < self.len, "element {i} of {}", self.len);
        // SAFETY: the caller's promise.
        unsafe { self.start.add(i) }
    }
    /// # Safety
    /// As for [`Self::write`], for the `len` elements from `i`.
    #[inline(always)]
    pub unsafe fn slice(self, i: usize, len: usize) -> &'a mut [T] {
        debug_assert!(
            i <= self.len && len <= self.len - i,
            "{len} elements from {i} of {}",
            self.len
        );
        // SAFETY: the caller's promise.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(i), len) }
    }
}
