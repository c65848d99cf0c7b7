use artifact::{RunNode, RunRecord};
use metrics::{AnyMetrics, Figure};

use crate::figures::figures;
use crate::results::scored;
use crate::row::Row;

/// What a page shows of a run.
pub(crate) struct Report<'a> {
    pub(crate) run: &'a RunRecord,
    /// Results, the ones that came through fewer stages first.
    pub(crate) rows: Vec<Row<'a>>,
    /// Data sets of which there are results, in the rows' order.
    pub(crate) scenes: Vec<SceneViews>,
    /// What the results are judged by.
    pub(crate) figures: Vec<Figure>,
    /// Results whose figures can't be read, with why.
    pub(crate) unread: Vec<String>,
}

/// The views of a data set.
pub(crate) struct SceneViews {
    /// The data set's folder or block.
    pub(crate) data_set: String,
    /// Names of views, in the order of the scores.
    pub(crate) views: Vec<String>,
}

impl<'a> Report<'a> {
    pub(crate) fn new(run: &'a RunRecord) -> Self {
        let mut report =
            Self { run, rows: vec![], scenes: vec![], figures: vec![], unread: vec![] };
        for (index, node) in scored(run) {
            match AnyMetrics::read(&node.folder) {
                Ok(metrics) => report.add(index, node, metrics),
                Err(error) => report.unread.push(error.to_string()),
            }
        }
        report.figures = figures(&report.rows);
        report.label_rows();
        report
    }

    fn add(&mut self, index: usize, node: &'a RunNode, metrics: AnyMetrics) {
        let data_set = data_set(self.run, index);
        let scene = self.scenes.iter().position(|scene| scene.data_set == data_set);
        let scene = scene.unwrap_or_else(|| {
            self.scenes.push(SceneViews { data_set, views: Vec::new() });
            self.scenes.len() - 1
        });
        let views = &mut self.scenes[scene].views;
        for name in view_names(&metrics) {
            if !views.contains(&name) {
                views.push(name);
            }
        }
        let [training, rendering] = times(self.run, node, index);
        let label = String::new();
        self.rows.push(Row { node, index, metrics, label, scene, training, rendering });
    }

    /// A row's values in the sweep and, where several blocks score, whose scores they are
    /// (`eval-refined`: refined).
    fn label_rows(&mut self) {
        let Some(first) = self.rows.first() else { return };
        let stage = &first.node.stage;
        let has_blocks = self.rows.iter().any(|row| row.node.stage != *stage);
        for row in &mut self.rows {
            let (stage, point) = (row.node.stage.as_str(), row.node.point.as_str());
            let whose = stage.strip_prefix("eval-").unwrap_or(stage);
            row.label = match (has_blocks, point) {
                (false, "") => "default".to_owned(),
                (false, point) => point.to_owned(),
                (true, "") => whose.to_owned(),
                (true, point) => format!("{whose}, {point}"),
            };
        }
    }

    /// The row that is best by the first figure; the first one without figures.
    pub(crate) fn best(&self) -> Option<&Row<'a>> {
        let by = self.figures.first();
        let value = |row: &Row<'_>| by.and_then(|figure| row.mean(figure));
        let lower_is_better = by.and_then(|f| f.higher_is_better) == Some(false);
        let is_better = |a: f64, b: f64| if lower_is_better { a < b } else { a > b };
        self.rows.iter().reduce(|best, row| match (value(best), value(row)) {
            (Some(held), Some(new)) if is_better(new, held) => row,
            (None, Some(_)) => row,
            _ => best,
        })
    }
}

fn view_names(metrics: &AnyMetrics) -> Vec<String> {
    metrics.views().iter().filter_map(|view| view["name"].as_str().map(str::to_owned)).collect()
}

/// The data set that a node was made of.
fn data_set(run: &RunRecord, index: usize) -> String {
    let mut found: Vec<String> = Vec::new();
    for node in run.ancestors(index).into_iter().map(|i| &run.nodes[i]) {
        if !["dataset", "scene"].contains(&node.kind.as_str()) {
            continue;
        }
        let folders: Vec<_> =
            node.inputs.values().filter_map(|input| input.folder.as_ref()).collect();
        match node.kind.as_str() {
            "dataset" if folders.is_empty() => found.push(node.stage.clone()),
            _ => found.extend(folders.iter().map(|folder| folder.display().to_string())),
        }
    }
    found.sort();
    found.dedup();
    found.join(", ")
}

/// Seconds of training and of rendering. What was rendered on the way to a refiner belongs to its
/// training.
fn times(run: &RunRecord, node: &RunNode, index: usize) -> [f64; 2] {
    let mut rendered = Vec::new();
    let mut next = node.inputs.get("views").and_then(|input| input.node);
    while let Some(index) = next {
        rendered.push(index);
        next = run.nodes[index].inputs.get("views").and_then(|input| input.node);
    }
    let seconds = |i: &usize| run.nodes[*i].seconds;
    let mut trained = run.ancestors(index);
    trained.retain(|i| {
        ["field", "refiner", "views"].contains(&run.nodes[*i].kind.as_str())
            && !rendered.contains(i)
    });
    let of = |seconds: f64| seconds + 0.0; // a sum of nothing is -0
    [of(trained.iter().map(seconds).sum()), of(rendered.iter().map(seconds).sum())]
}
