use std::fmt;
use std::ops::{Deref, DerefMut};

use crate::spec::{BRICK, FEATURES};

/// Bytes of a brick: two cache lines.
const ALIGNMENT: usize = BRICK * FEATURES * size_of::<f32>();
/// Numbers by which the first one is moved at most.
const MOST_MOVED: usize = ALIGNMENT / size_of::<f32>() - 1;

/// Numbers that begin at a whole brick, so that a vector lies in one cache line and a brick in two.
/// The allocator's own arrays begin 16 bytes later, where vectors lie in two and bricks in three.
///
/// The system is asked for large pages: samples read and write tables of many MiB at random, and
/// the processor remembers few addresses of pages.
#[derive(Default)]
pub(crate) struct Aligned {
    memory: Vec<f32>,
    start: usize,
    len: usize,
}

impl Aligned {
    pub(crate) fn zeros(len: usize) -> Self {
        let mut memory = vec![0.0; len + MOST_MOVED];
        ask_for_large_pages(&mut memory);
        // The offset is one that can't be only where addresses can't be looked at.
        let start = memory.as_ptr().align_offset(ALIGNMENT).min(MOST_MOVED);
        Self { memory, start, len }
    }

    /// The first `len` numbers, with what was in them before; grows where there are fewer.
    pub(crate) fn fit(&mut self, len: usize) -> &mut [f32] {
        if self.len < len {
            let mut grown = Self::zeros(len.max(2 * self.len));
            grown[..self.len].copy_from_slice(self);
            *self = grown;
        }
        &mut self[..len]
    }
}

impl Deref for Aligned {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.memory[self.start..][..self.len]
    }
}

impl DerefMut for Aligned {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.memory[self.start..][..self.len]
    }
}

impl Clone for Aligned {
    fn clone(&self) -> Self {
        let mut copy = Self::zeros(self.len);
        copy.copy_from_slice(self);
        copy
    }
}

impl fmt::Debug for Aligned {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.deref().fmt(f)
    }
}

/// Bytes of a large page.
#[cfg(target_os = "linux")]
const LARGE_PAGE: usize = 2 << 20;

#[cfg(target_os = "linux")]
fn ask_for_large_pages(numbers: &mut [f32]) {
    if size_of_val(numbers) < LARGE_PAGE {
        return;
    }
    let page = rustix::param::page_size();
    let skipped = numbers.as_ptr().align_offset(page);
    if let Some(start) = numbers.get_mut(skipped..) {
        let whole = size_of_val(start) / page * page;
        let advice = rustix::mm::Advice::LinuxHugepage;
        // SAFETY: the pages lie within `numbers`, and this advice leaves what they hold.
        unsafe { rustix::mm::madvise(start.as_mut_ptr().cast(), whole, advice) }.ok();
    }
}

#[cfg(not(target_os = "linux"))]
fn ask_for_large_pages(_: &mut [f32]) {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_begin_at_a_brick_and_stay_when_they_grow() {
        let mut numbers = Aligned::default();
        for len in [1, 31, 32, 33, 5000, 4, 1 << 20] {
            let last = numbers.last().copied();
            let was = numbers.len();
            assert_eq!(numbers.fit(len).len(), len);
            assert!(numbers.as_ptr().align_offset(ALIGNMENT) == 0 && numbers.len() >= was.max(len));
            assert_eq!(was.checked_sub(1).map(|i| numbers[i]), last);
            let end = numbers.len() - 1;
            numbers[end] = len as f32;
        }
        let copy = numbers.clone();
        assert!(*copy == *numbers && copy.as_ptr().align_offset(ALIGNMENT) == 0);
    }
}
