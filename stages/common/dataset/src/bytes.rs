use std::path::Path;

use crate::error::DatasetError;
use crate::file_reason::FileReason;

/// Little-endian numbers from a binary file, with its place in every complaint. Nothing is
/// allocated by what the file claims.
pub(crate) struct Bytes<'a> {
    path: &'a Path,
    rest: &'a [u8],
    at: usize,
}

impl<'a> Bytes<'a> {
    pub(crate) fn new(path: &'a Path, bytes: &'a [u8]) -> Self {
        Self { path, rest: bytes, at: 0 }
    }

    pub(crate) fn error(&self, reason: FileReason) -> DatasetError {
        let reason = FileReason::Byte { byte: self.at, reason: Box::new(reason) };
        DatasetError::format(self.path, reason)
    }

    pub(crate) fn take(
        &mut self,
        count: usize,
        what: &'static str,
    ) -> Result<&'a [u8], DatasetError> {
        let Some((taken, rest)) = self.rest.split_at_checked(count) else {
            return Err(self.error(FileReason::CutShort { what }));
        };
        self.rest = rest;
        self.at += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], DatasetError> {
        Ok(self.take(N, what)?.try_into().unwrap_or([0; N]))
    }

    pub(crate) fn u32(&mut self, what: &'static str) -> Result<u32, DatasetError> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn u64(&mut self, what: &'static str) -> Result<u64, DatasetError> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn f64(&mut self, what: &'static str) -> Result<f64, DatasetError> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn f64s<const N: usize>(
        &mut self,
        what: &'static str,
    ) -> Result<[f64; N], DatasetError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64(what)?;
        }
        Ok(values)
    }

    /// How many entries of at least `size` bytes follow: no more than the file has room for.
    pub(crate) fn count(&mut self, size: usize, what: &'static str) -> Result<usize, DatasetError> {
        let count = self.u64(what)?;
        if count > (self.rest.len() / size.max(1)) as u64 {
            return Err(self.error(FileReason::TooMany { count, what, left: self.rest.len() }));
        }
        Ok(count as usize)
    }

    /// Text up to a byte of 0.
    pub(crate) fn text(&mut self, what: &'static str) -> Result<&'a str, DatasetError> {
        let Some(end) = self.rest.iter().position(|b| *b == 0) else {
            return Err(self.error(FileReason::Endless { what }));
        };
        let bytes = &self.take(end + 1, what)?[..end];
        std::str::from_utf8(bytes).map_err(|_| {
            self.error(FileReason::NoName { what, name: bytes.escape_ascii().to_string() })
        })
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.rest.is_empty()
    }
}
