/// How many there are of something, in words: `1 view`, `2 views`. The plural is the singular with an s.
pub fn counted(count: usize, singular: &str) -> String {
    if count == 1 { format!("1 {singular}") } else { format!("{count} {singular}s") }
}

/// A large number for people: `850`, `40,000`, and from a million on `1.5 M`.
pub fn amount(number: u64) -> String {
    if number >= 1_000_000 {
        return format!("{:.1} M", number as f64 / 1e6);
    }
    match (number / 1000, number % 1000) {
        (0, ones) => ones.to_string(),
        (thousands, ones) => format!("{thousands},{ones:03}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_no_plural_and_little_is_not_nothing() {
        assert_eq!([0, 1, 2].map(|n| counted(n, "training view")), ["0 training views", "1 training view", "2 training views"]);
        let amounts = [0, 1, 999, 1000, 40_000, 999_999, 1_000_000, 14_049_000].map(amount);
        assert_eq!(amounts, ["0", "1", "999", "1,000", "40,000", "999,999", "1.0 M", "14.0 M"]);
    }
}
