//! One table: a line for each combination of the rows' keys, with the best of each group marked.

use stage::plain;

use crate::figures::Figures;
use crate::front::{Axes, Point};
use crate::params::Params;
use crate::rows::GROUP;
use crate::values::{
    MISSING, PROVENANCE, Row, SCENE, difference, distinct, is_key, listed, mean, scenes, select,
};

/// Lines and columns of a table.
pub(crate) struct Layout<'a> {
    pub(crate) params: &'a Params,
    pub(crate) figures: &'a Figures,
    /// Keys whose values identify a line.
    pub(crate) keys: Vec<String>,
    /// Results that others are compared with.
    pub(crate) reference: Option<Vec<Row>>,
}

impl Layout<'_> {
    /// Returns the table of some results; `is_part` if they are of one scene among several.
    pub(crate) fn table(&self, rows: &[Row], is_part: bool) -> String {
        let params = self.params;
        let columns = distinct(rows, &params.columns);
        let extra = params.extra_rows.iter().filter(|row| !is_part || row.contains_key(SCENE));
        let extra: Vec<Row> = extra.filter(|row| self.matches(row, rows)).cloned().collect();
        let all = [rows, &extra[..]].concat();
        let values: Vec<&String> = params
            .values
            .iter()
            .filter(|name| all.iter().any(|row| row.contains_key(*name)))
            .collect();
        let mut lines = vec![self.head(&columns, &values)];
        let front = self.front(rows);
        for line in distinct(rows, &self.keys) {
            let mut cells = self.line(rows, rows, &line, (&columns, &values));
            self.add_front(&mut cells, &front);
            lines.push(cells);
        }
        for line in distinct(&extra, &self.keys) {
            // Extra rows are never the best.
            let mut cells = self.line(&extra, &[], &line, (&columns, &values));
            self.add_front(&mut cells, &[]);
            lines.push(cells);
        }
        markdown_table(&lines)
    }

    fn head(&self, columns: &[Vec<String>], values: &[&String]) -> Vec<String> {
        let mut head = self.keys.clone();
        let titles: Vec<String> = values.iter().map(|name| self.figures.title(name)).collect();
        if self.params.columns.is_empty() {
            head.extend(titles);
        } else {
            for column in columns {
                head.push(format!("{} ({})", column.join(", "), titles.join(" / ")));
            }
        }
        head.extend(self.reference.as_ref().map(|_| {
            let values: Vec<&str> = self.params.relative_to.values().map(String::as_str).collect();
            format!("against {}", values.join(", "))
        }));
        head.extend(self.params.front.is_some().then(|| "front".to_owned()));
        head.extend(PROVENANCE.map(str::to_owned));
        head
    }

    /// Returns the names of the Pareto front's values; `None` without a front, or if no score is
    /// known to be better than another.
    fn axes(&self) -> Option<Axes<'_>> {
        let score = self.params.compared_value();
        let lower_is_better = self.figures.lower_is_better(score)?;
        Some(Axes { cost: self.params.front.as_ref()?, score, lower_is_better })
    }

    /// Returns the lines that have both values of the Pareto front for all scenes, named by their
    /// keys.
    fn points(&self, rows: &[Row], axes: &Axes<'_>) -> Vec<Point> {
        let point = |keys: Vec<String>| {
            let line = select(rows, &self.keys, &keys);
            let complete_mean = |name| {
                let is_complete = self.partial_scenes(rows, &line, name).is_none();
                mean(&line, name).filter(|_| is_complete)
            };
            let (cost, score) = (complete_mean(axes.cost)?, complete_mean(axes.score)?);
            Some(Point { name: keys.join(", "), cost, score })
        };
        distinct(rows, &self.keys).into_iter().filter_map(point).collect()
    }

    /// Returns the names of the lines on the Pareto front.
    fn front(&self, rows: &[Row]) -> Vec<String> {
        let Some(axes) = self.axes() else { return Vec::new() };
        let points = self.points(rows, &axes);
        let is_on_front = axes.front(&points).into_iter();
        let named = points.into_iter().zip(is_on_front);
        named.filter_map(|(point, is_on_front)| is_on_front.then_some(point.name)).collect()
    }

    /// Draws the lines by both values of the front.
    pub(crate) fn front_picture(&self, rows: &[Row]) -> Option<String> {
        let axes = self.axes()?;
        axes.picture(&self.points(rows, &axes), self.figures)
    }

    /// Inserts the front's cell before a line's provenance. The line's first cells are its keys.
    fn add_front(&self, cells: &mut Vec<String>, front: &[String]) {
        if self.params.front.is_some() {
            let is_on_front = front.contains(&cells[..self.keys.len()].join(", "));
            let mark = if is_on_front { "●" } else { "" };
            cells.insert(cells.len() - PROVENANCE.len(), mark.to_owned());
        }
    }

    /// Returns the number of scenes for which a line has a value, and the number for which any row
    /// has the value; `None` if the line lacks none of them, or if each line has one scene.
    fn partial_scenes(&self, rows: &[Row], line: &[Row], name: &str) -> Option<[usize; 2]> {
        let counts = [line, rows].map(|rows| scenes(rows, name).len());
        let is_partial = counts[0] < counts[1] && !self.keys.iter().any(|key| key == SCENE);
        is_partial.then_some(counts)
    }

    /// Returns the cells of a line of `rows`. The best of `rivals` in the line's group are marked;
    /// the line should have all scenes of `rivals`.
    fn line(
        &self,
        rows: &[Row],
        rivals: &[Row],
        keys: &[String],
        (columns, values): (&[Vec<String>], &[&String]),
    ) -> Vec<String> {
        let mine = select(rows, &self.keys, keys);
        let group = self.group(rivals, &mine);
        let mut line = keys.to_vec();
        for column in columns {
            let selected = select(&mine, &self.params.columns, column);
            let all = select(rivals, &self.params.columns, column);
            let mut cells: Vec<String> = Vec::new();
            for name in values {
                cells.push(self.cell(name, &selected, self.best(&group, column, name, &all), &all));
            }
            if !selected.is_empty() && selected.iter().all(|row| row.contains_key(MISSING)) {
                line.push(listed(&selected, MISSING));
                if self.params.columns.is_empty() {
                    line.extend(cells.into_iter().skip(1));
                }
            } else if self.params.columns.is_empty() {
                line.extend(cells);
            } else if cells.iter().all(|cell| cell == NO_VALUE) {
                line.push(NO_VALUE.to_owned());
            } else {
                line.push(cells.join(" / "));
            }
        }
        if let Some(reference) = &self.reference {
            let name = self.params.compared_value();
            let gain = difference(&mine, reference, &self.compared_keys(), name);
            line.push(gain.map_or(NO_VALUE.to_owned(), |gain| format!("{gain:+.2}")));
        }
        for name in PROVENANCE {
            let text = listed(&mine, name);
            line.push(if text.is_empty() { NO_VALUE.to_owned() } else { text });
        }
        line
    }

    /// Returns the keys in which a line differs from those it is compared with. The method is one
    /// of them if its name contains the value of another.
    fn compared_keys(&self) -> Vec<&str> {
        let mut keys: Vec<&str> = self.params.relative_to.keys().map(String::as_str).collect();
        let is_in_name = |key: &&str| {
            let placeholder = format!("{{{key}}}");
            self.params.methods.values().any(|method| method.contains(&placeholder))
        };
        if keys.iter().any(is_in_name) {
            keys.push("method");
        }
        keys.push(GROUP);
        keys
    }

    /// Returns the rows that have values and belong to the group of `mine`.
    fn group(&self, rows: &[Row], mine: &[Row]) -> Vec<Row> {
        let group = mine.first().and_then(|row| row.get(GROUP));
        rows.iter()
            .filter(|row| row.get(GROUP) == group && !row.contains_key(MISSING))
            .cloned()
            .collect()
    }

    /// Returns the best mean of a value in a column with several lines, each over all scenes.
    fn best(&self, rivals: &[Row], column: &[String], name: &str, all: &[Row]) -> Option<f64> {
        let lower_is_better = self.figures.lower_is_better(name)?;
        let lines = distinct(rivals, &self.keys);
        let means = lines.iter().filter_map(|keys| {
            let line = select(rivals, &self.keys, keys);
            let selected = select(&line, &self.params.columns, column);
            let is_complete = self.partial_scenes(all, &selected, name).is_none();
            mean(&selected, name).filter(|_| is_complete)
        });
        means.reduce(if lower_is_better { f64::min } else { f64::max }).filter(|_| lines.len() > 1)
    }

    /// Formats a line's mean of a value. The best of its column is bold, and a mean without some of
    /// the scenes of `all` names their numbers.
    fn cell(&self, name: &str, line: &[Row], best: Option<f64>, all: &[Row]) -> String {
        let Some(value) = mean(line, name) else { return NO_VALUE.to_owned() };
        let text = self.figures.format(name, value);
        if let Some([present, expected]) = self.partial_scenes(all, line, name) {
            return format!("{text} ({present} of {expected} scenes)");
        }
        // Values that are equal after rounding are equally good.
        if best.is_some_and(|best| self.figures.format(name, best) == text) {
            format!("**{text}**")
        } else {
            text
        }
    }

    /// Returns whether an extra row belongs to the table of some results. A key that identifies
    /// lines or columns must have a value that occurs in the results; any other key must have the
    /// one value that all results have.
    fn matches(&self, extra: &Row, rows: &[Row]) -> bool {
        let is_shared = |name: &str| name != "method" && name != GROUP;
        let mut keys = extra.iter().filter(|(name, value)| is_key(name, value) && is_shared(name));
        keys.all(|(name, value)| {
            let theirs = distinct(rows, std::slice::from_ref(name)).concat();
            let is_compared = self.params.columns.contains(name) || self.keys.contains(name);
            theirs.contains(&plain(value)) && (is_compared || theirs.len() == 1)
        })
    }
}

/// Text of a cell without a value.
pub(crate) const NO_VALUE: &str = "–";

/// Formats lines as a Markdown table; the first line is the head.
pub(crate) fn markdown_table(lines: &[Vec<String>]) -> String {
    let rule = vec!["---".to_owned(); lines[0].len()];
    let text = |cells: &Vec<String>| {
        let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
        format!("| {} |\n", cells.join(" | "))
    };
    [&lines[0], &rule].into_iter().chain(&lines[1..]).map(text).collect()
}
