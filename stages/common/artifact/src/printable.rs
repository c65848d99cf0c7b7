use std::borrow::Cow;

/// Text that is safe to print: control characters are spelled out, as in `\n` and `\u{1b}`.
///
/// Names from files may hold what moves a terminal's cursor, sets its title or forges a line of a
/// log. Escaping twice changes nothing, and text without control characters stays as it is.
///
/// ```
/// assert_eq!(artifact::printable("r_0"), "r_0");
/// assert_eq!(artifact::printable("a\u{1b}]0;title\u{7}"), "a\\u{1b}]0;title\\u{7}");
/// ```
pub fn printable(text: &str) -> Cow<'_, str> {
    if !text.contains(char::is_control) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 16);
    for character in text.chars() {
        if character.is_control() {
            shown.extend(character.escape_default());
        } else {
            shown.push(character);
        }
    }
    Cow::Owned(shown)
}

/// Characters of a file's text that a message repeats.
const MAX_SHOWN_CHARACTERS: usize = 100;

/// Returns the beginning of a text from a file, for a message: a damaged file's names may have megabytes.
///
/// ```
/// assert_eq!(artifact::shortened("r_0"), "r_0");
/// assert_eq!(artifact::shortened(&"é".repeat(101)), format!("{}…", "é".repeat(100)));
/// ```
pub fn shortened(text: &str) -> Cow<'_, str> {
    match text.char_indices().nth(MAX_SHOWN_CHARACTERS) {
        Some((end, _)) => Cow::Owned(format!("{}…", &text[..end])),
        None => Cow::Borrowed(text),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_spelled_out() {
        for (text, shown) in [
            ("Bäume/写真 🌲 \\ \"r_0\"", "Bäume/写真 🌲 \\ \"r_0\""),
            ("\u{1b}]0;PWN\u{7}\u{1b}[31mred", "\\u{1b}]0;PWN\\u{7}\\u{1b}[31mred"),
            ("two\nlines\r\n\tand a tab", "two\\nlines\\r\\n\\tand a tab"),
            (
                "C1: \u{9b}31m \u{85}, delete: \u{7f}, null: \0",
                "C1: \\u{9b}31m \\u{85}, delete: \\u{7f}, null: \\u{0}",
            ),
        ] {
            assert_eq!(printable(text), shown);
            assert_eq!(printable(shown), shown);
        }
        assert!(matches!(printable("r_0"), Cow::Borrowed("r_0")));
    }
}
