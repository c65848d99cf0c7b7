use std::path::{Path, PathBuf};
use std::sync::Arc;

use pixels::{DepthMap, ExrImage, Rgba8, common_range, read_exr, read_png};
use scene::{View, Views};
use serde_json::Value;

use crate::gather::Report;
use crate::row::Row;

/// One picture of every view of a data set, such as ground truth or a method's error maps.
pub(crate) struct Layer<'a> {
    pub(crate) label: String,
    pub(crate) group: Group,
    /// Its place among the report's data sets.
    pub(crate) scene: usize,
    /// The row that it belongs to; none for observations.
    pub(crate) row: Option<usize>,
    source: Source<'a>,
}

/// Label of the layers of a method without others.
pub(crate) const ONLY_RENDER: &str = "Render";

/// Kinds of pictures.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Group {
    LowResolution,
    Truth,
    Render,
    Error,
    Depth,
    /// Pictures that a metric made.
    Metric {
        name: String,
        title: String,
    },
}

/// Where a layer's pictures lie.
enum Source<'a> {
    Image(Arc<Folder>),
    LowResolution(Arc<Folder>),
    Depth(Arc<Folder>),
    /// Files that a result names: the pointer of their names among a view's scores.
    Scored(&'a Row<'a>, String),
}

/// A folder of views.
pub(crate) struct Folder {
    path: PathBuf,
    pub(crate) views: Views,
}

impl Folder {
    fn read(path: PathBuf) -> anyhow::Result<Arc<Self>> {
        let views = Views::of_folder(&path)?;
        Ok(Arc::new(Self { path, views }))
    }

    fn view(&self, name: &str) -> Option<&View> {
        self.views.views.iter().find(|view| view.camera.name == name)
    }

    /// An image of it over the background.
    fn colour(&self, file: &str) -> anyhow::Result<Rgba8> {
        Ok(self.views.read_over(&self.path.join(file))?.to_rgba8())
    }

    fn depth(&self, name: &str) -> anyhow::Result<Option<ExrImage>> {
        let file = self.view(name).and_then(|view| view.depth.as_ref());
        Ok(file.map(|file| read_exr(&self.path.join(file))).transpose()?)
    }
}

impl Layer<'_> {
    /// Its picture of a view, where there is one. Depths are shown within a range.
    pub(crate) fn picture(&self, view: &str, range: (f32, f32)) -> anyhow::Result<Option<Rgba8>> {
        match &self.source {
            Source::Image(folder) => {
                let file = folder.view(view).and_then(|view| view.image.as_ref());
                file.map(|file| folder.colour(file)).transpose()
            }
            Source::LowResolution(folder) => {
                let file = folder.view(view).and_then(|view| view.low_resolution.as_ref());
                file.map(|file| folder.colour(file)).transpose()
            }
            Source::Depth(folder) => {
                let image = folder.depth(view)?;
                Ok(image.and_then(|image| Some(DepthMap::of(&image)?.draw(image.width, range))))
            }
            Source::Scored(row, pointer) => {
                let file = row.view(view).and_then(|scores| scores.pointer(pointer)?.as_str());
                // Without truth of its size there is no error map, though it has a name.
                let path = file.map(|file| row.node.folder.join(file)).filter(|path| path.exists());
                Ok(path.map(|path| read_png(&path)).transpose()?)
            }
        }
    }

    /// The range of depths that it shows of views; none where it shows none.
    pub(crate) fn depth_range<'a>(
        &self,
        views: impl Iterator<Item = &'a String>,
    ) -> anyhow::Result<Option<(f32, f32)>> {
        let Source::Depth(folder) = &self.source else { return Ok(None) };
        let mut ranges = Vec::new();
        for view in views {
            let image = folder.depth(view)?;
            ranges.extend(image.and_then(|image| DepthMap::of(&image)?.range()));
        }
        Ok(common_range(ranges))
    }
}

/// Pixels of a data set's largest view; 1 where that isn't known.
pub(crate) fn pixels_of(layers: &[Layer<'_>], scene: usize) -> u64 {
    let of_scene = layers.iter().filter(|layer| layer.scene == scene);
    let sizes = of_scene.flat_map(|layer| match &layer.source {
        Source::Image(folder) => folder.views.views.as_slice(),
        _ => &[],
    });
    let pixels = sizes.map(|view| {
        let k = view.camera.intrinsics;
        u64::from(k.width) * u64::from(k.height)
    });
    pixels.max().unwrap_or(1).max(1)
}

/// All layers: observations first, then what each method made.
pub(crate) fn layers<'a>(report: &'a Report<'a>) -> anyhow::Result<Vec<Layer<'a>>> {
    let mut layers = Vec::new();
    let mut truths: Vec<(PathBuf, usize, Option<Arc<Folder>>)> = Vec::new();
    for row in &report.rows {
        let Some(path) = folder_of(report, row, "truth") else { continue };
        if !truths.iter().any(|(other, scene, _)| *other == path && *scene == row.scene) {
            let folder = is_views(&path).then(|| Folder::read(path.clone())).transpose()?;
            truths.push((path, row.scene, folder));
        }
    }
    for (path, scene, folder) in &truths {
        let Some(folder) = folder else { continue };
        let is_alone = truths.iter().filter(|(_, other, _)| other == scene).count() == 1;
        let whose = if is_alone { String::new() } else { format!(" of {}", users(report, path)) };
        add_observations(&mut layers, *scene, folder, &whose);
    }
    for index in 0..report.rows.len() {
        add_method(&mut layers, report, index)?;
    }
    Ok(layers)
}

/// Ground truth, photographs and true depth, where there are any.
fn add_observations(layers: &mut Vec<Layer<'_>>, scene: usize, folder: &Arc<Folder>, whose: &str) {
    let views = &folder.views.views;
    let layer = |label, group, source| Layer { label, group, scene, row: None, source };
    if views.iter().any(|view| view.low_resolution.is_some()) {
        let source = Source::LowResolution(Arc::clone(folder));
        layers.push(layer(format!("LR photograph{whose}"), Group::LowResolution, source));
    }
    if views.iter().any(|view| view.image.is_some()) {
        let source = Source::Image(Arc::clone(folder));
        layers.push(layer(format!("Ground truth{whose}"), Group::Truth, source));
    }
    if views.iter().any(|view| view.depth.is_some()) {
        let source = Source::Depth(Arc::clone(folder));
        layers.push(layer(format!("Ground truth{whose}"), Group::Depth, source));
    }
}

/// What a method made, and what its scores show.
fn add_method<'a>(
    layers: &mut Vec<Layer<'a>>,
    report: &'a Report<'a>,
    index: usize,
) -> anyhow::Result<()> {
    let row = &report.rows[index];
    if let Some(path) = folder_of(report, row, "views").filter(|path| is_views(path)) {
        let folder = Folder::read(path)?;
        let has_depth = folder.views.views.iter().any(|view| view.depth.is_some());
        let render = Source::Image(Arc::clone(&folder));
        layers.push(of_method(report, index, Group::Render, render));
        if has_depth {
            layers.push(of_method(report, index, Group::Depth, Source::Depth(folder)));
        }
    }
    let of_metrics = row.metrics.picture_titles().into_iter().map(|(name, title)| {
        let pointer = format!("/pictures/{}", name.replace('~', "~0").replace('/', "~1"));
        (Group::Metric { name: name.to_owned(), title: title.to_owned() }, pointer)
    });
    for (group, pointer) in [(Group::Error, "/error_map".to_owned())].into_iter().chain(of_metrics)
    {
        if names_files(row, &pointer) {
            layers.push(of_method(report, index, group, Source::Scored(row, pointer)));
        }
    }
    Ok(())
}

fn of_method<'a>(report: &Report<'_>, index: usize, group: Group, source: Source<'a>) -> Layer<'a> {
    let row = &report.rows[index];
    let label = if report.rows.len() == 1 { ONLY_RENDER.to_owned() } else { row.label.clone() };
    Layer { label, group, scene: row.scene, row: Some(index), source }
}

fn names_files(row: &Row<'_>, pointer: &str) -> bool {
    let mut views = row.metrics.views().iter();
    views.any(|view| view.pointer(pointer).is_some_and(Value::is_string))
}

fn folder_of(report: &Report<'_>, row: &Row<'_>, input: &str) -> Option<PathBuf> {
    row.node.inputs.get(input).map(|input| report.run.folder_of(input))
}

fn is_views(folder: &Path) -> bool {
    folder.join(scene::VIEWS_FILE).is_file()
}

/// The rows that are scored on a truth, in words.
fn users(report: &Report<'_>, truth: &Path) -> String {
    let users = report
        .rows
        .iter()
        .filter(|row| folder_of(report, row, "truth").is_some_and(|path| path == truth));
    let labels: Vec<&str> = users.map(|row| row.label.as_str()).collect();
    match labels.as_slice() {
        [one] => (*one).to_owned(),
        [first, ..] => format!("{first} and {} more", labels.len() - 1),
        [] => String::new(),
    }
}

impl Group {
    /// Heading of its layers in lists.
    pub(crate) fn heading(&self) -> &str {
        match self {
            Self::LowResolution | Self::Truth => "Observations",
            Self::Render => "Renders",
            Self::Error => "Error maps",
            Self::Depth => "Depth maps",
            Self::Metric { title, .. } => title,
        }
    }

    /// Which layers the page lists together.
    pub(crate) fn kind(&self) -> String {
        match self {
            Self::Metric { name, .. } => format!("metric-{name}"),
            _ => self.file_name().to_owned(),
        }
    }

    /// Stem of its originals' names.
    pub(crate) fn file_name(&self) -> &str {
        match self {
            Self::LowResolution => "low-resolution",
            Self::Truth => "ground-truth",
            Self::Render => "render",
            Self::Error => "error",
            Self::Depth => "depth",
            Self::Metric { name, .. } => name,
        }
    }
}
