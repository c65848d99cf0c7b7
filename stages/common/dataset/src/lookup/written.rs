//! Names of files as text writes them.

/// Folders of an absolute path and its file name, as in `C:\Users\x\a.png` or `/home/x/a.png`;
/// nothing for a relative path.
pub(super) fn absolute_parts(text: &str) -> Option<Vec<&str>> {
    let mut parts: Vec<&str> = text.split(['/', '\\']).filter(|part| !part.is_empty()).collect();
    let is_absolute = text.starts_with(['/', '\\']) || parts.first().is_some_and(|p| is_drive(p));
    parts.retain(|part| *part != ".");
    (is_absolute && !parts.is_empty()).then_some(parts)
}

fn is_drive(part: &str) -> bool {
    matches!(part.as_bytes(), [letter, b':'] if letter.is_ascii_alphabetic())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_of_other_computers_are_taken_apart() {
        for (text, parts) in [
            (r"C:\Users\x\a.png", Some(vec!["C:", "Users", "x", "a.png"])),
            ("d:/x//a.png", Some(vec!["d:", "x", "a.png"])),
            (r"\\server\share\a.png", Some(vec!["server", "share", "a.png"])),
            ("/home/./x/a.png", Some(vec!["home", "x", "a.png"])),
            ("images/a.png", None),
            (r"images\a.png", None),
            ("CC:/a.png", None),
            ("", None),
            ("/", None),
        ] {
            assert_eq!(absolute_parts(text), parts, "{text}");
        }
    }
}
