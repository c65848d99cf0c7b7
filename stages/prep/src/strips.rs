//! Detects uniform strips at the sides of images, left by undistortion or letterboxing
//! (docs/design/005). Thresholds are chosen by hand.

use std::fmt::{self, Display, Formatter};

use pixels::{Mask, Rgba8, count_similar, medians};

/// Maximum deviation of a strip's colour in 8-bit levels: JPEG rings next to the photograph.
const MAX_STRIP_NOISE: u8 = 16;
/// Minimum percentage of a line's pixels that have the strip's colour.
const MIN_FLAT_PERCENT: usize = 95;
/// Maximum percentage of pixels with the strip's colour in the line next to a strip, and in the
/// corners inside all strips. An object on a background exceeds it: its corners are empty.
const MAX_INSIDE_PERCENT: usize = 50;
/// Ratio of the image's side inside the strips to the side of a corner.
const CORNER_DIVISOR: usize = 8;
/// Number of lines that interpolation blends at a strip's edge.
const BLENDED_LINES: usize = 1;
/// Minimum ratio of an image's side to a strip's width if all four sides have a strip: margins
/// around objects on a background are wider.
const MIN_FRAME_RATIO: usize = 5;
/// Ratio that an image's side over any strip's width must exceed. It is small, since upright
/// photographs in a wide format have wide strips.
const MIN_RATIO: usize = 2;

/// Uniform strips of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Strips {
    /// Widths in pixels: top, right, bottom, left.
    pub(crate) widths: [usize; 4],
    /// Colour of the first side that has a strip.
    pub(crate) colour: [u8; 3],
}

const SIDES: [&str; 4] = ["top", "right", "bottom", "left"];

impl Strips {
    /// Finds the strips of an opaque image; `None` without any.
    pub(crate) fn of(image: &Rgba8) -> Option<Self> {
        let colours = [0, 1, 2, 3].map(|side| flat_colour(&line(image, side, 0, [0, 0])));
        let mut widths = [0; 4];
        for (side, colour) in colours.iter().enumerate() {
            let Some(colour) = colour else { continue };
            let count = line_count(image, side);
            let width =
                (0..count).take_while(|i| is_flat(&line(image, side, *i, [0, 0]), *colour)).count();
            widths[side] = if MIN_RATIO * width < count { width } else { 0 };
        }
        for (side, colour) in colours.iter().enumerate() {
            let Some(colour) = colour.filter(|_| widths[side] > 0) else { continue };
            let [top, right, bottom, left] = widths;
            let ends = if side.is_multiple_of(2) { [left, right] } else { [top, bottom] };
            let inside = line(image, side, widths[side] + BLENDED_LINES, ends);
            if !is_content(&inside, colour) || !is_content(&corners(image, widths), colour) {
                return None;
            }
        }
        let first = (0..4).find(|side| widths[*side] > 0)?;
        let strips = Self { widths, colour: colours[first]? };
        let is_wide = (0..4).any(|side| MIN_FRAME_RATIO * widths[side] > line_count(image, side));
        (!(strips.is_frame() && is_wide)).then_some(strips)
    }

    /// Returns the strips that nine in ten views have on the same sides, with median widths, and
    /// the number of views that have them.
    pub(crate) fn common(views: &[Option<Self>]) -> Option<(Self, usize)> {
        let found: Vec<Self> = views.iter().flatten().copied().collect();
        let widths = medians(&found.iter().map(|strips| strips.widths).collect::<Vec<_>>());
        let sides = widths.map(|width| width > 0);
        let mut same = found.iter().filter(|strips| strips.widths.map(|width| width > 0) == sides);
        let first = same.next()?;
        let count = 1 + same.count();
        (10 * count >= 9 * views.len()).then_some((Self { widths, ..*first }, count))
    }

    /// True if all four sides have strips, which resemble a background.
    pub(crate) fn is_frame(&self) -> bool {
        self.widths.iter().all(|width| *width > 0)
    }

    /// True if a mask excludes all pixels of the strips.
    pub(crate) fn are_masked(&self, mask: &Mask) -> bool {
        let [top, right, bottom, left] = self.widths;
        let (columns, rows) = (left..mask.width - right, top..mask.height - bottom);
        (0..mask.counts.len()).all(|i| {
            let is_inside = columns.contains(&(i % mask.width)) && rows.contains(&(i / mask.width));
            is_inside || !mask.counts[i]
        })
    }
}

/// Formats the colour and the widths of the sides that have a strip.
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

/// Returns the number of lines parallel to a side.
fn line_count(image: &Rgba8, side: usize) -> usize {
    if side.is_multiple_of(2) { image.height } else { image.width }
}

/// Returns the colours of line `index` parallel to a side, counted from that side, without
/// `ends` pixels at its left and right, or top and bottom.
fn line(image: &Rgba8, side: usize, index: usize, ends: [usize; 2]) -> Vec<[u8; 3]> {
    let count = line_count(image, side);
    if index >= count {
        return Vec::new();
    }
    let index = if side == 1 || side == 2 { count - 1 - index } else { index };
    let pixels = ends[0]..line_count(image, side + 1).saturating_sub(ends[1]);
    if side.is_multiple_of(2) {
        pixels.map(|x| image.colour(x, index)).collect()
    } else {
        pixels.map(|y| image.colour(index, y)).collect()
    }
}

/// Returns the indices near both ends of a row or column inside strips.
fn corner_indices(first: usize, end: usize) -> impl Iterator<Item = usize> {
    let (first, end) = (first + BLENDED_LINES, end.saturating_sub(BLENDED_LINES));
    let length = (end.saturating_sub(first) / CORNER_DIVISOR).max(1);
    let near = first..(first + length).min(end);
    near.chain(end.saturating_sub(length).max(first)..end)
}

/// Returns the colours of the four corners inside strips.
fn corners(image: &Rgba8, [top, right, bottom, left]: [usize; 4]) -> Vec<[u8; 3]> {
    let mut colours = Vec::new();
    for y in corner_indices(top, image.height - bottom) {
        for x in corner_indices(left, image.width - right) {
            colours.push(image.colour(x, y));
        }
    }
    colours
}

/// True if at least half of the pixels differ from a strip's colour.
fn is_content(pixels: &[[u8; 3]], strip: [u8; 3]) -> bool {
    let similar = count_similar(pixels, strip, MAX_STRIP_NOISE);
    !pixels.is_empty() && 100 * similar <= MAX_INSIDE_PERCENT * pixels.len()
}

/// Returns the median colour of a line if the line is flat.
fn flat_colour(line: &[[u8; 3]]) -> Option<[u8; 3]> {
    let median = medians(line);
    is_flat(line, median).then_some(median)
}

fn is_flat(line: &[[u8; 3]], colour: [u8; 3]) -> bool {
    let similar = count_similar(line, colour, MAX_STRIP_NOISE);
    !line.is_empty() && 100 * similar >= MIN_FLAT_PERCENT * line.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a photograph of 40×30 pixels with strips of the given widths.
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

    fn strips_of_views(widths: [usize; 4], strip: [u8; 3], count: usize) -> Vec<Option<Strips>> {
        (0..count).map(|seed| Strips::of(&photograph(widths, strip, seed))).collect()
    }

    #[test]
    fn widths_are_measured_on_each_side() {
        for widths in [[3, 3, 3, 3], [1, 2, 3, 4], [6, 0, 6, 0], [0, 13, 0, 13], [0, 0, 2, 0]] {
            for colour in [[0; 3], [255; 3], [4, 0, 9]] {
                let found = Strips::common(&strips_of_views(widths, colour, 10));
                assert_eq!(found, Some((Strips { widths, colour }, 10)), "{widths:?} {colour:?}");
            }
        }
        assert_eq!(Strips::common(&strips_of_views([0; 4], [0; 3], 10)), None);
        let text = Strips { widths: [6, 0, 6, 0], colour: [0; 3] }.to_string();
        assert_eq!(text, "uniform strips at the border (colour 0 0 0; top 6, bottom 6 pixels)");
    }

    /// Nine in ten views must have the same strips. A wide frame is an object's margin.
    #[test]
    fn margins_of_objects_are_no_strips() {
        let mut found = strips_of_views([3; 4], [0; 3], 9);
        found.push(None);
        assert!(Strips::common(&found).is_some());
        found.push(None);
        assert_eq!(Strips::common(&found), None);
        let varied: Vec<_> =
            (1..6).flat_map(|w| strips_of_views([w, 3, 3, 3], [0; 3], 2)).collect();
        assert_eq!(
            Strips::common(&varied).map(|(strips, count)| (strips.widths[0], count)),
            Some((3, 10))
        );
        let sides: Vec<_> = (0..4).flat_map(|w| strips_of_views([w, 3, 3, 3], [0; 3], 2)).collect();
        assert_eq!(Strips::common(&sides), None);
        assert_eq!(Strips::of(&photograph([9; 4], [0; 3], 0)), None);
        // Ellipses on black that nearly fill the image: the corners around them are empty.
        for (width, height) in [(40, 30), (16, 16), (200, 150)] {
            for margin in 0..width / 5 {
                let radius = |side: usize| 0.5 * (side - 2 * margin.min(side / 3)) as f64;
                let pixel = |i: usize| {
                    let x = ((i % width) as f64 + 0.5 - 0.5 * width as f64) / radius(width);
                    let y = ((i / width) as f64 + 0.5 - 0.5 * height as f64) / radius(height);
                    if x * x + y * y < 1.0 { [200, 90, 40, 255] } else { [0, 0, 0, 255] }
                };
                let data = (0..width * height).flat_map(pixel).collect();
                assert_eq!(Strips::of(&Rgba8::new(width, height, data)), None, "{width} {margin}");
            }
        }
        let flat = Rgba8::new(4, 3, [7, 7, 7, 255].repeat(12));
        assert_eq!(Strips::of(&flat), None);
    }

    #[test]
    fn masks_that_cover_the_strips_are_recognised() {
        let strips = Strips { widths: [1, 2, 0, 0], colour: [0; 3] };
        let mask = |rows: &[&str]| Mask {
            width: 4,
            height: 3,
            counts: rows.iter().flat_map(|row| row.bytes().map(|b| b == b'#')).collect(),
        };
        assert!(strips.are_masked(&mask(&["....", "##..", "##.."])));
        assert!(!strips.are_masked(&mask(&["#...", "##..", "##.."])));
        assert!(!strips.are_masked(&mask(&["....", "###.", "##.."])));
    }
}
