//! `table`: figures of an experiment as Markdown, CSV and JSON.
//!
//! * [`Params`]: what makes a row, what makes a column, and what values are shown.
//! * `rows`: a row for every result of a run, with its scores, its times, and where it was made.
//! * `markdown`: these rows as tables for people.
//! * `grid`: one of them, means where several results fall into one cell, the best marked.
//! * `values`: a row, and values of rows by their names.
//!
//! A sink: it gets the run's record and is never cached. What a failed point would have shown is
//! named; what was left out says why.

mod figures;
mod grid;
mod markdown;
mod params;
mod rows;
mod values;

use anyhow::Context as _;
use artifact::{Failure, RunRecord};
use contract::{Input, Output, plain};
use stage::{Context, Stage};

use figures::Figures;
pub use params::{Gain, Group, Params};
pub use values::Row;

/// The stage.
pub struct Table;

impl Stage for Table {
    type Params = Params;
    const NAME: &'static str = "table";
    const SUMMARY: &'static str = "Shows figures of an experiment as Markdown, CSV and JSON.";
    const SINK: bool = true;
    const PARTIAL: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![(
            "run",
            Input::required(&["run"], "folder with run.json: the record of what was scored"),
        )]
    }

    fn output() -> Output {
        Output::kind("table")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let run: RunRecord = context.input("run")?.read_json("run.json")?;
        run.check().map_err(|e| Failure::BadInput(e.to_string()))?;
        let mut figures = Figures::default();
        let rows = rows::rows(&run, params, &mut figures)?;
        if rows.is_empty() && run.failed.is_empty() {
            return Err(Failure::BadInput("run.json: nothing in it was scored".to_owned()).into());
        }
        context.write_json("rows.json", &rows)?;
        write_csv(context, &rows)?;
        let text = markdown::markdown(params, &rows, &figures, &run.failed)?;
        let path = context.output_path("table.md")?;
        std::fs::write(&path, &text).with_context(|| format!("cannot write {}", path.display()))?;
        context.write_summary(&format!("{} results", rows.len()))
    }
}

/// Writes the rows with all keys and values that any of them has.
fn write_csv(context: &Context, rows: &[Row]) -> anyhow::Result<()> {
    let path = context.output_path("rows.csv")?;
    let place = || format!("cannot write {}", path.display());
    let mut names: Vec<&String> = Vec::new();
    for name in rows.iter().flat_map(|row| row.keys()) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let mut writer = csv::Writer::from_path(&path).with_context(place)?;
    writer.write_record(&names).with_context(place)?;
    for row in rows {
        let cells = names.iter().map(|name| row.get(*name).map(plain).unwrap_or_default());
        writer.write_record(cells).with_context(place)?;
    }
    writer.flush().with_context(place)
}
