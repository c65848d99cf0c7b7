use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::values::Row;

/// Parameters of `table`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Heading of the table.
    pub title: String,
    /// Keys that make a row: axes of the run (`scene`, `protocol`, `variant`, a swept parameter),
    /// or `method` for the block that was scored. Results that differ in other keys alone are
    /// averaged. Default: all keys that differ, except `scene`.
    #[schemars(extend("x-default" = "all keys that differ, except `scene`"))]
    pub rows: Vec<String>,
    /// Keys that make a column each, with all values in one cell.
    #[schemars(extend("x-default" = "a column for each value"))]
    pub columns: Vec<String>,
    /// Values to show, in this order: `psnr`, `ssim`, `lpips`, `train_s`, `render_s`, and all
    /// others that `rows.json` has.
    pub values: Vec<String>,
    /// The row that others are compared with, by its keys. A further column has the first of
    /// `values` minus that row's.
    #[schemars(extend("x-default" = "no comparison"))]
    pub relative_to: BTreeMap<String, String>,
    /// Values whose mean, standard deviation, least and greatest are stated over all results.
    #[schemars(extend("x-default" = "none of them"))]
    pub spread: Vec<String>,
    /// Names of methods, by the block that was scored: `{eval: rendered, eval-refined: refined}`.
    #[schemars(extend("x-default" = "the blocks' names"))]
    pub methods: BTreeMap<String, String>,
    /// Further entries of rows for programs, by the block that was scored: `{eval: {refined:
    /// false}}`. `"{variant}"` is the value of that key.
    #[schemars(extend("x-default" = "none"))]
    pub fields: BTreeMap<String, Map<String, Value>>,
    /// Groups of methods that may be compared, in the order of the table: `[{name: LR images,
    /// methods: [eval]}]`, the methods by the block that was scored. A column names the group, and
    /// the best is marked in each.
    #[schemars(extend("x-default" = "one group of all"))]
    pub groups: Vec<Group>,
    /// Heading of the groups' column, and their key.
    pub grouped_by: String,
    /// Rows from elsewhere, for comparison: `[{method: "paper: SS", protocol: 100x2, psnr:
    /// 29.77}]`. Such a row stands where the results have its keys, and is never the best.
    #[schemars(extend("x-default" = "none"))]
    pub further: Vec<Row>,
    /// Differences in PSNR between methods: `[{name: at equal rays, of: eval-ss, over:
    /// eval-nerf}]`. Methods are blocks, or those of `further`.
    #[schemars(extend("x-default" = "none"))]
    pub gains: Vec<Gain>,
    /// A key; each of its values has a table of its own, too, where there are several. Of
    /// `further`, it has the rows with this key.
    #[schemars(extend("x-default" = "one table of all"))]
    pub each: String,
    /// Remarks below the table.
    #[schemars(extend("x-default" = "none"))]
    pub notes: Vec<String>,
}

/// Methods that may be compared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Group {
    /// What they have in common.
    pub name: String,
    /// The blocks that were scored.
    pub methods: Vec<String>,
}

/// A difference in PSNR between two methods.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Gain {
    /// Its name.
    pub name: String,
    /// The method that gains.
    pub of: String,
    /// The method that it is compared with.
    pub over: String,
}

impl Params {
    /// The value by which rows are compared: the first that is shown.
    pub(crate) fn compared(&self) -> &str {
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
            spread: Vec::new(),
            methods: BTreeMap::new(),
            fields: BTreeMap::new(),
            groups: Vec::new(),
            grouped_by: "group".to_owned(),
            further: Vec::new(),
            gains: Vec::new(),
            each: String::new(),
            notes: Vec::new(),
        }
    }
}
