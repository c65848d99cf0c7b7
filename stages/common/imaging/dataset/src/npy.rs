//! Reads matrices in NumPy's format, versions 1 to 3.

use anyhow::{Context as _, bail, ensure};

/// Maximum length of a header: NumPy's default limit. The header of a matrix has about 100 bytes.
const MAX_HEADER_BYTES: usize = 10_000;

/// Two-dimensional array, row by row.
#[derive(Debug, PartialEq)]
pub(crate) struct Matrix {
    pub(crate) rows: usize,
    pub(crate) columns: usize,
    pub(crate) numbers: Vec<f64>,
}

/// Reads a matrix of floats from a file's bytes.
pub(crate) fn read_matrix(bytes: &[u8]) -> anyhow::Result<Matrix> {
    let (header, data) = split_header(bytes)
        .context("magic string or version is wrong, or the header is incomplete")?;
    let length = header.len();
    ensure!(
        length <= MAX_HEADER_BYTES,
        "header has {length} bytes; the maximum is {MAX_HEADER_BYTES}"
    );
    let element_type = entry(header, "descr")
        .and_then(parse_string)
        .context("header has no descr that is a string")?;
    let is_by_columns = entry(header, "fortran_order")
        .and_then(parse_bool)
        .context("header has no fortran_order that is True or False")?;
    let shape =
        entry(header, "shape").and_then(parse_shape).context("header has no shape of integers")?;
    let [rows, columns] = shape[..] else { bail!("unsupported shape {shape:?}") };
    let count =
        rows.checked_mul(columns).with_context(|| format!("unsupported shape {shape:?}"))?;
    let stored = match element_type {
        "<f8" | "=f8" => numbers(data, count, f64::from_le_bytes),
        ">f8" => numbers(data, count, f64::from_be_bytes),
        "<f4" | "=f4" => numbers(data, count, |bytes| f64::from(f32::from_le_bytes(bytes))),
        ">f4" => numbers(data, count, |bytes| f64::from(f32::from_be_bytes(bytes))),
        _ => bail!("element type is {element_type:?}; expected a float of 4 or 8 bytes"),
    };
    let stored = stored.context("file is cut short")?;
    let numbers = if is_by_columns {
        (0..count).map(|i| stored[i % columns * rows + i / columns]).collect()
    } else {
        stored
    };
    Ok(Matrix { rows, columns, numbers })
}

/// Splits a file into the header's text and the data after it.
fn split_header(bytes: &[u8]) -> Option<(&str, &[u8])> {
    let rest = bytes.strip_prefix(b"\x93NUMPY")?;
    let (length, rest) = match *rest {
        [1, _, a, b, ref rest @ ..] => (u32::from(u16::from_le_bytes([a, b])), rest),
        [2 | 3, _, a, b, c, d, ref rest @ ..] => (u32::from_le_bytes([a, b, c, d]), rest),
        _ => return None,
    };
    let (header, data) = rest.split_at_checked(length as usize)?;
    Some((std::str::from_utf8(header).ok()?, data))
}

/// Returns the header's text after a key; the header is a Python dictionary.
fn entry<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    let keys = [format!("'{key}':"), format!("\"{key}\":")];
    let rest = keys.iter().find_map(|key| Some(header.split_once(key.as_str())?.1))?;
    Some(rest.trim_start())
}

/// Parses the quoted string at the beginning of a text.
fn parse_string(text: &str) -> Option<&str> {
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    Some(text[1..].split_once(quote)?.0)
}

/// Parses Python's `True` or `False` at the beginning of a text.
fn parse_bool(text: &str) -> Option<bool> {
    match text.split([',', '}']).next()?.trim_end() {
        "True" => Some(true),
        "False" => Some(false),
        _ => None,
    }
}

/// Parses the tuple of integers at the beginning of a text. Python 2 wrote `20L`.
fn parse_shape(text: &str) -> Option<Vec<usize>> {
    let (lengths, _) = text.strip_prefix('(')?.split_once(')')?;
    let words = lengths.split(',').map(str::trim).filter(|word| !word.is_empty());
    words.map(|word| word.strip_suffix('L').unwrap_or(word).parse().ok()).collect()
}

/// Decodes `count` numbers; `None`, without an allocation, if the data have fewer.
fn numbers<const N: usize>(
    data: &[u8],
    count: usize,
    number: impl Fn([u8; N]) -> f64,
) -> Option<Vec<f64>> {
    Some(data.as_chunks::<N>().0.get(..count)?.iter().map(|bytes| number(*bytes)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(version: u8, header: &str, data: &[u8]) -> Vec<u8> {
        let length = (header.len() as u32).to_le_bytes();
        let length = if version == 1 { &length[..2] } else { &length };
        [b"\x93NUMPY", &[version, 0][..], length, header.as_bytes(), data].concat()
    }

    fn matrix(numbers: [f64; 6]) -> Matrix {
        Matrix { rows: 2, columns: 3, numbers: numbers.to_vec() }
    }

    fn padded_header(kind: &str, order: &str) -> String {
        format!("{{'descr': '{kind}', 'fortran_order': {order}, 'shape': (2, 3), }}   \n")
    }

    #[test]
    fn every_version_order_and_float_is_read() {
        let data = [1.5f64, 2.0, 3.0, 4.0, 5.0, -6.5];
        let little: Vec<u8> = data.iter().flat_map(|v| v.to_le_bytes()).collect();
        let big: Vec<u8> = data.iter().flat_map(|v| v.to_be_bytes()).collect();
        let single: Vec<u8> = data.iter().flat_map(|v| (*v as f32).to_le_bytes()).collect();
        for version in [1, 2, 3] {
            for (kind, bytes) in [("<f8", &little), (">f8", &big), ("<f4", &single)] {
                let bytes = file(version, &padded_header(kind, "False"), bytes);
                assert_eq!(read_matrix(&bytes).unwrap(), matrix(data), "{version} {kind}");
            }
        }
        // Column-major order.
        let bytes = file(1, &padded_header("<f8", "True"), &little);
        assert_eq!(read_matrix(&bytes).unwrap(), matrix([1.5, 3.0, 5.0, 2.0, 4.0, -6.5]));
        let python_2 = r#"{"descr": "<f8", "fortran_order": False, "shape": (2L, 3L)}"#;
        assert_eq!(read_matrix(&file(1, python_2, &little)).unwrap(), matrix(data));
    }

    fn header(kind: &str, shape: &str) -> String {
        format!("{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}")
    }

    #[test]
    fn unsupported_files_are_refused_with_a_reason() {
        let data = [0; 48];
        let huge = format!("({0}, {0})", usize::MAX);
        for (kind, shape, expected) in [
            ("'<i8'", "(2, 3)", "element type is \"<i8\""),
            ("[('x', '<f8')]", "(2, 3)", "no descr"),
            ("'<f8'", "(2, 3, 1)", "unsupported shape [2, 3, 1]"),
            ("'<f8'", "()", "unsupported shape []"),
            ("'<f8'", "(2, -3)", "no shape"),
            ("'<f8'", "((((2, 3))))", "no shape"),
            ("'<f8'", "(2, 4)", "cut short"),
            ("'<f8'", &huge, "unsupported shape"),
        ] {
            let reason =
                read_matrix(&file(1, &header(kind, shape), &data)).unwrap_err().to_string();
            assert!(reason.contains(expected), "{kind} {shape}: {reason}");
        }
        let complete = file(1, &header("'<f8'", "(2, 3)"), &data);
        assert!(read_matrix(&complete).is_ok());
        for end in 0..complete.len() {
            assert!(read_matrix(&complete[..end]).is_err(), "{end} of {} bytes", complete.len());
        }
    }

    /// Returns a file of version 2 whose header claims `length` bytes.
    fn file_claiming(length: u32, header: &str, data: &[u8]) -> Vec<u8> {
        [&b"\x93NUMPY\x02\0"[..], &length.to_le_bytes(), header.as_bytes(), data].concat()
    }

    #[track_caller]
    fn assert_refused(bytes: &[u8], expected: &str) {
        let reason = read_matrix(bytes).unwrap_err().to_string();
        assert!(reason.contains(expected), "{reason}");
    }

    #[test]
    fn invalid_headers_are_refused_with_a_reason() {
        let (good, data) = (header("'<f8'", "(2, 3)"), [0; 48]);
        for version in [0, 4, 255] {
            assert_refused(&file(version, &good, &data), "magic string or version is wrong");
        }
        // A header whose stated length exceeds the file: by one byte, and by the maximum.
        let rest = (good.len() + data.len()) as u32;
        assert_refused(&file_claiming(rest + 1, &good, &data), "magic string or version is wrong");
        assert_refused(&file_claiming(u32::MAX, &good, &data), "magic string or version is wrong");
        // A header of length 0, and one that includes a byte of the data, which isn't text.
        assert_refused(&file_claiming(0, &good, &data), "no descr");
        let numbers = [0xff; 48];
        let mut overlapping = file(1, &good, &numbers);
        overlapping[8] += 1;
        assert_refused(&overlapping, "magic string or version is wrong");
        for order in ["", "Truth", "1", "'True'", "true", "None"] {
            let invalid = file(1, &padded_header("<f8", order), &data);
            assert_refused(&invalid, "no fortran_order that is True or False");
        }
        for (length, is_read) in [(MAX_HEADER_BYTES, true), (MAX_HEADER_BYTES + 1, false)] {
            let padded = good.clone() + &" ".repeat(length - good.len());
            assert_eq!(read_matrix(&file(2, &padded, &data)).is_ok(), is_read, "{length}");
        }
    }

    /// Returns rows, columns and number of values read from a file with six numbers.
    fn sizes(order: &str, shape: &str) -> Option<[usize; 3]> {
        let header = format!("{{'descr': '<f8', 'fortran_order': {order}, 'shape': {shape}}}");
        let matrix = read_matrix(&file(1, &header, &[0; 48])).ok()?;
        Some([matrix.rows, matrix.columns, matrix.numbers.len()])
    }

    /// The size in the header is compared with the data before memory is allocated.
    #[test]
    fn a_matrix_has_the_numbers_that_its_shape_claims() {
        let max = usize::MAX;
        for order in ["False", "True"] {
            for (shape, expected) in [
                ("(6, 1)".to_owned(), Some([6, 1, 6])),
                ("(1, 6)".to_owned(), Some([1, 6, 6])),
                // Data after the matrix are ignored.
                ("(2, 1)".to_owned(), Some([2, 1, 2])),
                ("(7, 1)".to_owned(), None),
                // A matrix without rows or columns has no numbers, whatever the other length is.
                ("(0, 17)".to_owned(), Some([0, 17, 0])),
                (format!("({max}, 0)"), Some([max, 0, 0])),
                (format!("(0, {max})"), Some([0, max, 0])),
                // The largest possible count, a count that overflows, and a length that isn't a
                // usize.
                (format!("({}, 17)", max / 17), None),
                (format!("({}, 17)", max / 17 + 1), None),
                (format!("({max}0, 17)"), None),
            ] {
                assert_eq!(sizes(order, &shape), expected, "{order} {shape}");
            }
        }
    }

    /// Every number is accepted here. Callers check values: `llff` refuses NaN, for example.
    #[test]
    fn every_number_is_read_unchanged() {
        let numbers = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -0.0, 5e-324, f64::MAX];
        let data: Vec<u8> = numbers.iter().flat_map(|v| v.to_le_bytes()).collect();
        let read = read_matrix(&file(1, &header("'<f8'", "(2, 3)"), &data)).unwrap();
        let bits = |numbers: &[f64]| numbers.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&read.numbers), bits(&numbers));
    }
}
