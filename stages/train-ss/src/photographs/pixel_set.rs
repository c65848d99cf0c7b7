/// Number of 64-bit words of a block.
const WORDS_PER_BLOCK: usize = 8;

/// Subset of numbered pixels: one bit per pixel, and the rank of every block of words, so that the
/// n-th element is found quickly.
#[derive(Clone, Debug, Default)]
pub(crate) struct PixelSet {
    words: Vec<u64>,
    /// Number of pixels appended, in the set or not.
    length: u64,
    /// Number of elements before each block.
    before: Vec<u64>,
    /// Number of elements.
    count: u64,
}

impl PixelSet {
    /// Returns the number of elements.
    pub(crate) fn len(&self) -> u64 {
        self.count
    }

    pub(crate) fn contains(&self, pixel: u64) -> bool {
        self.words.get((pixel / 64) as usize).is_some_and(|word| word >> (pixel % 64) & 1 == 1)
    }

    /// Returns the n-th element in ascending order, counted from 0.
    pub(crate) fn nth(&self, n: u64) -> Option<u64> {
        let block = self.before.partition_point(|&before| before <= n).checked_sub(1)?;
        let mut left = n - self.before[block];
        for (i, word) in self.words.iter().enumerate().skip(block * WORDS_PER_BLOCK) {
            let ones = u64::from(word.count_ones());
            if left < ones {
                let rest = (0..left).fold(*word, |word, _| word & (word - 1));
                return Some(64 * i as u64 + u64::from(rest.trailing_zeros()));
            }
            left -= ones;
        }
        None
    }
}

/// Appends pixels; `true` puts the pixel into the set.
impl Extend<bool> for PixelSet {
    fn extend<I: IntoIterator<Item = bool>>(&mut self, pixels: I) {
        for is_element in pixels {
            let bit = self.length % 64;
            if bit == 0 {
                if self.words.len().is_multiple_of(WORDS_PER_BLOCK) {
                    self.before.push(self.count);
                }
                self.words.push(0);
            }
            self.words[(self.length / 64) as usize] |= u64::from(is_element) << bit;
            self.length += 1;
            self.count += u64::from(is_element);
        }
    }
}

impl FromIterator<bool> for PixelSet {
    fn from_iter<I: IntoIterator<Item = bool>>(pixels: I) -> Self {
        let mut set = Self::default();
        set.extend(pixels);
        set
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_set_equals_the_list_of_its_pixels(
            pixels in prop::collection::vec(prop::bool::weighted(0.2), 0..2000),
        ) {
            let mut set: PixelSet = pixels.iter().copied().take(700).collect();
            set.extend(pixels.iter().copied().skip(700));
            let list: Vec<u64> = (0..).zip(&pixels).filter(|(_, is_in)| **is_in).map(|(pixel,
                _)| pixel).collect();
            prop_assert_eq!(set.len(), list.len() as u64);
            prop_assert!((0..).zip(&list).all(|(n, pixel)| set.nth(n) == Some(*pixel)));
            prop_assert!(set.nth(set.len()).is_none());
            let is_listed = |pixel: u64| list.binary_search(&pixel).is_ok();
            prop_assert!((0..2100u64).all(|pixel| set.contains(pixel) == is_listed(pixel)));
        }
    }
}
