//! A slice that several threads write to at the same time, each to its own elements.

/// A write target shared by threads that write disjoint elements.
#[derive(Clone, Copy)]
pub(crate) struct DisjointSlice<T>(*mut T);

// SAFETY: every user writes elements that no other thread touches; see each call.
unsafe impl<T: Send> Sync for DisjointSlice<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Send for DisjointSlice<T> {}

impl<T> DisjointSlice<T> {
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
