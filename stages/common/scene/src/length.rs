/// Formats a length in scene units with a number of decimals, or with three significant digits if the
/// decimals would show none, and for a million units and more.
pub fn length(value: f64, decimals: u8) -> String {
    let fixed = format!("{value:.*}", usize::from(decimals));
    let shows_digits = fixed.contains(|digit| ('1'..='9').contains(&digit));
    if value == 0.0 || (shows_digits && value.abs() < 1e6) { fixed } else { format!("{value:.2e}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_have_significant_digits() {
        for (value, decimals, expected) in [
            (0.0, 3, "0.000"),
            (3.0483, 3, "3.048"),
            (0.052, 3, "0.052"),
            (0.075_6, 2, "0.08"),
            (0.004_125_9, 2, "4.13e-3"),
            (3.024e-5, 3, "3.02e-5"),
            (418.3594, 3, "418.359"),
            (999_000.0, 0, "999000"),
            (4_649_776.0, 3, "4.65e6"),
            (151.2, 0, "151"),
            (0.2, 0, "2.00e-1"),
            (-1.23e-7, 4, "-1.23e-7"),
            (1e300, 2, "1.00e300"),
            (f64::INFINITY, 2, "inf"),
            (f64::NAN, 2, "NaN"),
        ] {
            assert_eq!(length(value, decimals), expected);
        }
    }
}
