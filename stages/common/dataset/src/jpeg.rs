//! Finds rows that a JPEG has no data for (ITU-T T.81). The decoder fills such rows with grey, or
//! shows them coarser, without an error.
//!
//! Scans are walked by their Huffman codes. Like libjpeg, this accepts any bytes after the end marker
//! (EOI). Unlike Pillow, it accepts a sequential JPEG that lacks the end marker alone: no pixel is
//! missing. A progressive JPEG needs its end marker, since nothing else tells how many scans there
//! should be.
//!
//! A header that can't be parsed is left to the decoder, whose message names it. After the first
//! scan it is damage: there the decoder goes on with what it has.

use std::ops::{Range, RangeInclusive};

use pixels::MAX_PIXELS;

use crate::huffman::{Band, Bits, Table};

/// A marker without a meaning.
const TEM: u8 = 0x01;
const SOF_BASELINE: u8 = 0xc0;
const SOF_EXTENDED: u8 = 0xc1;
const SOF_PROGRESSIVE: u8 = 0xc2;
const DHT: u8 = 0xc4;
pub(crate) const RESTART_MARKERS: RangeInclusive<u8> = 0xd0..=0xd7;
const SOI: u8 = 0xd8;
const EOI: u8 = 0xd9;
pub(crate) const END_MARKER: [u8; 2] = [0xff, EOI];
const SOS: u8 = 0xda;
const DRI: u8 = 0xdd;

/// Maximum number of scans, which is the decoder's own.
const MAX_SCANS: usize = 100;
/// Number of zeros at the end of a file that can't be image data.
const MIN_FILLING_BYTES: usize = 16;

/// Extent of a JPEG's image data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Extent {
    /// All data, or a file that the decoder refuses.
    Whole,
    /// All rows; the end marker is missing.
    Unterminated,
    /// Rows without all of their data.
    Missing {
        /// Number of these rows.
        rows: u32,
        /// Number of rows of the image.
        of: u32,
    },
    /// A progressive JPEG that lacks data: rows lack detail.
    Coarse {
        /// Number of the scan that lacks data or is the last one, counted from 1.
        scan: usize,
        /// Number of rows of the image.
        rows: u32,
    },
}

/// Finds how much of its image data a JPEG has.
pub(crate) fn extent(bytes: &[u8]) -> Extent {
    let mut walk = Walk { bytes: without_filling(bytes), ..Walk::default() };
    let is_terminated = walk.read_to_end();
    if is_terminated.is_none() && walk.scans == 0 {
        return Extent::Whole;
    }
    walk.extent(is_terminated == Some(true)).unwrap_or(Extent::Whole)
}

/// Cuts off zeros that an interrupted copy has in place of the rest: they would be valid codes.
fn without_filling(bytes: &[u8]) -> &[u8] {
    let end = bytes.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
    if bytes.len() - end < MIN_FILLING_BYTES { bytes } else { &bytes[..end] }
}

/// Header of the frame (SOF).
struct Frame {
    is_progressive: bool,
    width: u32,
    height: u32,
    components: Vec<Component>,
}

struct Component {
    id: u8,
    /// Sampling factors: blocks of an MCU along a row and a column.
    factors: [u32; 2],
    /// Number of image rows without all of their data; `None` before the component's scan.
    missing: Option<u32>,
    /// For each block of a progressive JPEG, a bit for each coefficient that isn't 0.
    coefficients: Vec<u64>,
}

/// A component's part in a scan (SOS).
struct Part {
    /// Index in the frame.
    component: usize,
    /// Numbers of the tables for DC and AC coefficients.
    tables: [usize; 2],
}

/// A walk through a file's segments and scans.
#[derive(Default)]
struct Walk<'a> {
    bytes: &'a [u8],
    at: usize,
    frame: Option<Frame>,
    /// Tables for DC and for AC coefficients, by number.
    tables: [[Option<Table>; 4]; 2],
    /// Number of MCUs between restart markers; 0 without such markers.
    restart_interval: usize,
    scans: usize,
    /// Number of the first scan that lacks data, counted from 1.
    damaged_scan: Option<usize>,
}

impl<'a> Walk<'a> {
    /// Walks to the end marker, or to the end of the file (false); `None` where a segment can't be
    /// parsed.
    fn read_to_end(&mut self) -> Option<bool> {
        loop {
            let marker = match self.next_marker() {
                Some(EOI) => return Some(true),
                Some(SOI | TEM) => continue,
                Some(marker) if RESTART_MARKERS.contains(&marker) => continue,
                Some(marker) => marker,
                None => return Some(false),
            };
            let Some(segment) = self.segment() else { return Some(false) };
            match marker {
                DHT => self.read_tables(segment)?,
                DRI => self.restart_interval = usize::from(u16_at(segment, 0)?),
                SOF_BASELINE | SOF_EXTENDED | SOF_PROGRESSIVE if self.frame.is_none() => {
                    self.frame = Some(frame(segment, marker == SOF_PROGRESSIVE)?);
                }
                SOF_BASELINE | SOF_EXTENDED | SOF_PROGRESSIVE => return None,
                SOS if self.scans == MAX_SCANS => return None,
                SOS => self.read_scan(segment)?,
                _ => {}
            }
        }
    }

    /// Finds the next marker, past anything else.
    fn next_marker(&mut self) -> Option<u8> {
        while let Some([first, second]) = self.bytes.get(self.at..self.at + 2) {
            if let (0xff, 1..=0xfe) = (first, second) {
                self.at += 2;
                return Some(*second);
            }
            self.at += 1;
        }
        None
    }

    /// Takes the segment after a marker, without its length; `None` where the file ends first.
    fn segment(&mut self) -> Option<&'a [u8]> {
        let length = usize::from(u16_at(self.bytes, self.at)?).max(2);
        let segment = self.bytes.get(self.at + 2..self.at + length)?;
        self.at += length;
        Some(segment)
    }

    fn read_tables(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((which, rest)) = segment.split_first() {
            let (table, rest) = Table::read(rest)?;
            *self.tables.get_mut(usize::from(which >> 4))?.get_mut(usize::from(which & 15))? =
                Some(table);
            segment = rest;
        }
        Some(())
    }

    /// Walks a scan.
    fn read_scan(&mut self, segment: &[u8]) -> Option<()> {
        let frame = self.frame.as_mut()?;
        let (parts, rest) = parts(segment, frame)?;
        let band = if frame.is_progressive { Band::read(rest)? } else { Band::ALL };
        let alone = if let [part] = &parts[..] { Some(part.component) } else { None };
        let grid = Grid::new(frame, alone);
        let mut bits = Bits::new(self.bytes, self.at);
        let missing = if band.has_dc() {
            let blocks = blocks(&parts, frame, &self.tables, band)?;
            grid.missing_rows(&mut bits, self.restart_interval, |bits, _| {
                blocks.iter().try_for_each(|tables| bits.skip_block(band, *tables))
            })
        } else {
            let component = &mut frame.components[alone?];
            let table = self.tables[1].get(parts[0].tables[1])?.as_ref()?;
            component.coefficients.resize(grid.mcus(), 0);
            let known = &mut component.coefficients;
            grid.missing_rows(&mut bits, self.restart_interval, |bits, block| {
                bits.skip_band(band, table, &mut known[block])
            })
        };
        self.at = bits.position();
        self.scans += 1;
        if missing > 0 {
            self.damaged_scan.get_or_insert(self.scans);
        }
        for part in &parts {
            let component = &mut frame.components[part.component];
            component.missing = Some(missing.max(component.missing.unwrap_or(0)));
        }
        Some(())
    }

    /// Returns the extent of a file that ends here, with or without the end marker; `None` without
    /// a frame.
    fn extent(&self, is_terminated: bool) -> Option<Extent> {
        let Frame { is_progressive, height, components, .. } = self.frame.as_ref()?;
        let missing = components.iter().map(|c| c.missing.unwrap_or(*height)).max()?;
        Some(match (missing, is_terminated) {
            (0, true) => Extent::Whole,
            _ if *is_progressive => {
                Extent::Coarse { scan: self.damaged_scan.unwrap_or(self.scans), rows: *height }
            }
            (0, false) => Extent::Unterminated,
            (rows, _) => Extent::Missing { rows, of: *height },
        })
    }
}

/// Tables of the blocks of an MCU (DC, AC), as far as a scan has these coefficients.
type Tables<'a> = [Option<&'a Table>; 2];

/// Returns the tables of each block of an MCU; `None` where a table is missing.
fn blocks<'a>(
    parts: &[Part],
    frame: &Frame,
    tables: &'a [[Option<Table>; 4]; 2],
    band: Band,
) -> Option<Vec<Tables<'a>>> {
    let mut blocks = Vec::new();
    for Part { component, tables: [dc, ac] } in parts {
        let [across, down] = frame.components[*component].factors;
        let count = if parts.len() == 1 { 1 } else { across * down };
        let dc = if band.is_refinement() { None } else { Some(tables[0].get(*dc)?.as_ref()?) };
        let ac = if band.has_ac() { Some(tables[1].get(*ac)?.as_ref()?) } else { None };
        blocks.extend((0..count).map(|_| [dc, ac]));
    }
    Some(blocks)
}

/// MCUs of a scan.
struct Grid {
    columns: usize,
    rows: usize,
    /// Image rows of an MCU.
    rows_per_mcu: usize,
    height: usize,
}

impl Grid {
    /// Creates the grid of all components together, or of one that is alone in its scan.
    fn new(frame: &Frame, alone: Option<usize>) -> Self {
        let most =
            |axis: usize| frame.components.iter().map(|c| c.factors[axis]).max().unwrap_or(1);
        let [across, down] = [most(0), most(1)];
        let (columns, rows, rows_per_mcu) = match alone {
            None => (frame.width.div_ceil(8 * across), frame.height.div_ceil(8 * down), 8 * down),
            Some(component) => {
                let [own_across, own_down] = frame.components[component].factors;
                (
                    (frame.width * own_across).div_ceil(across).div_ceil(8),
                    (frame.height * own_down).div_ceil(down).div_ceil(8),
                    8 * down / own_down,
                )
            }
        };
        let [columns, rows, rows_per_mcu, height] =
            [columns, rows, rows_per_mcu, frame.height].map(|length| length as usize);
        Self { columns, rows, rows_per_mcu, height }
    }

    fn mcus(&self) -> usize {
        self.columns * self.rows
    }

    /// Counts image rows without all of their data; `skip` skips an MCU, `None` where data end.
    fn missing_rows(
        &self,
        bits: &mut Bits<'_>,
        restart_interval: usize,
        mut skip: impl FnMut(&mut Bits<'_>, usize) -> Option<()>,
    ) -> u32 {
        let all = self.mcus();
        let interval = if restart_interval == 0 { all } else { restart_interval };
        let (mut mcu, mut counted, mut missing) = (0, 0, 0);
        while mcu < all {
            let mut end = all.min(mcu + interval);
            while mcu < end && skip(bits, mcu).is_some() {
                mcu += 1;
            }
            if end < all && !bits.restart() {
                end = all;
            }
            if mcu < end {
                let rows = counted.max(mcu / self.columns)..end.div_ceil(self.columns);
                counted = rows.end;
                missing += self.image_rows(rows);
            }
            mcu = end;
        }
        missing
    }

    /// Number of image rows in rows of MCUs.
    fn image_rows(&self, rows: Range<usize>) -> u32 {
        let [first, end] =
            [rows.start, rows.end].map(|row| self.height.min(row * self.rows_per_mcu));
        end.saturating_sub(first) as u32
    }
}

fn frame(segment: &[u8], is_progressive: bool) -> Option<Frame> {
    let (height, width) = (u32::from(u16_at(segment, 1)?), u32::from(u16_at(segment, 3)?));
    let mut components = Vec::new();
    for [id, factors, _] in segment.get(6..)?.as_chunks().0 {
        let factors = [u32::from(factors >> 4), u32::from(factors & 15)];
        if factors.contains(&0) {
            return None;
        }
        components.push(Component { id: *id, factors, missing: None, coefficients: Vec::new() });
    }
    let is_read = components.len() == usize::from(segment[5])
        && u64::from(width) * u64::from(height) <= MAX_PIXELS as u64;
    is_read.then_some(Frame { is_progressive, width, height, components })
}

/// Parses the components of a scan, and returns the rest of its header.
fn parts<'a>(segment: &'a [u8], frame: &Frame) -> Option<(Vec<Part>, &'a [u8])> {
    let (count, rest) = segment.split_first()?;
    let (listed, rest) = rest.split_at_checked(2 * usize::from(*count))?;
    let mut parts = Vec::with_capacity(usize::from(*count));
    for [id, tables] in listed.as_chunks().0 {
        let component = frame.components.iter().position(|component| component.id == *id)?;
        parts.push(Part { component, tables: [tables >> 4, tables & 15].map(usize::from) });
    }
    (!parts.is_empty()).then_some((parts, rest))
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes(*bytes.get(at..)?.first_chunk()?))
}

#[cfg(test)]
#[path = "jpeg_tests.rs"]
pub(crate) mod tests;
