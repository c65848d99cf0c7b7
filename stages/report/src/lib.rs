//! `report`: the record of a run as one HTML page. It opens from disk without a network; pictures
//! at full size lie beside it in `views/`, and without them the page works, too.
//!
//! A sink: it reads `run.json`, looks into the artifacts it names, and is never cached, since it
//! shows times and hashes.
//!
//! * `gather`: results, data sets and figures of a run. `figures`: numbers and how they are shown.
//! * `layers`: the pictures that there are of each view. `pictures`: their originals, and copies
//!   that a page has room for. `scale`: colour scales of error and depth maps.
//! * `data`: all that the page's script works on, as JSON.
//! * `page`: the page's frame. `tables`, `viewer`, `pipeline`, `commands`: its parts. `layout`:
//!   draws the pipeline's graph.
//! * `page.css`; `chart.js`: charts as SVG; `viewer.js`: the comparison; `plots.js`: what is
//!   plotted; `page.js`: starts them.
//! * [`ResultRow`]: the same figures as `results.json` beside the page, for scripts.
//!
//! ```
//! use stage::Stage as _;
//! let params = report::Params { views: 8, ..report::Params::default() };
//! assert_eq!(report::Report::NAME, "report");
//! assert!(params.compare.is_none());
//! ```

mod commands;
mod data;
mod figures;
mod gather;
mod layers;
mod layout;
mod page;
mod params;
mod pictures;
mod pipeline;
mod results;
mod row;
mod scale;
mod tables;
mod viewer;

use artifact::{Failure, RunRecord, counted, sized};
use contract::{Input, Output};
use stage::{Context, Stage};

pub use params::Params;
pub use results::{ResultRow, StageResult};

/// The stage.
pub struct Report;

/// Bytes that a page has at most, but for the text of very long runs.
const MOST_PAGE_BYTES: usize = 15_000_000;
/// Bytes of all that is said of the pictures beside the pictures themselves.
const CAPTION_BYTES: usize = 700_000;

impl Stage for Report {
    type Params = Params;
    const NAME: &'static str = "report";
    const SUMMARY: &'static str = "Writes the record of a run as one HTML page.";
    const SINK: bool = true;
    const PARTIAL: bool = true;

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
        run.check().map_err(|e| Failure::BadInput(e.to_string()))?;
        let report = gather::Report::new(&run);
        let text = page::page(&report, None)?.into_string().len();
        let budget = MOST_PAGE_BYTES.saturating_sub(text + CAPTION_BYTES);
        let data = data::Data::new(context, &report, params, budget)?;
        let html = page::page(&report, Some(&data))?.into_string();
        std::fs::write(context.output_path("index.html")?, &html)?;
        context.write_json("results.json", &results::results(&run))?;
        let results = counted(report.rows.len(), "result");
        let pictures = counted(data.pictures.len(), "picture");
        let size = sized(html.len() as u64);
        context.write_summary(&format!("{results}, {pictures}, {size}"))
    }
}
