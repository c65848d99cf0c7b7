use std::fmt::Display;
use std::path::Path;

use artifact::shortened;

use crate::error::{DatasetError, Reason};

/// Reader of little-endian numbers from a binary file; errors contain the byte offset. Never
/// allocates by a count that the file claims.
pub(super) struct Bytes<'a> {
    path: &'a Path,
    rest: &'a [u8],
    offset: usize,
}

impl<'a> Bytes<'a> {
    pub(super) fn new(path: &'a Path, bytes: &'a [u8]) -> Self {
        Self { path, rest: bytes, offset: 0 }
    }

    pub(super) fn error(&self, reason: impl Display) -> DatasetError {
        let reason = Reason::new(format!("byte {}: {reason}", self.offset));
        DatasetError::format(self.path, reason)
    }

    pub(super) fn take(&mut self, count: usize, what: &str) -> Result<&'a [u8], DatasetError> {
        let Some((taken, rest)) = self.rest.split_at_checked(count) else {
            return Err(self.error(format!("the file ends within {what}; copy it again")));
        };
        self.rest = rest;
        self.offset += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N], DatasetError> {
        Ok(*self.take(N, what)?.first_chunk().expect("`take` returns N bytes"))
    }

    pub(super) fn u32(&mut self, what: &str) -> Result<u32, DatasetError> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    pub(super) fn u64(&mut self, what: &str) -> Result<u64, DatasetError> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    pub(super) fn f64(&mut self, what: &str) -> Result<f64, DatasetError> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    pub(super) fn f64s<const N: usize>(&mut self, what: &str) -> Result<[f64; N], DatasetError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64(what)?;
        }
        Ok(values)
    }

    /// Reads the number of entries of at least `size` bytes; fails if they don't fit into the rest
    /// of the file.
    pub(super) fn count(&mut self, size: usize, what: &str) -> Result<usize, DatasetError> {
        let count = self.u64(what)?;
        if count > (self.rest.len() / size) as u64 {
            let left = self.rest.len();
            let problem = format!("{count} {what} don't fit into the remaining {left} bytes");
            return Err(self.error(format!("{problem}; copy the file again")));
        }
        Ok(count as usize)
    }

    /// Reads null-terminated text.
    pub(super) fn text(&mut self, what: &str) -> Result<&'a str, DatasetError> {
        let Some(end) = self.rest.iter().position(|b| *b == 0) else {
            return Err(self.error(format!("{what} is not terminated; copy the file again")));
        };
        let bytes = &self.take(end + 1, what)?[..end];
        std::str::from_utf8(bytes).map_err(|_| {
            let name = bytes.escape_ascii().to_string();
            let problem = format!("{what}, {}, is not UTF-8", shortened(&name));
            self.error(format!("{problem}; rename the file, and create the model again"))
        })
    }

    /// Fails unless all bytes have been read; `what` are the file's entries.
    pub(super) fn check_end(&self, what: &str) -> Result<(), DatasetError> {
        if self.rest.is_empty() {
            Ok(())
        } else {
            let problem = format!("unexpected data after the last of the {what}");
            Err(self.error(format!("{problem}; is this the right file?")))
        }
    }
}
