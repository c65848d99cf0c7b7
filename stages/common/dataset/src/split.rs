/// Which frames are for training and which for testing, by their numbers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Split {
    /// For training.
    pub train: Vec<usize>,
    /// For testing.
    pub test: Vec<usize>,
}

impl Split {
    /// Every frame for both: the paper's way with photographs.
    pub fn all(count: usize) -> Self {
        Self { train: (0..count).collect(), test: (0..count).collect() }
    }

    /// Every `every`-th frame, the first among them, is for testing and for nothing else: LLFF's
    /// way. One frame alone is both.
    pub fn hold_out(count: usize, every: usize) -> Self {
        let (test, train): (Vec<_>, Vec<_>) = (0..count).partition(|i| i % every.max(1) == 0);
        if train.is_empty() { Self::all(count) } else { Self { train, test } }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_eighth_is_held_out() {
        let split = Split::hold_out(20, 8);
        assert_eq!(split.test, [0, 8, 16]);
        assert_eq!(split.train.len(), 17);
        assert_eq!(Split::hold_out(1, 8), Split::all(1));
        assert_eq!(Split::hold_out(0, 8), Split::default());
    }
}
