use std::path::Path;

use anyhow::{Context as _, anyhow, ensure};
use artifact::{format_count, shortened};

use crate::file_status::path_text;

/// Formats a count with its noun and verb, such as `1 mask has` or `2 masks have`.
pub(crate) fn counted_with_verb(count: usize, noun: &str, [one, many]: [&str; 2]) -> String {
    format!("{} {}", format_count(count, noun), if count == 1 { one } else { many })
}

/// Reads a text file in UTF-8, with or without a byte order mark.
pub(crate) fn read_text(path: &Path) -> anyhow::Result<String> {
    let bytes = std::fs::read(path).with_context(|| path_text(path))?;
    decode(bytes).with_context(|| path_text(path))
}

const UTF8_MARK: &[u8] = b"\xef\xbb\xbf";

/// Decodes a file's text; fails with the encoding or the first word that isn't UTF-8.
fn decode(mut bytes: Vec<u8>) -> anyhow::Result<String> {
    ensure!(!is_utf16(&bytes), "file is UTF-16; save it as UTF-8");
    if bytes.starts_with(UTF8_MARK) {
        bytes.drain(..UTF8_MARK.len());
    }
    String::from_utf8(bytes).map_err(|error| {
        let (bytes, offset) = (error.as_bytes(), error.utf8_error().valid_up_to());
        let line = 1 + bytes[..offset].iter().filter(|b| **b == b'\n').count();
        let (before, after) = bytes.split_at(offset);
        let start = before.iter().rposition(u8::is_ascii_whitespace).map_or(0, |space| space + 1);
        let end = after
            .iter()
            .position(u8::is_ascii_whitespace)
            .map_or(bytes.len(), |space| offset + space);
        let word = bytes[start..end].escape_ascii().to_string();
        let word = shortened(&word);
        let remedy = "save the file as UTF-8, and rename files with such names";
        anyhow!("line {line}: {word} is not UTF-8; {remedy}")
    })
}

/// True if the text begins with a UTF-16 byte order mark, or has a null byte in its first
/// character.
fn is_utf16(bytes: &[u8]) -> bool {
    matches!(bytes, [0xff, 0xfe, ..] | [0xfe, 0xff, ..] | [0, _, ..] | [_, 0, ..])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn utf16(text: &str, to_bytes: fn(u16) -> [u8; 2]) -> Vec<u8> {
        text.encode_utf16().flat_map(to_bytes).collect()
    }

    #[test]
    fn byte_order_marks_are_removed_and_other_encodings_are_named() {
        assert_eq!(decode(b"\xef\xbb\xbf{}".to_vec()).unwrap(), "{}");
        assert_eq!(decode("Bäume\r\n".into()).unwrap(), "Bäume\r\n");
        assert_eq!(decode(Vec::new()).unwrap(), "");
        for text in ["{}", "\u{feff}{}"] {
            for bytes in [utf16(text, u16::to_le_bytes), utf16(text, u16::to_be_bytes)] {
                assert_eq!(
                    decode(bytes).unwrap_err().to_string(),
                    "file is UTF-16; save it as UTF-8"
                );
            }
        }
        let latin1 = b"# list\n1 2 B\xe4ume.png \xff\n".to_vec();
        let message = decode(latin1).unwrap_err().to_string();
        assert!(
            message.starts_with(r"line 2: B\xe4ume.png is not UTF-8; save the file as UTF-8"),
            "{message}"
        );
    }
}
