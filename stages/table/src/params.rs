use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::values::Row;

/// Parameters of `table`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Heading of the table.
    pub title: String,
    /// Keys whose values identify a row: axes of the run (`scene`, `protocol`, `variant`, a swept
    /// parameter), or `method` for the scoring block. Results that differ only in other keys are
    /// averaged. Default: all keys that differ, except `scene`.
    #[schemars(extend("x-default" = "all keys that differ, except `scene`"))]
    pub rows: Vec<String>,
    /// Keys whose values identify a column. Each cell then contains all `values`.
    #[schemars(extend("x-default" = "a column for each value"))]
    pub columns: Vec<String>,
    /// Values in the table, in this order: `psnr`, `ssim`, `lpips`, `train_s`, `render_s`, or any
    /// other value of `rows.json`.
    pub values: Vec<String>,
    /// Keys and values of the row that others are compared with, such as `{method: rendered}`. An
    /// additional column has the difference in the first of `values`.
    #[schemars(extend("x-default" = "no comparison"))]
    pub relative_to: BTreeMap<String, String>,
    /// Name of a cost, such as `train_cpu_s`, `render_s` or `field_mb`, for a Pareto front: column
    /// `front` marks rows that no other row beats in both this cost and the first of `values`, and
    /// `front.svg` shows the rows by both. Rows that lack a scene are left out.
    #[schemars(extend("x-default" = "no comparison"))]
    pub front: Option<String>,
    /// Names of methods, by scoring block: `{eval: rendered, eval-refined: refined}`. `{variant}`
    /// in a name is replaced by the value of that key.
    #[schemars(extend("x-default" = "the blocks' names"))]
    pub methods: BTreeMap<String, String>,
    /// Groups of comparable methods, in the order of the table: `[{name: LR images, methods:
    /// [eval]}]`, with methods by scoring block. Column `has seen` displays the group's name,
    /// which should say what images the group's methods were given. The best value of each group is
    /// marked.
    #[schemars(extend("x-default" = "one group of all"))]
    pub groups: Vec<Group>,
    /// Rows from other sources, for comparison: `[{method: "paper: SS", protocol: 100x2, psnr:
    /// 29.77}]`. An extra row appears if the table's results have the same values of its keys. In
    /// the table of a single scene it also needs key `scene`. It is never marked as the best.
    #[schemars(extend("x-default" = "none"))]
    pub extra_rows: Vec<Row>,
    /// Differences in PSNR between methods: `[{name: at equal rays, of: eval-ss, over:
    /// eval-nerf}]`. Methods are blocks, or methods of `extra_rows`.
    #[schemars(extend("x-default" = "none"))]
    pub gains: Vec<Gain>,
}

/// A group of comparable methods.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Group {
    /// Name of the group.
    pub name: String,
    /// Scoring blocks.
    pub methods: Vec<String>,
}

/// Difference in PSNR between two methods.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Gain {
    /// Name of the difference.
    pub name: String,
    /// Method whose PSNR is the minuend.
    pub of: String,
    /// Method whose PSNR is subtracted.
    pub over: String,
}

impl Params {
    /// Returns the value by which rows are compared: the first of `values`.
    pub(crate) fn compared_value(&self) -> &str {
        self.values.first().map_or("psnr", String::as_str)
    }
}

impl Default for Params {
    fn default() -> Self {
        let values = ["psnr", "ssim", "lpips", "train_s", "render_s"];
        Self {
            title: "Results".to_owned(),
            rows: Vec::new(),
            columns: Vec::new(),
            values: values.map(str::to_owned).into(),
            relative_to: BTreeMap::new(),
            front: None,
            methods: BTreeMap::new(),
            groups: Vec::new(),
            extra_rows: Vec::new(),
            gains: Vec::new(),
        }
    }
}
