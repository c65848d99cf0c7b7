//! Comparisons of 8-bit colours, and medians by component.

/// Returns the median of each component; zeros for an empty list.
pub fn medians<T: Copy + Default + Ord, const N: usize>(items: &[[T; N]]) -> [T; N] {
    std::array::from_fn(|component| {
        let mut values: Vec<T> = items.iter().map(|item| item[component]).collect();
        values.sort_unstable();
        values.get(values.len() / 2).copied().unwrap_or_default()
    })
}

/// Returns the number of pixels that are similar to a colour.
pub fn count_similar(pixels: &[[u8; 3]], colour: [u8; 3], noise: u8) -> usize {
    pixels.iter().filter(|pixel| are_similar(**pixel, colour, noise)).count()
}

/// True if no channel differs by more than `noise` 8-bit levels.
pub fn are_similar(colour: [u8; 3], other: [u8; 3], noise: u8) -> bool {
    (0..3).all(|c| colour[c].abs_diff(other[c]) <= noise)
}
