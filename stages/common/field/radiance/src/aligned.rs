use std::fmt;
use std::ops::{Deref, DerefMut};

use crate::spec::{BRICK, FEATURES};

/// Alignment in bytes: the size of a brick, two cache lines.
const ALIGNMENT: usize = BRICK * FEATURES * size_of::<f32>();
/// Maximum number of elements before the first aligned one.
const MAX_PADDING: usize = ALIGNMENT / size_of::<f32>() - 1;

/// Growable array of floats, or of other elements of 32 bits, that is aligned to bricks, so that a
/// SIMD vector of 16 elements is in one cache line and a brick in two. A large `Vec` usually begins
/// 16 bytes after a page boundary: SIMD vectors would be in two cache lines and bricks in three.
///
/// Large pages are requested from the system: samples access tables of many MiB at random, and the
/// processor's TLB has few entries.
#[derive(Default)]
pub(crate) struct Aligned<T = f32> {
    memory: Vec<T>,
    start: usize,
    len: usize,
}

impl<T: Copy + Default> Aligned<T> {
    /// Creates an array of `len` zeros.
    pub(crate) fn zeros(len: usize) -> Self {
        const { assert!(size_of::<T>() == size_of::<f32>()) };
        // For numbers, `vec!` touches no memory before large pages are requested.
        let mut memory = vec![T::default(); len + MAX_PADDING];
        request_large_pages(&mut memory);
        // `align_offset` may return usize::MAX, as in const evaluation.
        let start = memory.as_ptr().align_offset(ALIGNMENT).min(MAX_PADDING);
        Self { memory, start, len }
    }

    /// Returns the first `len` elements with their old content; grows the array if it is shorter.
    pub(crate) fn grow(&mut self, len: usize) -> &mut [T] {
        if self.len < len {
            let mut grown = Self::zeros(len.max(2 * self.len));
            grown[..self.len].copy_from_slice(self);
            *self = grown;
        }
        &mut self[..len]
    }
}

impl<T> Deref for Aligned<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.memory[self.start..][..self.len]
    }
}

impl<T> DerefMut for Aligned<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.memory[self.start..][..self.len]
    }
}

impl<T: Copy + Default> Clone for Aligned<T> {
    fn clone(&self) -> Self {
        let mut copy = Self::zeros(self.len);
        copy.copy_from_slice(self);
        copy
    }
}

impl<T: fmt::Debug> fmt::Debug for Aligned<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.deref().fmt(f)
    }
}

/// Requests large pages for an array; does nothing for an array smaller than one such page.
#[cfg(target_os = "linux")]
fn request_large_pages<T>(numbers: &mut [T]) {
    const LARGE_PAGE_BYTES: usize = 2 << 20;
    if size_of_val(numbers) < LARGE_PAGE_BYTES {
        return;
    }
    let page = rustix::param::page_size();
    let skipped = numbers.as_ptr().align_offset(page);
    if let Some(start) = numbers.get_mut(skipped..) {
        let len = size_of_val(start) / page * page;
        let advice = rustix::mm::Advice::LinuxHugepage;
        // SAFETY: the pages are within `numbers`, and this advice doesn't change their content.
        unsafe { rustix::mm::madvise(start.as_mut_ptr().cast(), len, advice) }.ok();
    }
}

#[cfg(not(target_os = "linux"))]
fn request_large_pages<T>(_: &mut [T]) {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_aligned_and_survive_growth() {
        let mut numbers = Aligned::<f32>::default();
        for len in [1, 31, 32, 33, 5000, 4, 1 << 20] {
            let last = numbers.last().copied();
            let before = numbers.len();
            assert_eq!(numbers.grow(len).len(), len);
            assert!(
                numbers.as_ptr().align_offset(ALIGNMENT) == 0 && numbers.len() >= before.max(len)
            );
            assert_eq!(before.checked_sub(1).map(|i| numbers[i]), last);
            let end = numbers.len() - 1;
            numbers[end] = len as f32;
        }
        let copy = numbers.clone();
        assert!(*copy == *numbers && copy.as_ptr().align_offset(ALIGNMENT) == 0);
    }
}
