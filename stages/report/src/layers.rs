use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use artifact::Manifest;
use pixels::{DepthMap, Rgba8, common_range, read_exr, read_png};
use scene::{View, Views};
use serde_json::Value;

use crate::gather::{Report, Row};

/// Pictures of a data set, one per view, such as ground truth or a method's error maps.
pub(crate) struct Layer<'a> {
    pub(crate) label: String,
    pub(crate) group: Group,
    /// Index of the data set in [`Report::scenes`].
    pub(crate) scene: usize,
    /// Indices of the rows that made the pictures: several if their pictures are equal, none for
    /// observations.
    pub(crate) rows: Vec<usize>,
    /// Identity of the pictures: two layers whose pictures are all equal have the same one.
    identity: String,
    source: Source<'a>,
}

/// Label of a method's layers if the page has only one method.
pub(crate) const ONLY_RENDER: &str = "Render";

/// Kinds of pictures.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Group {
    LowResolution,
    Truth,
    Render,
    Error,
    Depth,
    /// Pictures made by a metric.
    Metric {
        name: String,
        title: String,
    },
}

/// Location of a layer's pictures.
enum Source<'a> {
    /// Files of a folder of views; see [`Group::file`].
    Views(Arc<Folder>),
    /// Files of a result, and the JSON pointer of their names in a view's scores.
    Scored(&'a Row<'a>, String),
}

/// A folder of views.
pub(crate) struct Folder {
    path: PathBuf,
    pub(crate) views: Views,
}

impl Folder {
    fn read(path: PathBuf) -> anyhow::Result<Arc<Self>> {
        let views = Views::read_folder(&path)?;
        Ok(Arc::new(Self { path, views }))
    }

    /// Returns the identity of the files that `file` returns for the views.
    fn identity(&self, file: impl Fn(&View) -> Option<&String>) -> String {
        let views = self.views.views.iter();
        let files = views.map(|view| (view.camera.name.as_str(), file(view).map(String::as_str)));
        format!("{:?} {}", self.views.background, files_identity(&self.path, files))
    }

    /// Returns the path of the file of a view that a group displays, if any.
    fn file(&self, view: &str, group: &Group) -> Option<PathBuf> {
        let view = self.views.views.iter().find(|other| other.camera.name == view)?;
        group.file(view).map(|file| self.path.join(file))
    }
}

/// Returns the identity of named files in a folder: their hashes, if the folder is an artifact or a
/// part of one, otherwise their paths.
fn files_identity<'a>(
    folder: &Path,
    files: impl Iterator<Item = (&'a str, Option<&'a str>)>,
) -> String {
    let whole = Manifest::read(folder).ok();
    let part = || {
        let name = folder.file_name()?.to_str()?;
        Some(Manifest::read(folder.parent()?).ok()?.subtree(name))
    };
    let manifest = whole.or_else(part);
    let entries = manifest.iter().flat_map(|manifest| &manifest.files);
    let hashes: BTreeMap<&str, &str> =
        entries.map(|entry| (entry.path.as_str(), entry.blake3.as_str())).collect();
    let mut identity = String::new();
    for (view, file) in files {
        let hash = file.map(|file| {
            hashes
                .get(file)
                .map_or_else(|| folder.join(file).display().to_string(), |hash| (*hash).to_owned())
        });
        identity += &format!("{view}: {hash:?}\n");
    }
    identity
}

impl Layer<'_> {
    fn of_views(
        group: Group,
        folder: &Arc<Folder>,
        label: &str,
        scene: usize,
        rows: &[usize],
    ) -> Self {
        Self {
            label: label.to_owned(),
            identity: folder.identity(|view| group.file(view)),
            group,
            scene,
            rows: rows.to_vec(),
            source: Source::Views(Arc::clone(folder)),
        }
    }

    /// Draws the picture of a view, if available; `range` has the depths that the colour scale
    /// covers.
    pub(crate) fn picture(&self, view: &str, range: (f32, f32)) -> anyhow::Result<Option<Rgba8>> {
        match &self.source {
            Source::Views(folder) => {
                let Some(path) = folder.file(view, &self.group) else { return Ok(None) };
                if self.group != Group::Depth {
                    return Ok(Some(folder.views.read_over(&path)?.to_rgba8()));
                }
                let image = read_exr(&path)?;
                Ok(DepthMap::of(&image).map(|map| map.draw(image.width, range)))
            }
            Source::Scored(row, pointer) => {
                let file = row.view(view).and_then(|scores| scores.pointer(pointer)?.as_str());
                // Scores of other programs may name files that don't exist.
                let path = file.map(|file| row.node.folder.join(file)).filter(|path| path.exists());
                Ok(path.map(|path| read_png(&path)).transpose()?)
            }
        }
    }

    /// Returns the range of the views' depths; `None` for layers without depths.
    pub(crate) fn depth_range<'a>(
        &self,
        views: impl Iterator<Item = &'a String>,
    ) -> anyhow::Result<Option<(f32, f32)>> {
        let (Source::Views(folder), Group::Depth) = (&self.source, &self.group) else {
            return Ok(None);
        };
        let mut ranges = Vec::new();
        for path in views.filter_map(|view| folder.file(view, &self.group)) {
            ranges.extend(DepthMap::of(&read_exr(&path)?).and_then(|map| map.range()));
        }
        Ok(common_range(ranges))
    }
}

/// Returns the number of pixels of a data set's largest view; 1 if unknown.
pub(crate) fn max_pixels(layers: &[Layer<'_>], scene: usize) -> u64 {
    let mut pixels = 1;
    for layer in layers.iter().filter(|layer| layer.scene == scene) {
        let (Source::Views(folder), Group::Truth | Group::Render) = (&layer.source, &layer.group)
        else {
            continue;
        };
        for view in &folder.views.views {
            let intrinsics = view.camera.intrinsics;
            pixels = pixels.max(u64::from(intrinsics.width) * u64::from(intrinsics.height));
        }
    }
    pixels
}

/// Returns all layers: observations first, then those of each method.
pub(crate) fn layers<'a>(report: &'a Report<'a>) -> anyhow::Result<Vec<Layer<'a>>> {
    let mut layers = Vec::new();
    let mut truths: Vec<(PathBuf, usize)> = Vec::new();
    for row in &report.rows {
        let truth = folder_of(report, row, "truth").map(|path| (path, row.scene));
        truths.extend(truth.filter(|truth| !truths.contains(truth)));
    }
    for (path, scene) in truths.iter().filter(|(path, _)| has_views(path)) {
        let folder = Folder::read(path.clone())?;
        add_observations(&mut layers, *scene, &folder, &scored_on(report, path));
    }
    for views in &report.unscored {
        let has_truth = truths.iter().any(|(_, scene)| *scene == views.scene);
        if let Some(truth) = views.truth.clone().filter(|_| !has_truth) {
            add_observations(&mut layers, views.scene, &Folder::read(truth)?, &views.label);
        }
    }
    let mut layers = merge_equal(layers);
    name_observations(&mut layers);
    let mut made = Vec::new();
    for index in 0..report.rows.len() {
        add_method(&mut made, report, index)?;
    }
    for views in &report.unscored {
        let folder = Folder::read(views.folder.clone())?;
        add_views(&mut made, &folder, &views.label, views.scene, &[]);
    }
    let mut made = merge_equal(made);
    for layer in made.iter_mut().filter(|layer| layer.rows.len() > 1) {
        layer.label = format!("{} and {} more", layer.label, layer.rows.len() - 1);
    }
    layers.extend(made);
    Ok(layers)
}

/// Merges layers of one kind with equal pictures, such as those of a sweep over a parameter of the
/// scores.
fn merge_equal(layers: Vec<Layer<'_>>) -> Vec<Layer<'_>> {
    let mut different: Vec<Layer<'_>> = Vec::new();
    for layer in layers {
        let same = different.iter_mut().find(|other| {
            (other.scene, &other.group) == (layer.scene, &layer.group)
                && other.identity == layer.identity
        });
        match same {
            Some(same) => same.rows.extend(layer.rows),
            None => different.push(layer),
        }
    }
    different
}

/// Labels observations by kind, and by result if the data set has several of the kind: "Ground
/// truth" or "Ground truth of RESULT". Before the call, each label is the result's name.
fn name_observations(layers: &mut [Layer<'_>]) {
    let kinds: Vec<(usize, Group)> =
        layers.iter().map(|layer| (layer.scene, layer.group.clone())).collect();
    for layer in layers {
        let name = match layer.group {
            Group::LowResolution => "LR image",
            _ => "Ground truth",
        };
        let same = kinds.iter().filter(|kind| **kind == (layer.scene, layer.group.clone()));
        layer.label =
            if same.count() == 1 { name.to_owned() } else { format!("{name} of {}", layer.label) };
    }
}

/// Adds photographs, ground truth and true depth, if available. `label` names the results that they
/// belong to.
fn add_observations(layers: &mut Vec<Layer<'_>>, scene: usize, folder: &Arc<Folder>, label: &str) {
    for group in [Group::LowResolution, Group::Truth, Group::Depth] {
        if folder.views.views.iter().any(|view| group.file(view).is_some()) {
            layers.push(Layer::of_views(group, folder, label, scene, &[]));
        }
    }
}

/// Adds views and their depths, if available. `rows` are the results that made them.
fn add_views(
    layers: &mut Vec<Layer<'_>>,
    folder: &Arc<Folder>,
    label: &str,
    scene: usize,
    rows: &[usize],
) {
    layers.push(Layer::of_views(Group::Render, folder, label, scene, rows));
    if folder.views.views.iter().any(|view| view.depth.is_some()) {
        layers.push(Layer::of_views(Group::Depth, folder, label, scene, rows));
    }
}

/// Adds a method's renders, depths, error maps and pictures of metrics.
fn add_method<'a>(
    layers: &mut Vec<Layer<'a>>,
    report: &'a Report<'a>,
    index: usize,
) -> anyhow::Result<()> {
    let row = &report.rows[index];
    let label = if report.rows.len() == 1 && report.unscored.is_empty() {
        ONLY_RENDER.to_owned()
    } else {
        row.label.clone()
    };
    if let Some(path) = folder_of(report, row, "views").filter(|path| has_views(path)) {
        add_views(layers, &Folder::read(path)?, &label, row.scene, &[index]);
    }
    let mut scored = vec![(Group::Error, "/error_map".to_owned())];
    for (name, title) in row.metrics.picture_titles() {
        let pointer = format!("/pictures/{}", name.replace('~', "~0").replace('/', "~1"));
        scored.push((Group::Metric { name: name.to_owned(), title: title.to_owned() }, pointer));
    }
    for (group, pointer) in scored {
        let files = row.metrics.views().iter().map(|view| {
            let file = view.pointer(&pointer).and_then(Value::as_str);
            (view["name"].as_str().unwrap_or_default(), file)
        });
        if files.clone().any(|(_, file)| file.is_some()) {
            layers.push(Layer {
                label: label.clone(),
                group,
                scene: row.scene,
                rows: vec![index],
                identity: files_identity(&row.node.folder, files),
                source: Source::Scored(row, pointer),
            });
        }
    }
    Ok(())
}

fn folder_of(report: &Report<'_>, row: &Row<'_>, input: &str) -> Option<PathBuf> {
    row.node.inputs.get(input).map(|input| report.run.folder_of(input))
}

fn has_views(folder: &Path) -> bool {
    folder.join(scene::VIEWS_FILE).is_file()
}

/// Names the rows that are scored on a ground truth.
fn scored_on(report: &Report<'_>, truth: &Path) -> String {
    let rows = report.rows.iter();
    let rows = rows.filter(|row| folder_of(report, row, "truth").as_deref() == Some(truth));
    let labels: Vec<&str> = rows.map(|row| row.label.as_str()).collect();
    match labels.as_slice() {
        [one] => (*one).to_owned(),
        [first, others @ ..] => format!("{first} and {} more", others.len()),
        [] => String::new(),
    }
}

impl Group {
    /// Returns the file of a view that the group displays.
    fn file<'v>(&self, view: &'v View) -> Option<&'v String> {
        match self {
            Self::LowResolution => view.low_resolution.as_ref(),
            Self::Depth => view.depth.as_ref(),
            _ => view.image.as_ref(),
        }
    }

    /// Returns the heading of the group's layers in lists.
    pub(crate) fn heading(&self) -> &str {
        match self {
            Self::LowResolution | Self::Truth => "Observations",
            Self::Render => "Renders",
            Self::Error => "Error maps",
            Self::Depth => "Depth maps",
            Self::Metric { title, .. } => title,
        }
    }

    /// Returns the identifier of the kind of pictures.
    pub(crate) fn kind(&self) -> String {
        match self {
            Self::Metric { name, .. } => format!("metric-{name}"),
            _ => self.file_name().to_owned(),
        }
    }

    /// Returns the stem of the originals' file names.
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
