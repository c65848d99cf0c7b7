/// How a line begins that warns: on stderr, in a log and in a summary.
pub const WARNING: &str = "warning: ";

/// A summary, and a line for each warning below it: the runner prints both at the end, and pages
/// show the warnings.
pub fn with_warnings(summary: &str, warnings: &[String]) -> String {
    let lines = warnings.iter().map(|warning| format!("\n{WARNING}{warning}"));
    std::iter::once(summary.to_owned()).chain(lines).collect()
}

/// The warnings of such a summary.
pub fn warnings_of(summary: &str) -> impl Iterator<Item = &str> {
    summary.lines().filter_map(|line| line.strip_prefix(WARNING))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warnings_come_back() {
        let warnings = ["one".to_owned(), "another: two".to_owned()];
        let summary = with_warnings("3 views", &warnings);
        assert_eq!(summary, "3 views\nwarning: one\nwarning: another: two");
        assert_eq!(warnings_of(&summary).collect::<Vec<_>>(), warnings);
        assert_eq!(with_warnings("3 views", &[]), "3 views");
        assert_eq!(warnings_of("a warning: none").count(), 0);
    }
}
