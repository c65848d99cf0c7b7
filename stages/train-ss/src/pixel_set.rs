/// A set of pixels among many: a bit each, and how many there are before every block of them, so
/// that the n-th is found quickly.
#[derive(Clone, Debug, Default)]
pub(crate) struct PixelSet {
    words: Vec<u64>,
    /// Pixels that it says something of.
    length: u64,
    /// Pixels of the set before each block.
    before: Vec<u64>,
    count: u64,
}

/// Words of a block.
const WORDS_PER_BLOCK: usize = 8;

impl PixelSet {
    /// How many pixels are in it.
    pub(crate) fn len(&self) -> u64 {
        self.count
    }

    pub(crate) fn contains(&self, pixel: u64) -> bool {
        self.words.get((pixel / 64) as usize).is_some_and(|word| word >> (pixel % 64) & 1 == 1)
    }

    /// The n-th pixel of the set, of those that are in it counted from 0.
    pub(crate) fn nth(&self, n: u64) -> Option<u64> {
        if n >= self.count {
            return None;
        }
        let block = self.before.partition_point(|&before| before <= n) - 1;
        let mut left = n - self.before[block];
        for (at, word) in self.words.iter().enumerate().skip(block * WORDS_PER_BLOCK) {
            let here = u64::from(word.count_ones());
            if left < here {
                let rest = (0..left).fold(*word, |word, _| word & (word - 1));
                return Some(64 * at as u64 + u64::from(rest.trailing_zeros()));
            }
            left -= here;
        }
        None
    }
}

/// By whether each of the next pixels is in it.
impl Extend<bool> for PixelSet {
    fn extend<I: IntoIterator<Item = bool>>(&mut self, pixels: I) {
        for is_in in pixels {
            let bit = self.length % 64;
            if bit == 0 {
                if self.words.len().is_multiple_of(WORDS_PER_BLOCK) {
                    self.before.push(self.count);
                }
                self.words.push(0);
            }
            if let Some(word) = self.words.last_mut() {
                *word |= u64::from(is_in) << bit;
            }
            self.length += 1;
            self.count += u64::from(is_in);
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
        fn it_is_the_list_of_its_pixels(pixels in prop::collection::vec(prop::bool::weighted(0.2),
            0..2000)) {
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
