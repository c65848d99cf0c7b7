//! `table`: figures of an experiment as Markdown, CSV and JSON.
//!
//! * [`Params`]: keys of rows and columns, and the values in their cells.
//! * `rows`: a row for every result of a run, with scores, times, commit and machine.
//! * `markdown`: the document: tables, gains, spreads, failed points.
//! * `grid`: one table, with means where several results share a cell, and the best marked.
//! * `front`: Pareto front, the results that no other result beats in both values; its picture.
//! * `figures`: titles, digits and directions of values.
//! * `values`: a row, and values of rows by name.
//!
//! The stage is a sink: it gets the run's record and is never cached. Failed points are listed, and
//! left-out results have a row with the reason.

mod figures;
mod front;
mod grid;
mod markdown;
mod params;
mod rows;
mod values;

use anyhow::Context as _;
use artifact::{RunRecord, bail_bad_input};
use stage::{Context, Input, Output, Stage, plain};

use figures::Figures;
pub use params::{Gain, Group, Params};
pub use values::Row;

/// The stage.
pub struct Table;

impl Stage for Table {
    type Params = Params;
    const NAME: &'static str = "table";
    const SUMMARY: &'static str = "Writes an experiment's scores as Markdown, CSV and JSON.";
    const SINK: bool = true;
    const ACCEPTS_FAILURES: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        Input::of_sink(
            "in pipeline.yaml: a block that scores; nerf-sr passes a folder with its record, \
            run.json",
        )
    }

    fn output() -> Output {
        Output::kind("table")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let run = RunRecord::read(context.input("run")?)?;
        let mut figures = Figures::default();
        let scored = run.nodes.iter().filter(|node| node.is_shown).count();
        let progress = context.progress("reading scores", scored as u64);
        let rows = rows::rows(&run, params, &mut figures, &progress)?;
        if rows.is_empty() && run.failed.is_empty() {
            bail_bad_input!("run.json has no scored results");
        }
        context.write_json("rows.json", &rows)?;
        write_csv(context, &rows)?;
        let document = markdown::document(params, &rows, &figures, &run.failed)?;
        context.write_text("table.md", &document.text)?;
        if let Some(picture) = &document.picture {
            context.write_text(markdown::PICTURE, picture)?;
        }
        context.write_summary(&artifact::format_count(rows.len(), "result"))
    }
}

/// Writes rows as CSV, with a column for every name that any row has.
fn write_csv(context: &Context, rows: &[Row]) -> anyhow::Result<()> {
    let path = context.output_path("rows.csv")?;
    let message = format!("cannot write {}", path.display());
    let mut names: Vec<&String> = Vec::new();
    for name in rows.iter().flat_map(|row| row.keys()) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let mut writer = csv::Writer::from_path(&path).with_context(|| message.clone())?;
    writer.write_record(&names).with_context(|| message.clone())?;
    for row in rows {
        let cells = names.iter().map(|name| row.get(*name).map(plain).unwrap_or_default());
        writer.write_record(cells).with_context(|| message.clone())?;
    }
    writer.flush().with_context(|| message)
}
