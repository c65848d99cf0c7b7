//! Finds rows without data in a JPEG (ITU-T T.81). The decoder (zune-jpeg) fills such rows with
//! grey, or decodes them more coarsely, without an error.
//!
//! Huffman codes are skipped scan by scan. Like libjpeg, this accepts any bytes after the end
//! marker (EOI). Unlike Pillow, it accepts a sequential JPEG that lacks only the end marker: no
//! pixel is missing. A progressive JPEG needs its end marker, since nothing else determines the
//! number of scans.
//!
//! A file with an invalid segment before the first scan is refused. The decoder ignores an invalid
//! scan header, and any invalid segment after the first scan. Here either ends the image data: a
//! sequential JPEG whose rows are complete by then is accepted.

use std::ops::{Range, RangeInclusive};

use pixels::MAX_PIXELS;

use crate::huffman::{Band, Bits, Table};

/// Marker without a segment, which is skipped.
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

/// Maximum number of scans, zune-jpeg's default.
const MAX_SCANS: usize = 100;
/// Minimum number of zeros at the end of a file that are removed: image data don't end in as many;
/// chosen by hand.
const MIN_PADDING_BYTES: usize = 16;

/// Returns whether zune-jpeg knows a marker.
fn is_known_marker(marker: u8) -> bool {
    matches!(marker, 0xc0..=0xc2 | DHT | 0xcc | 0xd0..=0xdd | 0xe0..=0xe2 | 0xed | 0xee | 0xfe)
}

/// Completeness of a JPEG's image data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Completeness {
    /// Complete data.
    Complete,
    /// Invalid segment before the first scan, or no frame header.
    UnreadableHeader,
    /// Complete rows of a sequential JPEG in which the decoder reaches no end marker. The image
    /// data end at offset `end`.
    Unterminated { end: usize },
    /// Sequential JPEG with `rows` incomplete rows out of `height`.
    Missing { rows: u32, height: u32 },
    /// Progressive JPEG without all detail; `scan` is the first incomplete or the last scan,
    /// counted from 1.
    Coarse { scan: usize, height: u32 },
}

/// Checks the completeness of a JPEG's image data.
pub(crate) fn check_completeness(bytes: &[u8]) -> Completeness {
    let mut walk = Walk { bytes: without_padding(bytes), ..Walk::default() };
    if walk.read_to_end().is_none() && walk.scans == 0 && walk.damaged_scan.is_none() {
        return Completeness::UnreadableHeader;
    }
    walk.completeness().unwrap_or(Completeness::UnreadableHeader)
}

/// Removes zeros at the end, left by an interrupted copy: they would be valid codes.
fn without_padding(bytes: &[u8]) -> &[u8] {
    let end = bytes.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
    if bytes.len() - end < MIN_PADDING_BYTES { bytes } else { &bytes[..end] }
}

/// Frame header (SOF).
struct Frame {
    is_progressive: bool,
    width: u32,
    height: u32,
    components: Vec<Component>,
}

struct Component {
    id: u8,
    /// Sampling factors: blocks of an MCU along x and y.
    factors: [u32; 2],
    /// Number of incomplete image rows; `None` before the component's first scan.
    missing: Option<u32>,
    /// Mask of each block's non-zero coefficients, one bit per coefficient; only for a progressive
    /// JPEG.
    coefficients: Vec<u64>,
}

/// Component of a scan (SOS).
struct Part {
    /// Index of the component in the frame.
    component: usize,
    /// Indices of the tables for DC and AC coefficients.
    tables: [usize; 2],
}

/// Reader of a file's segments and scans.
#[derive(Default)]
struct Walk<'a> {
    bytes: &'a [u8],
    /// Offset of the next byte to read.
    offset: usize,
    frame: Option<Frame>,
    /// Tables for DC and for AC coefficients, by index.
    tables: [[Option<Table>; 4]; 2],
    /// Number of MCUs between restart markers; 0 without restart markers.
    restart_interval: usize,
    scans: usize,
    /// First incomplete scan, counted from 1.
    damaged_scan: Option<usize>,
    /// Offset of the marker after the last scan, or length of the file.
    end: usize,
    /// True after the end marker.
    is_terminated: bool,
}

impl<'a> Walk<'a> {
    /// Reads up to the end marker or the end of the file; `None` at an invalid segment.
    fn read_to_end(&mut self) -> Option<()> {
        while let Some(marker) = self.next_marker() {
            if marker == EOI {
                self.is_terminated = true;
                break;
            }
            if matches!(marker, SOI | TEM) || RESTART_MARKERS.contains(&marker) {
                continue;
            }
            let Some(segment) = self.segment() else { break };
            match marker {
                DHT => self.read_tables(segment)?,
                DRI => self.restart_interval = usize::from(u16_at(segment, 0)?),
                SOF_BASELINE | SOF_EXTENDED | SOF_PROGRESSIVE if self.frame.is_none() => {
                    self.frame = Some(parse_frame(segment, marker == SOF_PROGRESSIVE)?);
                }
                SOF_BASELINE | SOF_EXTENDED | SOF_PROGRESSIVE => return None,
                SOS if self.scans == MAX_SCANS => return None,
                SOS => {
                    self.read_scan(segment)?;
                    self.end_scan()?;
                }
                _ => {}
            }
        }
        Some(())
    }

    /// Finds the next marker; skips other bytes.
    fn next_marker(&mut self) -> Option<u8> {
        while let Some([first, second]) = self.bytes.get(self.offset..self.offset + 2) {
            if let (0xff, 1..=0xfe) = (first, second) {
                self.offset += 2;
                return Some(*second);
            }
            self.offset += 1;
        }
        None
    }

    /// Reads the segment after a marker, without its length; `None` if the file ends first.
    fn segment(&mut self) -> Option<&'a [u8]> {
        let length = usize::from(u16_at(self.bytes, self.offset)?).max(2);
        let segment = self.bytes.get(self.offset + 2..self.offset + length)?;
        self.offset += length;
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

    /// Skips a scan, and counts its incomplete rows.
    fn read_scan(&mut self, segment: &[u8]) -> Option<()> {
        let frame = self.frame.as_mut()?;
        let Some((parts, band)) = parse_scan(segment, frame) else {
            // The decoder renders something even so.
            self.damaged_scan.get_or_insert(self.scans + 1);
            return None;
        };
        let single = if let [part] = &parts[..] { Some(part.component) } else { None };
        let grid = Grid::new(frame, single);
        let mut bits = Bits::new(self.bytes, self.offset);
        let missing = if band.first == 0 {
            let blocks = block_tables(&parts, frame, &self.tables, band)?;
            grid.incomplete_rows(&mut bits, self.restart_interval, |bits, _| {
                for tables in &blocks {
                    bits.skip_block(band, *tables)?;
                }
                Some(())
            })
        } else {
            let component = &mut frame.components[single?];
            let table = self.tables[1].get(parts[0].tables[1])?.as_ref()?;
            component.coefficients.resize(grid.mcu_count(), 0);
            let known = &mut component.coefficients;
            grid.incomplete_rows(&mut bits, self.restart_interval, |bits, block| {
                bits.skip_band(band, table, &mut known[block])
            })
        };
        self.offset = bits.position();
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

    /// Finds the end of a scan. `None` if the decoder doesn't know the next marker: it would drop
    /// the image data that it has read ahead.
    fn end_scan(&mut self) -> Option<()> {
        let offset = self.offset;
        let marker = self.next_marker();
        self.end = if marker.is_some() { self.offset - 2 } else { self.bytes.len() };
        self.offset = offset;
        marker.is_none_or(is_known_marker).then_some(())
    }

    /// Returns the completeness of a file that ends here; `None` without a frame.
    fn completeness(&self) -> Option<Completeness> {
        let Frame { is_progressive, height, components, .. } = self.frame.as_ref()?;
        let missing = components.iter().map(|c| c.missing.unwrap_or(*height)).max()?;
        Some(match (missing, self.is_terminated) {
            (0, true) => Completeness::Complete,
            _ if *is_progressive => {
                let scan = self.damaged_scan.unwrap_or(self.scans.max(1));
                Completeness::Coarse { scan, height: *height }
            }
            (0, false) => Completeness::Unterminated { end: self.end },
            (rows, _) => Completeness::Missing { rows, height: *height },
        })
    }
}

/// DC and AC table of a block, if the scan has these coefficients.
type Tables<'a> = [Option<&'a Table>; 2];

/// Returns the tables of each block of an MCU; `None` if a table is missing.
fn block_tables<'a>(
    parts: &[Part],
    frame: &Frame,
    tables: &'a [[Option<Table>; 4]; 2],
    band: Band,
) -> Option<Vec<Tables<'a>>> {
    let mut blocks = Vec::new();
    for Part { component, tables: [dc, ac] } in parts {
        let [across, down] = frame.components[*component].factors;
        let count = if parts.len() == 1 { 1 } else { across * down };
        let dc = if band.is_refinement { None } else { Some(tables[0].get(*dc)?.as_ref()?) };
        let ac = if band.last > 0 { Some(tables[1].get(*ac)?.as_ref()?) } else { None };
        blocks.extend((0..count).map(|_| [dc, ac]));
    }
    Some(blocks)
}

/// Grid of a scan's MCUs.
struct Grid {
    columns: usize,
    rows: usize,
    /// Number of image rows per MCU.
    rows_per_mcu: usize,
    height: usize,
}

impl Grid {
    /// Creates the grid of all components, or of the single component of a scan.
    fn new(frame: &Frame, single: Option<usize>) -> Self {
        let [across, down] =
            [0, 1].map(|axis| frame.components.iter().map(|c| c.factors[axis]).max().unwrap_or(1));
        let (columns, rows, rows_per_mcu) = match single {
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

    fn mcu_count(&self) -> usize {
        self.columns * self.rows
    }

    /// Counts incomplete image rows; `skip` skips an MCU, and returns `None` if the data end.
    fn incomplete_rows(
        &self,
        bits: &mut Bits<'_>,
        restart_interval: usize,
        mut skip: impl FnMut(&mut Bits<'_>, usize) -> Option<()>,
    ) -> u32 {
        let all = self.mcu_count();
        let interval = if restart_interval == 0 { all } else { restart_interval };
        // Rows of MCUs below `rows_counted` are already counted.
        let (mut mcu, mut rows_counted, mut missing) = (0, 0, 0);
        while mcu < all {
            let mut end = all.min(mcu + interval);
            while mcu < end && skip(bits, mcu).is_some() {
                mcu += 1;
            }
            // Without the next restart marker, the rest of the scan is lost.
            if end < all && !bits.restart() {
                end = all;
            }
            if mcu < end {
                let rows = rows_counted.max(mcu / self.columns)..end.div_ceil(self.columns);
                rows_counted = rows.end;
                missing += self.image_rows(rows);
            }
            mcu = end;
        }
        missing
    }

    /// Returns the number of image rows in rows of MCUs.
    fn image_rows(&self, rows: Range<usize>) -> u32 {
        let [first, end] =
            [rows.start, rows.end].map(|row| self.height.min(row * self.rows_per_mcu));
        end.saturating_sub(first) as u32
    }
}

/// Parses a frame header; `None` if it is invalid or the image too large.
fn parse_frame(segment: &[u8], is_progressive: bool) -> Option<Frame> {
    let (height, width) = (u32::from(u16_at(segment, 1)?), u32::from(u16_at(segment, 3)?));
    let mut components = Vec::new();
    for [id, factors, _] in segment.get(6..)?.as_chunks().0 {
        let factors = [u32::from(factors >> 4), u32::from(factors & 15)];
        if factors.contains(&0) {
            return None;
        }
        components.push(Component { id: *id, factors, missing: None, coefficients: Vec::new() });
    }
    let is_valid = components.len() == usize::from(segment[5])
        && u64::from(width) * u64::from(height) <= MAX_PIXELS as u64;
    is_valid.then_some(Frame { is_progressive, width, height, components })
}

/// Parses a scan header (SOS): components and coefficients.
fn parse_scan(segment: &[u8], frame: &Frame) -> Option<(Vec<Part>, Band)> {
    let (count, rest) = segment.split_first()?;
    let (listed, rest) = rest.split_at_checked(2 * usize::from(*count))?;
    let mut parts = Vec::with_capacity(usize::from(*count));
    for [id, tables] in listed.as_chunks().0 {
        let component = frame.components.iter().position(|component| component.id == *id)?;
        parts.push(Part { component, tables: [tables >> 4, tables & 15].map(usize::from) });
    }
    let band = if frame.is_progressive { Band::read(rest)? } else { Band::ALL };
    (!parts.is_empty()).then_some((parts, band))
}

fn u16_at(bytes: &[u8], offset: usize) -> Option<u16> {
    Some(u16::from_be_bytes(*bytes.get(offset..)?.first_chunk()?))
}

#[cfg(test)]
#[path = "jpeg_tests.rs"]
pub(crate) mod tests;
