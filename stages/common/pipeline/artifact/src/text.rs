//! Text of messages: printing, escaping, numbers, suggestions for misspelled names, and warnings.
//!
//! Printing never fails: if the reader of stdout or stderr is gone (`| head -1`, a closed
//! terminal), the program continues with the same exit code.

use std::borrow::Cow;
use std::io::Write;

/// Prints one line to stdout like `println!`, but escapes control characters and doesn't panic if
/// stdout is closed.
#[macro_export]
macro_rules! print_line {
    ($($arguments:tt)*) => { $crate::print_text(&format!($($arguments)*)) };
}

/// Prints one line to stderr like `eprintln!`, but escapes control characters and doesn't panic if
/// stderr is closed.
#[macro_export]
macro_rules! report_line {
    ($($arguments:tt)*) => { $crate::report_text(&format!($($arguments)*)) };
}

/// Implements [`print_line!`].
pub fn print_text(line: &str) {
    write_line(&mut std::io::stdout(), line);
}

/// Implements [`report_line!`].
pub fn report_text(line: &str) {
    write_line(&mut std::io::stderr(), line);
}

/// Prints several lines to stdout.
pub fn print_lines(text: &str) {
    let mut stdout = std::io::stdout().lock();
    for line in text.lines() {
        write_line(&mut stdout, line);
    }
}

fn write_line(output: &mut impl Write, text: &str) {
    // One write, so that lines of several threads don't mix.
    output.write_all(format!("{}\n", printable(text)).as_bytes()).ok();
}

/// Escapes control characters, as in `\n` and `\u{1b}`.
///
/// Otherwise a name from a file could move a terminal's cursor, set its title or forge a line of a
/// log. Escaping twice has no further effect.
///
/// ```
/// assert_eq!(artifact::printable("r_0"), "r_0");
/// assert_eq!(artifact::printable("a\u{1b}]0;title\u{7}"), "a\\u{1b}]0;title\\u{7}");
/// ```
pub fn printable(text: &str) -> Cow<'_, str> {
    if !text.contains(char::is_control) {
        return Cow::Borrowed(text);
    }
    let mut escaped = String::with_capacity(text.len() + 16);
    for character in text.chars() {
        if character.is_control() {
            escaped.extend(character.escape_default());
        } else {
            escaped.push(character);
        }
    }
    Cow::Owned(escaped)
}

/// Maximum number of characters that a message quotes from a file. Chosen by hand.
const MAX_QUOTED_CHARACTERS: usize = 100;

/// Returns the beginning of a text, to quote it in a message: names in a damaged file may have
/// megabytes.
///
/// ```
/// assert_eq!(artifact::shortened("r_0"), "r_0");
/// assert_eq!(artifact::shortened(&"é".repeat(101)), format!("{}…", "é".repeat(100)));
/// ```
pub fn shortened(text: &str) -> Cow<'_, str> {
    match text.char_indices().nth(MAX_QUOTED_CHARACTERS) {
        Some((end, _)) => Cow::Owned(format!("{}…", &text[..end])),
        None => Cow::Borrowed(text),
    }
}

/// Formats a count with its noun, whose plural has an s: `1 view`, `2 views`.
pub fn format_count(count: usize, singular: &str) -> String {
    if count == 1 { format!("1 {singular}") } else { format!("{count} {singular}s") }
}

/// Formats a large number: `850`, `40,000`, and from a million `1.5 M`.
pub fn format_amount(number: u64) -> String {
    if number >= 1_000_000 {
        return format!("{:.1} M", number as f64 / 1e6);
    }
    match (number / 1000, number % 1000) {
        (0, ones) => ones.to_string(),
        (thousands, ones) => format!("{thousands},{ones:03}"),
    }
}

/// Formats a size in bytes: `512 bytes`, `3.9 MB`.
pub fn format_size(bytes: u64) -> String {
    match bytes {
        0..1_000 => format_count(bytes as usize, "byte"),
        1_000..999_950 => format!("{:.1} kB", bytes as f64 / 1e3),
        999_950..999_950_000 => format!("{:.1} MB", bytes as f64 / 1e6),
        _ => format!("{:.1} GB", bytes as f64 / 1e9),
    }
}

/// Formats a number from a file or a parameter; very large and very small ones in scientific
/// notation, as in `1e308`.
pub fn format_number(value: f64) -> String {
    let is_plain = value == 0.0 || (1e-4..1e7).contains(&value.abs());
    if is_plain { value.to_string() } else { format!("{value:e}") }
}

/// Maximum length of a name that is compared with known names, in bytes; bounds the time for a
/// hostile name. Chosen by hand.
const MAX_NAME_BYTES: usize = 64;

/// Returns the most similar known name, ignoring case, if at most a third of the letters, or one
/// letter, is wrong, missing, extra or swapped with the next.
pub fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    if name.len() > MAX_NAME_BYTES {
        return None;
    }
    let lower = name.to_lowercase();
    let distances = known
        .into_iter()
        .map(|candidate| (strsim::osa_distance(&lower, &candidate.to_lowercase()), candidate));
    let (distance, closest) = distances.min()?;
    let letters = name.chars().count().max(closest.chars().count());
    (distance <= (letters / 3).max(1) && letters > 1).then_some(closest)
}

/// Returns the end of a message about an unknown name: the most similar known name, and all known
/// names.
pub fn known_names<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    let mut known: Vec<&str> = known.into_iter().collect();
    known.sort_unstable();
    if known.is_empty() {
        return "none are known".to_owned();
    }
    format!("{}known: {}", suggestion(name, known.iter().copied()), known.join(", "))
}

/// Returns `did you mean NAME? ` with the most similar known name; empty without one.
pub fn suggestion<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    nearest(name, known).map_or_else(String::new, |name| format!("did you mean {name}? "))
}

/// Quotes a word for a POSIX shell where necessary.
pub fn shell_quoted(word: &str) -> String {
    let is_plain = word.chars().all(|c| c.is_ascii_alphanumeric() || "_@%+=:,./-".contains(c));
    if is_plain && !word.is_empty() {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

/// Prefix of a warning on stderr, in a log and in a summary.
pub const WARNING: &str = "warning: ";

/// Appends a line for each warning to a summary. The runner prints both at the end, and pages
/// display the warnings.
pub fn with_warnings(summary: &str, warnings: &[String]) -> String {
    let lines: String = warnings.iter().map(|warning| format!("\n{WARNING}{warning}")).collect();
    format!("{summary}{lines}")
}

/// Finds the warnings of a summary written by [`with_warnings`].
pub fn warnings_of(summary: &str) -> impl Iterator<Item = &str> {
    summary.lines().filter_map(|line| line.strip_prefix(WARNING))
}

/// Formats a duration in seconds, as `12.3 s` or `4.5 min`.
pub fn format_duration(seconds: f64) -> String {
    if seconds < 90.0 { format!("{seconds:.1} s") } else { format!("{:.1} min", seconds / 60.0) }
}

/// Formats a time, given in seconds since 1970, as `2026-11-24 23:23:05 UTC`.
pub fn format_utc(unix: u64) -> String {
    let seconds = unix % 86_400;
    // Howard Hinnant's algorithm `civil_from_days`: days since 1 March 0000, in eras of 400 years.
    // Years that begin in March end with the leap day.
    let days = unix / 86_400 + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let (month, carry) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    let year = era * 400 + year + carry;
    format!(
        "{year:04}-{month:02}-{day:02} {:02}:{:02}:{:02} UTC",
        seconds / 3600,
        seconds / 60 % 60,
        seconds % 60
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_quoted_for_a_shell() {
        for (argument, quoted) in [
            ("train-ss", "train-ss"),
            ("dataset=/data/lego,./x", "dataset=/data/lego,./x"),
            ("dataset=my scenes/Bäume", "'dataset=my scenes/Bäume'"),
            ("name=it's $(rm)", r"'name=it'\''s $(rm)'"),
            ("~/x", "'~/x'"),
            ("", "''"),
        ] {
            assert_eq!(shell_quoted(argument), quoted);
        }
    }

    struct ClosedPipe;
    impl Write for ClosedPipe {
        fn write(&mut self, _: &[u8]) -> std::io::Result<usize> {
            Err(std::io::ErrorKind::BrokenPipe.into())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn lines_are_escaped_and_a_closed_pipe_causes_no_panic() {
        let mut written = Vec::new();
        write_line(&mut written, "a\u{1b}[31mb\nc");
        assert_eq!(written, b"a\\u{1b}[31mb\\nc\n");
        write_line(&mut ClosedPipe, "nobody hears this");
    }

    #[test]
    fn control_characters_are_escaped() {
        for (text, escaped) in [
            ("Bäume/写真 🌲 \\ \"r_0\"", "Bäume/写真 🌲 \\ \"r_0\""),
            ("\u{1b}]0;PWN\u{7}\u{1b}[31mred", "\\u{1b}]0;PWN\\u{7}\\u{1b}[31mred"),
            ("two\nlines\r\n\tand a tab", "two\\nlines\\r\\n\\tand a tab"),
            (
                "C1: \u{9b}31m \u{85}, delete: \u{7f}, null: \0",
                "C1: \\u{9b}31m \\u{85}, delete: \\u{7f}, null: \\u{0}",
            ),
        ] {
            assert_eq!(printable(text), escaped);
            assert_eq!(printable(escaped), escaped);
        }
        assert!(matches!(printable("r_0"), Cow::Borrowed("r_0")));
    }

    #[test]
    fn counts_have_plurals_and_amounts_are_grouped() {
        assert_eq!(
            [0, 1, 2].map(|n| format_count(n, "training view")),
            ["0 training views", "1 training view", "2 training views"]
        );
        let amounts = [0, 1, 999, 1000, 40_000, 999_999, 1_000_000, 14_049_000].map(format_amount);
        assert_eq!(amounts, ["0", "1", "999", "1,000", "40,000", "999,999", "1.0 M", "14.0 M"]);
    }

    #[test]
    fn numbers_are_short() {
        let numbers =
            [0.0, -2.5, 800.0, 1e-4, 1e-5, -1e308, f64::NAN, f64::INFINITY].map(format_number);
        assert_eq!(numbers, ["0", "-2.5", "800", "0.0001", "1e-5", "-1e308", "NaN", "inf"]);
    }

    #[test]
    fn sizes_have_units() {
        let sizes = [1, 999, 1_500, 99_532_800, 2_580_000_000].map(format_size);
        assert_eq!(sizes, ["1 byte", "999 bytes", "1.5 kB", "99.5 MB", "2.6 GB"]);
    }

    #[test]
    fn typos_are_recognised_and_other_names_are_not() {
        let known = ["eval", "prep", "report", "render-depth", "train-ss"];
        for (name, expected) in [
            ("evla", Some("eval")),
            ("Eval", Some("eval")),
            ("reprot", Some("report")),
            ("render_deph", Some("render-depth")),
            ("trainss", Some("train-ss")),
            ("perp", Some("prep")),
            ("video", None),
            ("nowhere", None),
            ("", None),
            ("x", None),
        ] {
            assert_eq!(nearest(name, known), expected, "{name}");
        }
        assert_eq!(nearest(&"e".repeat(100_000), known), None);
        assert_eq!(nearest("lr", ["hr"]), Some("hr"));
    }

    #[test]
    fn known_names_are_listed() {
        assert_eq!(known_names("evla", ["prep", "eval"]), "did you mean eval? known: eval, prep");
        assert_eq!(known_names("nothing", ["prep", "eval"]), "known: eval, prep");
        assert_eq!(known_names("a", []), "none are known");
    }

    #[test]
    fn warnings_round_trip() {
        let warnings = ["one".to_owned(), "another: two".to_owned()];
        let summary = with_warnings("3 views", &warnings);
        assert_eq!(summary, "3 views\nwarning: one\nwarning: another: two");
        assert_eq!(warnings_of(&summary).collect::<Vec<_>>(), warnings);
        assert_eq!(with_warnings("3 views", &[]), "3 views");
        assert_eq!(warnings_of("a warning: none").count(), 0);
    }

    #[test]
    fn times_equal_those_of_the_date_command() {
        for (unix, text) in [
            (0, "1970-01-01 00:00:00 UTC"),
            (951_782_400, "2000-02-29 00:00:00 UTC"),
            (951_868_799, "2000-02-29 23:59:59 UTC"),
            (951_868_800, "2000-03-01 00:00:00 UTC"),
            (1_798_761_599, "2026-12-31 23:59:59 UTC"),
            (4_107_542_400, "2100-03-01 00:00:00 UTC"),
        ] {
            assert_eq!(format_utc(unix), text);
        }
    }
}
