//! One table: a line for each combination of the rows' keys, the best of each group marked.

use contract::plain;
use serde_json::Value;

use crate::figures::Figures;
use crate::params::Params;
use crate::rows::MISSING;
use crate::values::{Row, distinct, mean, of, together};

/// Names that aren't keys: what a result has, not what it is of.
pub(crate) const PLACES: [&str; 2] = ["commit", "machine"];

/// What lines and columns of a table are.
pub(crate) struct Shape<'a> {
    pub(crate) params: &'a Params,
    pub(crate) figures: &'a Figures,
    /// Keys that make a row.
    pub(crate) keys: Vec<String>,
    /// The value that others are compared with.
    pub(crate) first: Option<f64>,
}

impl Shape<'_> {
    /// The table of these results, which may be a part: those with one value of `each`.
    pub(crate) fn table(&self, rows: &[Row], is_part: bool) -> String {
        let params = self.params;
        let columns = distinct(rows, &params.columns);
        let further =
            params.further.iter().filter(|row| !is_part || row.contains_key(&params.each));
        let further: Vec<Row> = further.filter(|row| self.belongs(row, rows)).cloned().collect();
        let all = [rows, &further[..]].concat();
        let values: Vec<&String> = params
            .values
            .iter()
            .filter(|name| all.iter().any(|row| row.contains_key(*name)))
            .collect();
        let mut lines = vec![self.head(&columns, &values)];
        for line in distinct(rows, &self.keys) {
            lines.push(self.line(rows, rows, &line, (&columns, &values)));
        }
        for line in distinct(&further, &self.keys) {
            // They compete with none.
            lines.push(self.line(&further, &[], &line, (&columns, &values)));
        }
        grid(&lines)
    }

    fn head(&self, columns: &[Vec<String>], values: &[&String]) -> Vec<String> {
        let mut head = self.keys.clone();
        match self.params.columns.is_empty() {
            false => {
                head.extend(columns.iter().map(|column| {
                    format!("{} ({})", column.join(", "), self.figures.titles(values).join(" / "))
                }));
            }
            true => head.extend(self.figures.titles(values)),
        }
        head.extend(self.first.is_some().then(|| "against the first".to_owned()));
        head.extend(PLACES.map(str::to_owned));
        head
    }

    /// A line of `rows`; the best are those of `rivals` that are of its group.
    fn line(
        &self,
        rows: &[Row],
        rivals: &[Row],
        keys: &[String],
        (columns, values): (&[Vec<String>], &[&String]),
    ) -> Vec<String> {
        let mine = of(rows, &self.keys, keys);
        let rivals = self.rivals(rivals, &mine);
        let mut line = keys.to_vec();
        for column in columns {
            let here = of(&mine, &self.params.columns, column);
            let cells: Vec<String> = values
                .iter()
                .map(|name| self.marked(name, mean(&here, name), self.best(&rivals, column, name)))
                .collect();
            match (self.params.columns.is_empty(), reason(&here)) {
                (false, Some(reason)) => line.push(reason),
                (false, None) if cells.iter().all(|cell| cell == NOTHING) => {
                    line.push(NOTHING.to_owned());
                }
                (false, None) => line.push(cells.join(" / ")),
                (true, Some(reason)) => {
                    line.extend(std::iter::once(reason).chain(cells.into_iter().skip(1)));
                }
                (true, None) => line.extend(cells),
            }
        }
        if let Some(first) = self.first {
            let gain = mean(&mine, self.params.compared()).map(|value| value - first);
            line.push(gain.map_or(NOTHING.to_owned(), |gain| format!("{gain:+.2}")));
        }
        line.extend(PLACES.map(|name| {
            Some(together(&mine, name))
                .filter(|text| !text.is_empty())
                .unwrap_or(NOTHING.to_owned())
        }));
        line
    }

    /// The rows of the same group that have values.
    fn rivals(&self, rows: &[Row], mine: &[Row]) -> Vec<Row> {
        let by = &self.params.grouped_by;
        let group = mine.first().and_then(|row| row.get(by));
        rows.iter()
            .filter(|row| row.get(by) == group && !row.contains_key(MISSING))
            .cloned()
            .collect()
    }

    /// The best mean of a value in a column, where there are several.
    fn best(&self, rivals: &[Row], column: &[String], name: &str) -> Option<f64> {
        let lines = distinct(rivals, &self.keys);
        let means = lines.iter().filter_map(|keys| {
            mean(&of(&of(rivals, &self.keys, keys), &self.params.columns, column), name)
        });
        means
            .reduce(if self.figures.is_less_better(name) { f64::min } else { f64::max })
            .filter(|_| lines.len() > 1)
    }

    /// A value as it is shown; the best of its column in bold.
    fn marked(&self, name: &str, value: Option<f64>, best: Option<f64>) -> String {
        let Some(value) = value else { return NOTHING.to_owned() };
        let text = self.figures.shown(name, value);
        // What is shown alike is as good.
        if best.is_some_and(|best| self.figures.shown(name, best) == text) {
            format!("**{text}**")
        } else {
            text
        }
    }

    /// Whether results have the keys of a row from elsewhere: one of their columns, and in all else
    /// what all of them have.
    fn belongs(&self, further: &Row, rows: &[Row]) -> bool {
        further.iter().filter(|(name, value)| self.is_key(name, value)).all(|(name, value)| {
            let theirs = distinct(rows, std::slice::from_ref(name)).concat();
            let is_column = self.params.columns.contains(name) || self.params.rows.contains(name);
            theirs.contains(&plain(value)) && (is_column || theirs.len() == 1)
        })
    }

    /// Whether a value is a key that all results of a table may have in common.
    fn is_key(&self, name: &str, value: &Value) -> bool {
        value.is_string() && name != "method" && name != self.params.grouped_by
    }
}

/// Stands for a value that there isn't.
pub(crate) const NOTHING: &str = "–";

/// Why rows have no values, where none has.
fn reason(rows: &[Row]) -> Option<String> {
    let are_missing = !rows.is_empty() && rows.iter().all(|row| row.contains_key(MISSING));
    are_missing.then(|| together(rows, MISSING))
}

/// Lines as a Markdown table; the first is its head.
pub(crate) fn grid(lines: &[Vec<String>]) -> String {
    let rule = vec!["---".to_owned(); lines[0].len()];
    [&lines[0], &rule].into_iter().chain(&lines[1..]).map(|cells| grid_line(cells)).collect()
}

fn grid_line(cells: &[String]) -> String {
    let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
    format!("| {} |\n", cells.join(" | "))
}
