/// A number out of its bounds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name} = {value} is not in {low}..={high}")]
pub struct OutOfRange {
    /// Which.
    pub name: &'static str,
    /// Its value.
    pub value: u32,
    /// The least that it may be.
    pub low: u32,
    /// The most that it may be.
    pub high: u32,
}

/// Says which of some named numbers isn't between its bounds.
pub(crate) fn in_ranges(ranges: &[(&'static str, u32, u32, u32)]) -> Result<(), OutOfRange> {
    ranges.iter().try_for_each(|&(name, value, low, high)| {
        if (low..=high).contains(&value) {
            Ok(())
        } else {
            Err(OutOfRange { name, value, low, high })
        }
    })
}
