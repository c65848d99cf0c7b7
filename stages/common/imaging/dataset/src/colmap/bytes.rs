use std::fmt::Display;

use anyhow::{Context as _, anyhow, ensure};
use artifact::shortened;

/// Reader of little-endian numbers from a binary file; errors contain the byte offset. Never
/// allocates by a count that the file claims.
pub(super) struct Bytes<'a> {
    rest: &'a [u8],
    offset: usize,
}

impl<'a> Bytes<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes, offset: 0 }
    }

    pub(super) fn error(&self, reason: impl Display) -> anyhow::Error {
        anyhow!("byte {}: {reason}", self.offset)
    }

    pub(super) fn take(&mut self, count: usize) -> anyhow::Result<&'a [u8]> {
        let (taken, rest) = self.rest.split_at_checked(count).with_context(|| {
            format!("byte {}: the file ends within an entry; copy it again", self.offset)
        })?;
        self.rest = rest;
        self.offset += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> anyhow::Result<[u8; N]> {
        Ok(*self.take(N)?.first_chunk().expect("`take` returns N bytes"))
    }

    pub(super) fn u32(&mut self) -> anyhow::Result<u32> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    pub(super) fn u64(&mut self) -> anyhow::Result<u64> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    pub(super) fn f64(&mut self) -> anyhow::Result<f64> {
        Ok(f64::from_le_bytes(self.array()?))
    }

    pub(super) fn f64s<const N: usize>(&mut self) -> anyhow::Result<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    /// Reads the number of entries of at least `size` bytes; fails if they don't fit into the rest
    /// of the file.
    pub(super) fn count(&mut self, size: usize, what: &str) -> anyhow::Result<usize> {
        let (count, left) = (self.u64()?, self.rest.len());
        ensure!(
            count <= (left / size) as u64,
            self.error(format!(
                "{count} {what} don't fit into the remaining {left} bytes; copy the file again"
            ))
        );
        Ok(count as usize)
    }

    /// Reads null-terminated text.
    pub(super) fn text(&mut self) -> anyhow::Result<&'a str> {
        let end = self.rest.iter().position(|b| *b == 0).unwrap_or(self.rest.len());
        let bytes = &self.take(end + 1)?[..end];
        std::str::from_utf8(bytes).map_err(|_| {
            let name = bytes.escape_ascii().to_string();
            let name = shortened(&name);
            self.error(format!("{name} is not UTF-8; rename the file, and create the model again"))
        })
    }

    /// Fails unless all bytes have been read.
    pub(super) fn check_end(&self) -> anyhow::Result<()> {
        ensure!(
            self.rest.is_empty(),
            self.error("unexpected data after the last entry; is this the right file?")
        );
        Ok(())
    }
}
