use std::fs::File;
use std::hint::black_box;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

/// Storage of pixels: memory up to a budget, then an unnamed file. The operating system deletes
/// the file when the process ends, and caches it while memory is free (design note 038).
#[derive(Debug)]
pub(crate) struct PixelMemory {
    /// Bytes of memory left.
    left: u64,
    /// Folder of the file.
    folder: PathBuf,
    file: Option<Arc<PixelFile>>,
    /// Length of the file in bytes.
    file_length: u64,
}

impl PixelMemory {
    /// Creates a storage of at most `budget` bytes of memory, and a file in `folder` for the rest.
    pub(crate) fn new(budget: u64, folder: PathBuf) -> Self {
        Self { left: budget, folder, file: None, file_length: 0 }
    }

    /// Creates a storage without a file.
    pub(crate) fn unlimited() -> Self {
        Self::new(u64::MAX, PathBuf::new())
    }

    /// Stores bytes in memory, or in the file if the budget is exceeded.
    pub(crate) fn store(&mut self, bytes: Vec<u8>) -> io::Result<Bytes> {
        let length = bytes.len() as u64;
        if let Some(left) = self.left.checked_sub(length) {
            self.left = left;
            return Ok(Bytes::Memory(bytes));
        }
        let file = match &self.file {
            Some(file) => file,
            None => {
                let file = tempfile::tempfile_in(&self.folder)?;
                self.file.insert(Arc::new(PixelFile { file, first_error: OnceLock::new() }))
            }
        };
        let start = self.file_length;
        file.file.write_all_at(&bytes, start)?;
        self.file_length += length;
        Ok(Bytes::File { file: file.clone(), start, length: bytes.len() })
    }

    /// Returns the bytes of memory left.
    pub(crate) fn left(&self) -> u64 {
        self.left
    }

    /// Returns the first I/O error of the file, if any: pixels read after that error are invalid.
    pub(crate) fn first_error(&self) -> Option<&io::Error> {
        self.file.as_ref()?.first_error.get()
    }
}

#[derive(Debug)]
pub(crate) struct PixelFile {
    file: File,
    first_error: OnceLock<io::Error>,
}

impl PixelFile {
    /// Records an error, which the training loop checks after each step.
    fn record(&self, result: io::Result<()>) {
        if let Err(error) = result {
            self.first_error.get_or_init(|| error);
        }
    }
}

/// Bytes in memory or in a file.
#[derive(Debug)]
pub(crate) enum Bytes {
    Memory(Vec<u8>),
    File { file: Arc<PixelFile>, start: u64, length: usize },
}

impl Bytes {
    pub(crate) fn len(&self) -> usize {
        match self {
            Self::Memory(bytes) => bytes.len(),
            Self::File { length, .. } => *length,
        }
    }

    /// Returns a range of the bytes: borrowed from memory, or read from the file into `buffer`.
    pub(crate) fn read<'a>(&'a self, range: Range<usize>, buffer: &'a mut Vec<u8>) -> &'a [u8] {
        match self {
            Self::Memory(bytes) => &bytes[range],
            Self::File { file, start, .. } => {
                buffer.clear();
                buffer.resize(range.len(), 0);
                file.record(file.file.read_exact_at(buffer, start + range.start as u64));
                buffer
            }
        }
    }

    /// Reads the first and the last byte of a range: most rows span two cache lines. The cache
    /// misses of consecutive calls overlap, unlike those of reads with work between them.
    pub(crate) fn prefetch(&self, range: &Range<usize>) {
        if let Self::Memory(bytes) = self
            && let Some(row) = bytes.get(range.clone())
        {
            black_box((row.first().copied(), row.last().copied()));
        }
    }

    /// Overwrites bytes from `offset` on.
    pub(crate) fn write(&mut self, offset: usize, bytes: &[u8]) {
        match self {
            Self::Memory(stored) => stored[offset..offset + bytes.len()].copy_from_slice(bytes),
            Self::File { file, start, .. } => {
                file.record(file.file.write_all_at(bytes, *start + offset as u64));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Overwritten bytes are read back, and a file that can't be read reports an error.
    #[test]
    fn files_are_written_and_their_errors_reported() {
        let folder = tempfile::tempdir().unwrap();
        let mut memory = PixelMemory::new(2, folder.path().to_path_buf());
        let mut first = memory.store(vec![1, 2]).unwrap();
        let mut second = memory.store(vec![3, 4, 5]).unwrap();
        assert!(matches!(first, Bytes::Memory(_)) && matches!(second, Bytes::File { .. }));
        let mut buffer = Vec::new();
        for bytes in [&mut first, &mut second] {
            bytes.write(1, &[9]);
            assert_eq!(bytes.read(1..2, &mut buffer), [9]);
        }
        assert_eq!(second.read(0..3, &mut buffer), [3, 9, 5]);
        assert!(memory.first_error().is_none());
        memory.file.as_ref().unwrap().file.set_len(1).unwrap();
        second.read(0..3, &mut buffer);
        assert!(memory.first_error().is_some());
        assert!(PixelMemory::new(0, folder.path().join("none")).store(vec![1]).is_err());
    }
}
