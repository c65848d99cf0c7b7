//! The Pareto front: results that no other result beats in two values, and its picture.

use std::fmt::Write as _;

use crate::figures::Figures;

/// Size of the picture, and its margins at the left, at the bottom, and at the other sides.
const SIZE: (f64, f64) = (720.0, 420.0);
const LEFT_MARGIN: f64 = 64.0;
const BOTTOM_MARGIN: f64 = 46.0;
const OTHER_MARGIN: f64 = 16.0;
/// Colour of points and of the line.
const COLOUR: &str = "#36c";
/// Part of an axis that stays free at both ends.
const FREE_PART: f64 = 0.06;
/// Size of a name's letters: mean width with some reserve, and distance of two lines.
const LETTER_WIDTH: f64 = 6.8;
const LINE_HEIGHT: f64 = 13.0;
/// Base lines of a name relative to its point, the preferred one first.
const NAME_OFFSETS: [f64; 5] = [14.0, -8.0, 28.0, -22.0, 42.0];
/// Number of lines with a number across the picture.
const GRID_LINES: u32 = 5;

/// A result in two values.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Point {
    /// Name of the result.
    pub(crate) name: String,
    /// Value along the horizontal axis, such as a time.
    pub(crate) cost: f64,
    /// Value along the vertical axis, such as a PSNR.
    pub(crate) score: f64,
}

/// Names of the two values.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axes<'a> {
    /// Name of [`Point::cost`]; lower values are better.
    pub(crate) cost: &'a str,
    /// Name of [`Point::score`].
    pub(crate) score: &'a str,
    /// True if lower scores are better.
    pub(crate) lower_is_better: bool,
}

impl Axes<'_> {
    /// Returns whether each point is on the front: no other point is at least as good in both
    /// values and better in one.
    pub(crate) fn front(&self, points: &[Point]) -> Vec<bool> {
        let value = |point: &Point| if self.lower_is_better { -point.score } else { point.score };
        let beats = |a: &Point, b: &Point| {
            a.cost <= b.cost && value(a) >= value(b) && (a.cost < b.cost || value(a) > value(b))
        };
        points.iter().map(|point| !points.iter().any(|other| beats(other, point))).collect()
    }

    /// Draws the points with a logarithmic cost, as SVG. Filled points are on the front, which a
    /// line joins. Returns `None` if a cost isn't positive, a value isn't finite, or there are
    /// fewer than two points.
    pub(crate) fn picture(&self, points: &[Point], figures: &Figures) -> Option<String> {
        if points.len() < 2 || !points.iter().all(|point| point.cost > 0.0) {
            return None;
        }
        let chart = Chart {
            x: Scale::new(points, |point| point.cost.ln())?,
            y: Scale::new(points, |point| point.score)?,
        };
        let (width, height) = SIZE;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" \
            font-family=\"sans-serif\" font-size=\"12\">\n\
            <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n"
        );
        svg += &self.numbers(&chart, figures);
        let is_on_front = self.front(points);
        svg += &chart.line(points, &is_on_front);
        let mut names = Vec::new();
        for (point, is_on_front) in points.iter().zip(is_on_front) {
            svg += &chart.point(point, is_on_front, &mut names);
        }
        let title = format!("{} against {}", figures.title(self.score), figures.title(self.cost));
        let middle = [width / 2.0, height - 8.0];
        Some(svg + &text(middle, "middle", &escape(&title)) + "</svg>\n")
    }

    /// Draws lines across the chart, and the numbers of both axes.
    fn numbers(&self, chart: &Chart, figures: &Figures) -> String {
        let mut svg = String::new();
        for line in 0..GRID_LINES {
            let part = f64::from(line) / f64::from(GRID_LINES - 1);
            let (cost, score) = (chart.x.value(part).exp(), chart.y.value(part));
            let [x, y] = chart.at(cost, score);
            let end = SIZE.0 - OTHER_MARGIN;
            _ = writeln!(svg, "<path d=\"M{LEFT_MARGIN} {y:.1}H{end}\" stroke=\"#ddd\"/>");
            svg += &text([LEFT_MARGIN - 8.0, y + 4.0], "end", &figures.format(self.score, score));
            let below = [x, SIZE.1 - BOTTOM_MARGIN + 18.0];
            svg += &text(below, "middle", &figures.format(self.cost, cost));
        }
        svg
    }
}

/// Axes of the picture; costs are logarithmic.
struct Chart {
    x: Scale,
    y: Scale,
}

impl Chart {
    /// Returns the position of a cost and a score, in the picture's units.
    fn at(&self, cost: f64, score: f64) -> [f64; 2] {
        let x = LEFT_MARGIN + self.x.part(cost.ln()) * (SIZE.0 - LEFT_MARGIN - OTHER_MARGIN);
        let y =
            SIZE.1 - BOTTOM_MARGIN - self.y.part(score) * (SIZE.1 - BOTTOM_MARGIN - OTHER_MARGIN);
        [x, y]
    }

    /// Draws the line that joins the front.
    fn line(&self, points: &[Point], is_on_front: &[bool]) -> String {
        let pairs = points.iter().zip(is_on_front);
        let mut front: Vec<&Point> = pairs.filter_map(|(point, on)| on.then_some(point)).collect();
        front.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        let corners = front.iter().map(|point| {
            let [x, y] = self.at(point.cost, point.score);
            format!("{x:.1} {y:.1}")
        });
        let path = corners.collect::<Vec<_>>().join("L");
        format!("<path d=\"M{path}\" fill=\"none\" stroke=\"{COLOUR}\"/>\n")
    }

    /// Draws a point with its name: to the left near the right end, otherwise to the right.
    /// `names` are the boxes of all names so far, which the name avoids.
    fn point(&self, point: &Point, is_on_front: bool, names: &mut Vec<NameBox>) -> String {
        let [x, y] = self.at(point.cost, point.score);
        let fill = if is_on_front { COLOUR } else { "#fff" };
        // Share of the width, chosen by hand.
        let is_left = x > 0.7 * SIZE.0;
        let (from, anchor) = if is_left { (x - 8.0, "end") } else { (x + 8.0, "start") };
        let width = LETTER_WIDTH * point.name.chars().count() as f64;
        let left = if is_left { from - width } else { from };
        let boxes = NAME_OFFSETS.map(|offset| NameBox { left, right: left + width, y: y + offset });
        let is_free = |name: &&NameBox| !names.iter().any(|other| name.overlaps(other));
        let name = *boxes.iter().find(is_free).unwrap_or(&boxes[0]);
        names.push(name);
        format!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{fill}\" stroke=\"{COLOUR}\"/>\n"
        ) + &text([from, name.y], anchor, &escape(&point.name))
    }
}

/// Position of a name in the picture.
#[derive(Clone, Copy)]
struct NameBox {
    left: f64,
    right: f64,
    /// Base line.
    y: f64,
}

impl NameBox {
    fn overlaps(&self, other: &Self) -> bool {
        self.left < other.right && other.left < self.right && (self.y - other.y).abs() < LINE_HEIGHT
    }
}

/// Returns a text element.
fn text([x, y]: [f64; 2], anchor: &str, escaped: &str) -> String {
    format!("<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{escaped}</text>\n")
}

/// An axis from the least to the greatest value.
struct Scale {
    low: f64,
    span: f64,
}

impl Scale {
    /// Spans the values of all points; `None` if a value isn't finite.
    fn new(points: &[Point], value: impl Fn(&Point) -> f64) -> Option<Self> {
        let values: Vec<f64> = points.iter().map(value).collect();
        let low = values.iter().copied().reduce(f64::min)?;
        let high = values.iter().copied().reduce(f64::max)?;
        let span = if high > low { high - low } else { 1.0 };
        values.iter().all(|value| value.is_finite()).then_some(Self { low, span })
    }

    /// Returns the place of a value along the axis, from 0 to 1.
    fn part(&self, value: f64) -> f64 {
        FREE_PART + (1.0 - 2.0 * FREE_PART) * (value - self.low) / self.span
    }

    /// Returns the value at a part of the way from the least to the greatest value.
    fn value(&self, part: f64) -> f64 {
        self.low + part * self.span
    }
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    const AXES: Axes<'_> = Axes { cost: "train_s", score: "psnr", lower_is_better: false };

    fn point(name: &str, cost: f64, score: f64) -> Point {
        Point { name: name.to_owned(), cost, score }
    }

    #[test]
    fn only_unbeaten_results_are_on_the_front() {
        let points = [
            point("quick", 1.0, 20.0),
            point("slow and worse", 2.0, 19.0),
            point("slow and equal", 3.0, 20.0),
            point("good", 4.0, 30.0),
            point("good, too", 4.0, 30.0),
            point("best", 9.0, 31.0),
        ];
        assert_eq!(AXES.front(&points), [true, false, false, true, true, true]);
        let by_lpips = Axes { lower_is_better: true, ..AXES };
        assert_eq!(by_lpips.front(&points), [true, true, false, false, false, false]);
        assert!(AXES.front(&[]).is_empty());
    }

    #[test]
    fn names_of_near_points_do_not_overlap() {
        let points = ["one", "two", "three", "four"].map(|name| point(name, 10.0, 25.0));
        let far = point("far", 300.0, 30.0);
        let svg = AXES.picture(&[&points[..], &[far]].concat(), &Figures::default()).unwrap();
        let base_lines = ["one", "two", "three", "four"].map(|name| {
            let before = svg.split(&format!(">{name}</text>")).next().unwrap();
            before.rsplit("y=\"").next().unwrap().split('"').next().unwrap().to_owned()
        });
        for (i, base_line) in base_lines.iter().enumerate() {
            assert!(!base_lines[..i].contains(base_line), "{base_lines:?}");
        }
    }

    #[test]
    fn the_picture_has_every_name_and_joins_the_front() {
        let points = [point("a < b", 10.0, 25.0), point("c", 20.0, 24.0), point("d", 300.0, 30.0)];
        let svg = AXES.picture(&points, &Figures::default()).unwrap();
        assert!(svg.contains(">a &lt; b</text>") && svg.contains(">d</text>"), "{svg}");
        assert_eq!(svg.matches("fill=\"#36c\"").count(), 2, "{svg}");
        let line = svg.lines().find(|line| line.contains("fill=\"none\"")).unwrap();
        assert_eq!(line.matches('L').count(), 1, "{line}");
        assert!(!svg.contains("NaN"), "{svg}");
    }

    #[test]
    fn points_that_cannot_be_drawn_have_no_picture() {
        for points in [
            vec![],
            vec![point("a", 1.0, 1.0)],
            vec![point("a", 0.0, 1.0), point("b", 1.0, 1.0)],
            vec![point("a", 1.0, f64::NAN), point("b", 2.0, 1.0)],
            vec![point("a", f64::INFINITY, 2.0), point("b", 2.0, 1.0)],
        ] {
            assert_eq!(AXES.picture(&points, &Figures::default()), None, "{points:?}");
        }
    }

    /// Equal values are inside the picture, not at infinity.
    #[test]
    fn equal_results_are_drawn() {
        let points = [point("a", 5.0, 20.0), point("b", 5.0, 20.0)];
        let svg = AXES.picture(&points, &Figures::default()).unwrap();
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
