//! `report`: the record of a run as one self-contained HTML page: no network, nothing it needs
//! beside it.
//!
//! A sink: it reads `run.json`, looks into the artifacts it names, and is never cached, since it
//! shows times and hashes.
//!
//! * `compare`: where several blocks score, what each made of a crop of one view, beside its error
//!   map.
//! * `page`: scores of every point of a sweep, views side by side, stages with parameters, hashes
//!   and times.
//! * `images`: views and depth as embedded PNG data.
//! * [`ResultRow`]: the same figures as `results.json` beside the page, for scripts.

mod compare;
mod figures;
mod images;
mod page;
mod results;

use artifact::{Context, Failure, Input, Output, RunRecord, Stage};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use results::{ResultRow, StageResult};

/// Parameters of `report`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Number of views on the page, spread evenly over the test views.
    #[schemars(range(min = 1, max = 100))]
    pub views: u32,
    /// Name of the view that all methods show side by side.
    #[schemars(extend("x-default" = "the first"))]
    pub compare: Option<String>,
    /// Square of that view to show: x, y and side, in pixels.
    #[schemars(extend("x-default" = "the one with most detail"))]
    pub crop: Option<[u32; 3]>,
}

impl Default for Params {
    fn default() -> Self {
        Self { views: 4, compare: None, crop: None }
    }
}

/// The stage.
pub struct Report;

impl Stage for Report {
    type Params = Params;
    const NAME: &'static str = "report";
    const SUMMARY: &'static str = "Writes the record of a run as one self-contained HTML page.";
    const SINK: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![(
            "run",
            Input::required(
                &["run"],
                "folder with run.json, the record of a run; in pipeline.yaml: scores, and more \
                under any name",
            ),
        )]
    }

    fn output() -> Output {
        Output::kind("page")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let run: RunRecord = context.input("run")?.read_json("run.json")?;
        run.check().map_err(|e| Failure::BadInput(format!("run.json: {e}")))?;
        let html = page::page(&run, params)?;
        std::fs::write(context.output_path("index.html")?, html.into_string())?;
        context.write_json("results.json", &results::results(&run)?)
    }
}
