//! Uniform strips at the sides of images, as undistortion and letterboxing leave them.

use std::fmt::{self, Display, Formatter};

use pixels::{Mask, Rgba8};

/// Levels by which a strip's colour may vary: JPEG rings next to the photograph.
const MAX_NOISE_LEVELS: u8 = 16;
/// Percentage of a line's pixels that have a strip's colour.
const MIN_FLAT_PERCENT: usize = 95;
/// Maximum percentage of pixels with the strip's colour right inside a strip. Beside an object on a
/// background there are more.
const MAX_INSIDE_PERCENT: usize = 50;
/// Lines that interpolation blends at a strip's edge.
const BLENDED_LINES: usize = 1;
/// Maximum part of a side that a strip takes, as its denominator, where all four sides have one:
/// objects on a background have wider margins.
const FRAME_PART: usize = 5;
/// Maximum part of a side, as its denominator, where other sides have no strip: upright photographs
/// in a wide format have wide ones.
const PAIR_PART: usize = 2;
/// Pixels by which a strip's width may differ between views.
const MAX_WIDTH_DIFFERENCE: usize = 1;

/// Widths of an image's uniform strips in pixels: top, right, bottom, left.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Strips {
    pub(crate) widths: [usize; 4],
    pub(crate) colour: [u8; 3],
}

const SIDES: [&str; 4] = ["top", "right", "bottom", "left"];

impl Strips {
    /// Finds the strips of an opaque image.
    pub(crate) fn of(image: &Rgba8) -> Option<Self> {
        let colours = [0, 1, 2, 3].map(|side| flat_colour(&line(image, side, 0, [0, 0])));
        let mut widths = [0; 4];
        for (side, colour) in colours.iter().enumerate() {
            let Some(colour) = colour else { continue };
            let (length, limit) = (depth(image, side), depth(image, side) / PAIR_PART);
            let is_strip = |at: &usize| is_flat(&line(image, side, *at, [0, 0]), *colour);
            let width = (0..length).take_while(is_strip).count();
            widths[side] = if width < limit { width } else { 0 };
        }
        for (side, colour) in colours.iter().enumerate() {
            let Some(colour) = colour.filter(|_| widths[side] > 0) else { continue };
            let [top, right, bottom, left] = widths;
            let ends = if side.is_multiple_of(2) { [left, right] } else { [top, bottom] };
            let inside = line(image, side, widths[side] + BLENDED_LINES, ends);
            let alike = inside.iter().filter(|pixel| is_like(**pixel, colour)).count();
            if inside.is_empty() || 100 * alike > MAX_INSIDE_PERCENT * inside.len() {
                return None;
            }
        }
        let is_frame = widths.iter().all(|width| *width > 0);
        let is_wide = (0..4).any(|side| FRAME_PART * widths[side] > depth(image, side));
        let first = (0..4).find(|side| widths[*side] > 0)?;
        let colour = colours[first]?;
        (!(is_frame && is_wide)).then_some(Self { widths, colour })
    }

    /// Returns the strips that nine in ten views have in common, and the number of these views.
    pub(crate) fn common(views: &[Option<Self>]) -> Option<(Self, usize)> {
        let found: Vec<Self> = views.iter().flatten().copied().collect();
        let middle = |side: usize| {
            let mut widths: Vec<usize> = found.iter().map(|strips| strips.widths[side]).collect();
            widths.sort_unstable();
            widths.get(widths.len() / 2).copied().unwrap_or(0)
        };
        let widths = [0, 1, 2, 3].map(middle);
        let has_these = |strips: &&Self| {
            (0..4).all(|side| {
                let is_strip = (strips.widths[side] > 0) == (widths[side] > 0);
                is_strip && strips.widths[side].abs_diff(widths[side]) <= MAX_WIDTH_DIFFERENCE
            })
        };
        let first = found.iter().find(has_these)?;
        let count = found.iter().filter(has_these).count();
        (10 * count >= 9 * views.len()).then_some((Self { widths, ..*first }, count))
    }

    /// True if strips are on all four sides, so that borders look like a background.
    pub(crate) fn is_frame(&self) -> bool {
        self.widths.iter().all(|width| *width > 0)
    }

    /// True if a mask leaves the strips out.
    pub(crate) fn are_masked(&self, mask: &Mask) -> bool {
        let [top, right, bottom, left] = self.widths;
        let (columns, rows) = (left..mask.width - right, top..mask.height - bottom);
        (0..mask.counts.len())
            .filter(|at| {
                !(columns.contains(&(at % mask.width)) && rows.contains(&(at / mask.width)))
            })
            .all(|at| !mask.counts[at])
    }
}

/// Names the colour and the sides that have a strip.
impl Display for Strips {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let sides = (0..4).filter(|side| self.widths[*side] > 0);
        let sides: Vec<String> =
            sides.map(|side| format!("{} {}", SIDES[side], self.widths[side])).collect();
        let [r, g, b] = self.colour;
        let sides = sides.join(", ");
        write!(f, "uniform strips at the border (colour {r} {g} {b}; {sides} pixels)")
    }
}

/// Lines from a side to the opposite one.
fn depth(image: &Rgba8, side: usize) -> usize {
    if side.is_multiple_of(2) { image.height } else { image.width }
}

/// Returns the colours of a line parallel to a side, without some pixels at its ends (left and
/// right, or top and bottom).
fn line(image: &Rgba8, side: usize, at: usize, ends: [usize; 2]) -> Vec<[u8; 3]> {
    let (across, along) = (depth(image, side), depth(image, side + 1));
    if at >= across {
        return Vec::new();
    }
    let at = if side == 1 || side == 2 { across - 1 - at } else { at };
    let pixel = |i: usize| {
        let (x, y) = if side.is_multiple_of(2) { (i, at) } else { (at, i) };
        std::array::from_fn(|c| image.data[4 * (y * image.width + x) + c])
    };
    (ends[0]..along.saturating_sub(ends[1])).map(pixel).collect()
}

/// Returns the colour of a line that has one.
fn flat_colour(line: &[[u8; 3]]) -> Option<[u8; 3]> {
    let mut middle = [0; 3];
    for (c, value) in middle.iter_mut().enumerate() {
        let mut values: Vec<u8> = line.iter().map(|colour| colour[c]).collect();
        values.sort_unstable();
        *value = *values.get(values.len() / 2)?;
    }
    is_flat(line, middle).then_some(middle)
}

fn is_flat(line: &[[u8; 3]], colour: [u8; 3]) -> bool {
    let alike = line.iter().filter(|pixel| is_like(**pixel, colour)).count();
    !line.is_empty() && 100 * alike >= MIN_FLAT_PERCENT * line.len()
}

fn is_like(colour: [u8; 3], other: [u8; 3]) -> bool {
    (0..3).all(|c| colour[c].abs_diff(other[c]) <= MAX_NOISE_LEVELS)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A photograph of 40×30 pixels with strips of some widths.
    fn photograph(widths: [usize; 4], strip: [u8; 3], seed: usize) -> Rgba8 {
        let [top, right, bottom, left] = widths;
        let pixel = |i: usize| {
            let (x, y) = (i % 40, i / 40);
            let is_inside = (left..40 - right).contains(&x) && (top..30 - bottom).contains(&y);
            let texture = [90 + 3 * x + 5 * seed, 40 + 6 * y, 60 + (x * y + 7 * seed) % 90];
            let [r, g, b] = if is_inside { texture.map(|v| v as u8) } else { strip };
            [r, g, b, u8::MAX]
        };
        Rgba8::new(40, 30, (0..40 * 30).flat_map(pixel).collect())
    }

    fn views(widths: [usize; 4], strip: [u8; 3], count: usize) -> Vec<Option<Strips>> {
        (0..count).map(|seed| Strips::of(&photograph(widths, strip, seed))).collect()
    }

    #[test]
    fn widths_are_measured_on_each_side() {
        for widths in [[3, 3, 3, 3], [1, 2, 3, 4], [6, 0, 6, 0], [0, 13, 0, 13], [0, 0, 2, 0]] {
            for colour in [[0; 3], [255; 3], [4, 0, 9]] {
                let found = Strips::common(&views(widths, colour, 10));
                assert_eq!(found, Some((Strips { widths, colour }, 10)), "{widths:?} {colour:?}");
            }
        }
        assert_eq!(Strips::common(&views([0; 4], [0; 3], 10)), None);
        let shown = Strips { widths: [6, 0, 6, 0], colour: [0; 3] }.to_string();
        assert_eq!(shown, "uniform strips at the border (colour 0 0 0; top 6, bottom 6 pixels)");
    }

    /// Nine in ten views have to have the same strips; a wide frame is rather an object's margin.
    #[test]
    fn margins_of_objects_are_no_strips() {
        let mut all = views([3; 4], [0; 3], 9);
        all.push(None);
        assert!(Strips::common(&all).is_some());
        all.push(None);
        assert_eq!(Strips::common(&all), None);
        let varied: Vec<_> = (1..6).flat_map(|w| views([w, 3, 3, 3], [0; 3], 2)).collect();
        assert_eq!(Strips::common(&varied), None);
        assert_eq!(Strips::of(&photograph([9; 4], [0; 3], 0)), None);
        // A disc on black: little of it is near its bounding box.
        let disc = |i: usize| {
            let (x, y) = ((i % 40) as f64 - 19.5, (i / 40) as f64 - 14.5);
            if x * x / 1.8 + y * y < 150.0 { [200, 90, 40, 255] } else { [0, 0, 0, 255] }
        };
        let disc = Rgba8::new(40, 30, (0..40 * 30).flat_map(disc).collect());
        assert_eq!(Strips::of(&disc), None);
        let flat = Rgba8::new(4, 3, [7, 7, 7, 255].repeat(12));
        assert_eq!(Strips::of(&flat), None);
    }

    #[test]
    fn masks_leave_strips_out() {
        let strips = Strips { widths: [1, 2, 0, 0], colour: [0; 3] };
        let counts = |from: &[&str]| Mask {
            width: 4,
            height: 3,
            counts: from.iter().flat_map(|row| row.bytes().map(|b| b == b'#')).collect(),
        };
        assert!(strips.are_masked(&counts(&["....", "##..", "##.."])));
        assert!(!strips.are_masked(&counts(&["#...", "##..", "##.."])));
        assert!(!strips.are_masked(&counts(&["....", "###.", "##.."])));
    }
}
