/// How many there are of something, in words: `1 view`, `2 views`. The plural is the singular with
/// an s.
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

/// A size as people say it: `512 bytes`, `3.9 MB`.
pub fn sized(bytes: u64) -> String {
    match bytes {
        0..1_000 => counted(bytes as usize, "byte"),
        1_000..1_000_000 => format!("{:.1} kB", bytes as f64 / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", bytes as f64 / 1e6),
        _ => format!("{:.1} GB", bytes as f64 / 1e9),
    }
}

/// Formats a number from a file or a parameter for a message: in scientific notation where plain digits
/// would be many, as in `1e308`.
pub fn number(value: f64) -> String {
    let is_plain = value == 0.0 || (1e-4..1e7).contains(&value.abs());
    if is_plain { value.to_string() } else { format!("{value:e}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_no_plural_and_little_is_not_nothing() {
        assert_eq!(
            [0, 1, 2].map(|n| counted(n, "training view")),
            ["0 training views", "1 training view", "2 training views"]
        );
        let amounts = [0, 1, 999, 1000, 40_000, 999_999, 1_000_000, 14_049_000].map(amount);
        assert_eq!(amounts, ["0", "1", "999", "1,000", "40,000", "999,999", "1.0 M", "14.0 M"]);
    }

    #[test]
    fn numbers_are_short() {
        let numbers = [0.0, -2.5, 800.0, 1e-4, 1e-5, -1e308, f64::NAN, f64::INFINITY].map(number);
        assert_eq!(numbers, ["0", "-2.5", "800", "0.0001", "1e-5", "-1e308", "NaN", "inf"]);
    }

    #[test]
    fn sizes_in_words() {
        let sizes = [1, 999, 1_500, 99_532_800, 2_580_000_000].map(sized);
        assert_eq!(sizes, ["1 byte", "999 bytes", "1.5 kB", "99.5 MB", "2.6 GB"]);
    }
}
