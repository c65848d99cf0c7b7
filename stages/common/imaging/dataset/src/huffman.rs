//! Skips the Huffman-coded bits of a JPEG scan (ITU-T T.81, annexes C, F and G).

use crate::jpeg::RESTART_MARKERS;

/// Maximum length of codes that one table lookup resolves.
const LOOKUP_BITS: u32 = 9;
const MAX_CODE_BITS: u32 = 16;

/// Huffman table.
#[derive(Debug)]
pub(crate) struct Table {
    /// Code length and symbol, indexed by the next bits; length 0 for longer codes.
    lookup: Vec<(u8, u8)>,
    /// Exclusive upper bound of the 16 bits that begin with a code of at most a length, and a
    /// symbol's index minus its code; indexed by the length.
    ends: [(u32, i32); MAX_CODE_BITS as usize + 1],
    symbols: Vec<u8>,
}

impl Table {
    /// Reads the table at the beginning of a segment; returns it and the rest of the segment.
    pub(crate) fn read(bytes: &[u8]) -> Option<(Self, &[u8])> {
        let (counts, rest) = bytes.split_at_checked(MAX_CODE_BITS as usize)?;
        let count = counts.iter().map(|count| usize::from(*count)).sum();
        let (symbols, rest) = rest.split_at_checked(count)?;
        let mut table = Self {
            lookup: vec![(0, 0); 1 << LOOKUP_BITS],
            ends: [(0, 0); MAX_CODE_BITS as usize + 1],
            symbols: symbols.to_vec(),
        };
        let (mut code, mut index) = (0u32, 0usize);
        for (i, count) in counts.iter().enumerate() {
            let length = i as u32 + 1;
            let first = code;
            code += u32::from(*count);
            if code > 1 << length {
                return None;
            }
            table.ends[length as usize] =
                (code << (MAX_CODE_BITS - length), index as i32 - first as i32);
            if length <= LOOKUP_BITS {
                table.fill_lookup(length, first..code, index);
            }
            index += usize::from(*count);
            code <<= 1;
        }
        Some((table, rest))
    }

    /// Adds codes of one length to the lookup; their symbols begin at `index`.
    fn fill_lookup(&mut self, length: u32, codes: std::ops::Range<u32>, index: usize) {
        let spare = LOOKUP_BITS - length;
        for (i, code) in codes.enumerate() {
            let first = (code << spare) as usize;
            let symbol = self.symbols[index + i];
            self.lookup[first..first + (1 << spare)].fill((length as u8, symbol));
        }
    }

    /// Returns the length and symbol of the code at the beginning of 16 bits.
    fn decode(&self, bits: u32) -> Option<(u32, u8)> {
        let (length, symbol) = self.lookup[(bits >> (MAX_CODE_BITS - LOOKUP_BITS)) as usize];
        if length > 0 {
            return Some((u32::from(length), symbol));
        }
        for length in LOOKUP_BITS + 1..=MAX_CODE_BITS {
            let (end, offset) = self.ends[length as usize];
            if bits < end {
                let index = (bits >> (MAX_CODE_BITS - length)) as i32 + offset;
                return Some((length, *self.symbols.get(usize::try_from(index).ok()?)?));
            }
        }
        None
    }
}

/// Range of coefficients in a scan (spectral selection).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Band {
    /// First and last coefficient in zigzag order; 0 is DC.
    pub(crate) first: u32,
    pub(crate) last: u32,
    /// True if the scan adds a lower bit to known coefficients (successive approximation).
    pub(crate) is_refinement: bool,
}

impl Band {
    /// Band of a sequential JPEG: all coefficients.
    pub(crate) const ALL: Self = Self { first: 0, last: 63, is_refinement: false };

    /// Parses the end of a progressive scan's header; `None` if it is invalid.
    pub(crate) fn read(header: &[u8]) -> Option<Self> {
        let [first, last, approximation] = *header.first_chunk()?;
        let is_valid = last < 64 && first <= last && (first > 0 || last == 0);
        is_valid.then_some(Self {
            first: u32::from(first),
            last: u32::from(last),
            is_refinement: approximation >> 4 > 0,
        })
    }
}

/// Reader of entropy-coded data up to the next marker.
pub(crate) struct Bits<'a> {
    bytes: &'a [u8],
    /// Offset of the next byte to load into `buffer`.
    offset: usize,
    /// Next bits, from the highest.
    buffer: u64,
    /// Number of bits in `buffer`.
    count: u32,
    /// Number of blocks without further coefficients of the band (EOBRUN).
    empty_blocks: u32,
}

impl<'a> Bits<'a> {
    pub(crate) fn new(bytes: &'a [u8], offset: usize) -> Self {
        Self { bytes, offset, buffer: 0, count: 0, empty_blocks: 0 }
    }

    /// Returns an offset after the data that were read, at or before the next marker.
    pub(crate) fn position(&self) -> usize {
        self.offset
    }

    /// Skips a block of a scan with DC; `None` if the data end or a code is invalid.
    pub(crate) fn skip_block(&mut self, band: Band, tables: [Option<&Table>; 2]) -> Option<()> {
        let [dc, ac] = tables;
        let length = match dc {
            Some(dc) => u32::from(self.symbol(dc)?),
            // A refinement scan has one bit per DC coefficient.
            None => 1,
        };
        self.skip(length)?;
        let Some(ac) = ac else { return Some(()) };
        let mut coefficient = 1;
        while coefficient <= band.last {
            match self.run_and_length(ac)? {
                // ZRL: sixteen zeros.
                (15, 0) => coefficient += 16,
                (_, 0) => break,
                (zeros, length) => {
                    self.skip(length)?;
                    coefficient += zeros + 1;
                }
            }
        }
        Some(())
    }

    /// Skips a block of a progressive scan without DC (G.1.2.2 and G.1.2.3). `known` is a bit mask
    /// of the non-zero coefficients; new ones are added.
    pub(crate) fn skip_band(&mut self, band: Band, table: &Table, known: &mut u64) -> Option<()> {
        let mut coefficient = band.first;
        while self.empty_blocks == 0 && coefficient <= band.last {
            let (zeros, length) = self.run_and_length(table)?;
            if length == 0 && zeros < 15 {
                self.empty_blocks = (1 << zeros) + self.bits(zeros)?;
                break;
            }
            self.skip(length)?;
            if band.is_refinement {
                coefficient = self.refine(coefficient, band.last, zeros, *known)?;
            } else {
                coefficient += zeros;
            }
            if length > 0 && coefficient <= band.last {
                *known |= 1 << coefficient;
            }
            coefficient += 1;
        }
        if self.empty_blocks > 0 {
            if band.is_refinement {
                self.refine(coefficient, band.last, u32::MAX, *known)?;
            }
            self.empty_blocks -= 1;
        }
        Some(())
    }

    /// Skips the refinement bits of known coefficients, and returns the coefficient after the given
    /// number of zeros.
    fn refine(&mut self, first: u32, last: u32, mut zeros: u32, known: u64) -> Option<u32> {
        for coefficient in first..=last {
            if known >> coefficient & 1 == 1 {
                self.skip(1)?;
            } else if zeros == 0 {
                return Some(coefficient);
            } else {
                zeros -= 1;
            }
        }
        Some(last + 1)
    }

    /// Resumes after the next restart marker; false if another marker or the end comes first.
    pub(crate) fn restart(&mut self) -> bool {
        (self.buffer, self.count, self.empty_blocks) = (0, 0, 0);
        while let Some([first, second]) = self.bytes.get(self.offset..self.offset + 2) {
            match (first, second) {
                (0xff, marker) if RESTART_MARKERS.contains(marker) => {
                    self.offset += 2;
                    return true;
                }
                (0xff, 1..=0xfe) => return false,
                _ => self.offset += 1,
            }
        }
        false
    }

    fn symbol(&mut self, table: &Table) -> Option<u8> {
        if self.count < MAX_CODE_BITS {
            self.fill();
        }
        let (length, symbol) = table.decode((self.buffer >> (64 - MAX_CODE_BITS)) as u32)?;
        self.skip(length)?;
        Some(symbol)
    }

    /// Reads the number of zeros, and the number of bits of the coefficient after them.
    fn run_and_length(&mut self, table: &Table) -> Option<(u32, u32)> {
        let symbol = self.symbol(table)?;
        Some((u32::from(symbol >> 4), u32::from(symbol & 15)))
    }

    /// Reads a number of fewer than 16 bits.
    fn bits(&mut self, count: u32) -> Option<u32> {
        if self.count < count {
            self.fill();
        }
        let bits = (self.buffer >> 48) as u32 >> (16 - count);
        self.skip(count)?;
        Some(bits)
    }

    fn skip(&mut self, count: u32) -> Option<()> {
        if self.count < count {
            self.fill();
        }
        self.count = self.count.checked_sub(count)?;
        self.buffer = self.buffer.checked_shl(count)?;
        Some(())
    }

    /// Fills the buffer up to the next marker; a 0 after 255 is a stuffed byte, not data.
    fn fill(&mut self) {
        while self.count <= 56 {
            let Some(byte) = self.bytes.get(self.offset) else { return };
            if *byte == 0xff {
                if self.bytes.get(self.offset + 1) != Some(&0) {
                    return;
                }
                self.offset += 1;
            }
            self.offset += 1;
            self.count += 8;
            self.buffer |= u64::from(*byte) << (64 - self.count);
        }
    }
}
