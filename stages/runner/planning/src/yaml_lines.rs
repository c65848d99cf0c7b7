//! Encodings, merge keys and key lines of hand-written YAML files.
//!
//! * [`decode`]: converts a file's bytes to text, or fails with the line of an invalid byte.
//! * [`expand_merge_keys`]: replaces merge keys. [`find_non_finite`]: finds a number that JSON
//!   can't represent.
//! * [`line_of`]: line number of a key. [`line_of_duplicate`]: line number of a repeated key.
//!
//! serde_yaml parses the values but keeps no line numbers: [`line_of`] and [`line_of_duplicate`]
//! find them for error messages.

use std::collections::BTreeSet;
use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error, MapAccess, SeqAccess, Visitor};
use serde_yaml::Value;

/// Returns the text of a UTF-8 file without its byte order mark. Fails with the line number of the
/// first byte that is invalid or zero.
pub(crate) fn decode(bytes: &[u8]) -> Result<&str, usize> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    // Zero is valid UTF-8, but in a text file a sign of UTF-16.
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    let invalid = match std::str::from_utf8(&bytes[..end]) {
        Ok(text) if end == bytes.len() => return Ok(text),
        Ok(_) => end,
        Err(error) => error.valid_up_to(),
    };
    Err(1 + bytes[..invalid].iter().filter(|byte| **byte == b'\n').count())
}

/// Replaces merge keys (`<<: *anchor`) by the entries of their anchors. Returns whether the
/// document has merge keys.
pub(crate) fn expand_merge_keys(document: &mut Value) -> Result<bool, serde_yaml::Error> {
    let mut merged = false;
    // A merged mapping may contain merge keys of its own.
    while has_merge_key(document) {
        document.apply_merge()?;
        merged = true;
    }
    Ok(merged)
}

fn has_merge_key(value: &Value) -> bool {
    match value {
        // Like `apply_merge`, this ignores a key with a tag, which stays.
        Value::Mapping(entries) => {
            entries.contains_key("<<") || entries.values().any(has_merge_key)
        }
        Value::Sequence(items) => items.iter().any(has_merge_key),
        Value::Tagged(tagged) => has_merge_key(&tagged.value),
        _ => false,
    }
}

/// Returns the keys that lead to the first number that JSON can't represent (`.nan` or `.inf`).
pub(crate) fn find_non_finite(value: &Value) -> Option<Vec<String>> {
    match value {
        Value::Number(number) if number.as_f64().is_some_and(|n| !n.is_finite()) => {
            Some(Vec::new())
        }
        Value::Mapping(entries) => entries.iter().find_map(|(key, value)| {
            let mut path = find_non_finite(value)?;
            path.insert(0, key.as_str().unwrap_or_default().to_owned());
            Some(path)
        }),
        Value::Sequence(items) => items.iter().find_map(find_non_finite),
        Value::Tagged(tagged) => find_non_finite(&tagged.value),
        _ => None,
    }
}

/// Message of the error with which a visitor ends a search: serde_yaml knows lines only for errors,
/// so a visitor reports the wanted key as an error.
const FOUND: &str = "key found";

/// Returns the line number of a key, given as a path through nested mappings. If the key is
/// missing, returns the line of the last existing key of the path.
pub(crate) fn line_of(text: &str, path: &[&str]) -> Option<usize> {
    (1..=path.len()).rev().find_map(|length| find_line(text, &mut |keys| *keys == path[..length]))
}

/// Returns the line number of the first key that repeats an earlier key of its mapping.
pub(crate) fn line_of_duplicate(text: &str) -> Option<usize> {
    let mut seen = BTreeSet::new();
    find_line(text, &mut |keys| !seen.insert(keys.to_vec()))
}

/// Returns the line number of the first key whose path, of keys and indices, is wanted.
fn find_line(text: &str, is_wanted: &mut dyn FnMut(&[String]) -> bool) -> Option<usize> {
    let mut search = Search { path: Vec::new(), is_wanted };
    let error = search.deserialize(serde_yaml::Deserializer::from_str(text)).err()?;
    error.location().filter(|_| error.to_string().contains(FOUND)).map(|at| at.line())
}

/// Search for a key in nested mappings and lists.
struct Search<'a> {
    /// Keys and indices that lead to the current value.
    path: Vec<String>,
    is_wanted: &'a mut dyn FnMut(&[String]) -> bool,
}

impl<'de> DeserializeSeed<'de> for &mut Search<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for &mut Search<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("anything")
    }

    fn visit_bool<E>(self, _: bool) -> Result<(), E> {
        Ok(())
    }

    fn visit_i64<E>(self, _: i64) -> Result<(), E> {
        Ok(())
    }

    fn visit_u64<E>(self, _: u64) -> Result<(), E> {
        Ok(())
    }

    fn visit_f64<E>(self, _: f64) -> Result<(), E> {
        Ok(())
    }

    fn visit_str<E>(self, _: &str) -> Result<(), E> {
        Ok(())
    }

    fn visit_unit<E>(self) -> Result<(), E> {
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        for index in 0.. {
            self.path.push(index.to_string());
            let item = items.next_element_seed(&mut *self)?;
            self.path.pop();
            if item.is_none() {
                break;
            }
        }
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        while map.next_key_seed(Key(self))?.is_some() {
            map.next_value_seed(&mut *self)?;
            self.path.pop();
        }
        Ok(())
    }
}

/// Key of a mapping, at which a search may end.
struct Key<'a, 'b>(&'a mut Search<'b>);

impl<'de> DeserializeSeed<'de> for Key<'_, '_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_str(self)
    }
}

impl Visitor<'_> for Key<'_, '_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a key")
    }

    fn visit_str<E: Error>(self, key: &str) -> Result<(), E> {
        self.0.path.push(key.to_owned());
        if (self.0.is_wanted)(&self.0.path) { Err(E::custom(FOUND)) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_found_on_their_lines() {
        let text = "default: [a]\nstages:\n  a:\n    inputs: {x: b, y: c}\n    # b: a \
            comment\n    parameters:\n      'x': 1\n      z:\n        - 2\n  b: \
            {parameters: {\n    x: 2}}\n  inputs:\n    run: &r ./x\n  c:\n    run: *r\n";
        for (path, line) in [
            (&["default"][..], Some(1)),
            (&["stages", "a"], Some(3)),
            (&["stages", "b"], Some(10)),
            (&["stages", "inputs"], Some(12)),
            (&["stages", "a", "inputs", "x"], Some(4)),
            (&["stages", "a", "parameters", "x"], Some(7)),
            (&["stages", "b", "parameters", "x"], Some(11)),
            (&["stages", "a", "parameters", "nothing"], Some(6)),
            (&["stages", "a", "parameters", "z", "deeper"], Some(8)),
            (&["stages", "c", "run"], Some(15)),
            (&["nothing"], None),
            (&[], None),
        ] {
            assert_eq!(line_of(text, path), line, "{path:?}");
        }
        assert_eq!(line_of("a: [", &["a", "b"]), Some(1));
        for (text, line) in [
            ("a: 1\nb: {x: 1.5, y: [true, null, {z: 2,\n  z: -3}]}\n", Some(3)),
            ("a: 1\nb: 2\na: text\n", Some(3)),
            ("a: {x: 1}\nb: {x: 1}\n", None),
        ] {
            assert_eq!(line_of_duplicate(text), line, "{text}");
        }
    }

    #[test]
    fn only_utf8_is_decoded() {
        assert_eq!(decode(b"\xef\xbb\xbfa: 1"), Ok("a: 1"));
        assert_eq!(decode("ä: 1\r\n".as_bytes()), Ok("ä: 1\r\n"));
        for (bytes, line) in [
            (&b"\xff\xfea\0:\0"[..], 1),
            (b"\xfe\xff\0a\0:", 1),
            (b"a\0:\0", 1),
            (b"\0a\0:", 1),
            (b"a: 1\nb: \xe4\n", 2),
            (b"a: 1\nb: \0\n", 2),
        ] {
            assert_eq!(decode(bytes), Err(line), "{bytes:?}");
        }
    }

    #[test]
    fn merge_keys_are_expanded() {
        for (text, expected) in [
            ("a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}", "a: {x: 1, y: 2}\nb: {y: 3, x: 1}"),
            ("a: &a {x: 1}\nb: &b {<<: *a}\nc: {<<: *b}", "a: {x: 1}\nb: {x: 1}\nc: {x: 1}"),
            (
                "a: &a {x: 1}\nb: &b {y: 1}\nc: {<<: [*a, *b]}",
                "a: {x: 1}\nb: {y: 1}\nc: {x: 1, y: 1}",
            ),
        ] {
            let [mut expanded, expected] =
                [text, expected].map(|yaml| serde_yaml::from_str::<Value>(yaml).unwrap());
            assert!(expand_merge_keys(&mut expanded).unwrap());
            assert_eq!(expanded, expected, "{text}");
        }
        let mut scalar = serde_yaml::from_str("a: {<<: 1}").unwrap();
        assert!(expand_merge_keys(&mut scalar).is_err());
    }
}
