//! `report`: the record of a run as one HTML page. A browser opens the page from disk, without a
//! network. Pictures at full size are in `views/` next to the page, which also works without them.
//!
//! The stage is a sink: it reads `run.json` and the artifacts listed there, and is never cached,
//! since the page contains times and hashes.
//!
//! * `gather`: results, data sets and figures of a run.
//! * `layers`: available pictures of each view. `pictures`: originals, and copies within the page's
//!   byte budget. `scale`: colour scales of error and depth maps.
//! * `data`: input of the page's script, as JSON.
//! * `heading`: facts in the heading. `unscored`: views of a failed run.
//! * `page`: the page's frame. `tables`, `comparison`, `pipeline`, `commands`: its parts. `layout`:
//!   drawing of the pipeline's graph.
//! * `page.css`; `chart.js`: charts as SVG; `comparison.js`: comparison of pictures; `plots.js`:
//!   choice of plots; `page.js`: entry point.
//! * [`ResultRow`]: a row of `results.json`, the page's scores for scripts.
//!
//! ```
//! let params: report::Params = serde_json::from_str(r#"{"views": 8}"#)?;
//! assert_eq!(params.views, 8);
//! assert!(params.compare.is_none());
//! assert!(serde_json::from_str::<report::Params>(r#"{"pictures": 8}"#).is_err());
//! # Ok::<(), serde_json::Error>(())
//! ```

mod commands;
mod comparison;
mod data;
mod gather;
mod heading;
mod layers;
mod layout;
mod page;
mod pictures;
mod pipeline;
mod results;
mod scale;
mod tables;
mod unscored;

use artifact::{RunRecord, bail_usage, format_count, format_size};
use stage::{Context, Input, Output, Stage};

pub use data::Params;
pub use results::{ResultRow, StageResult};

/// The stage.
pub struct Report;

/// Maximum size of a page in bytes, unless the text of a very long run is larger (docs/design/041).
const MAX_PAGE_BYTES: usize = 15_000_000;
/// Bytes reserved for labels and file names of the pictures; chosen by hand.
const CAPTION_BYTES: usize = 700_000;

impl Stage for Report {
    type Params = Params;
    const NAME: &'static str = "report";
    const SUMMARY: &'static str = "Writes the record of a run as one HTML page.";
    const SINK: bool = true;
    const ACCEPTS_FAILURES: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        Input::of_sink(
            "in pipeline.yaml: a block of `eval`, and further blocks, each under a name of your \
            choice; nerf-sr passes a folder with their record, run.json",
        )
    }

    fn output() -> Output {
        Output::kind("page")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let run = RunRecord::read(context.input("run")?)?;
        if let Some([.., 0]) = params.crop {
            bail_usage!("parameter crop: expected a side of at least 1 pixel, found 0");
        }
        let report = gather::Report::new(&run);
        let text = page::page(&report, None)?.into_string().len();
        let budget = MAX_PAGE_BYTES.saturating_sub(text + CAPTION_BYTES);
        let data = data::Data::new(context, &report, params, budget)?;
        let html = page::page(&report, Some(&data))?.into_string();
        context.write_text("index.html", &html)?;
        context.write_json("results.json", &results::results(&run))?;
        let results = format_count(report.rows.len(), "result");
        let pictures = format_count(data.pictures.len(), "picture");
        let size = format_size(html.len() as u64);
        context.write_summary(&format!("{results}, {pictures}, {size}"))
    }
}
