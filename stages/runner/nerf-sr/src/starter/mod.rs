//! First pipeline for a folder of posed photographs, as `nerf-sr init` writes it (docs/design/040).
//!
//! * [`Starter`]: summary of the folder, and a complete, commented pipeline file for it.
//! * [`Starter::write`]: writes the pipeline file and, next to it, `pipelines/` and `experiments/`
//!   with the shipped targets. Existing files are never overwritten.
//!
//! If every image is wider than [`MAX_WIDTH`] pixels, all are shrunk first: on a CPU, training on
//! photographs of twelve million pixels takes hours. Otherwise, only images of a benchmark are
//! downscaled, for training.

mod unposed;

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use artifact::{Failure, bail_bad_input, bail_usage, format_count};
use dataset::{Dataset, DatasetError, Frame};

use unposed::UnposedImages;

/// Width in pixels to which images are shrunk if all are wider. Chosen by hand: a CPU trains on
/// larger ones for hours.
pub(crate) const MAX_WIDTH: u32 = 800;
/// HR width divided by LR width, chosen by hand.
const SCALE: u32 = 2;
/// Folders, file names and texts of the shipped targets (`pipelines/` and `experiments/` of the
/// repository).
const TARGETS: &[(&str, &str, &str)] = include!(concat!(env!("OUT_DIR"), "/targets.rs"));

/// Pipeline for a data set, not written yet.
#[derive(Clone, Debug)]
pub(crate) struct Starter {
    /// Format of the data set, and number and size of its photographs.
    pub(crate) summary: String,
    /// Widths of photographs, training images and views as text.
    pub(crate) sizes: String,
    /// Notes of the data set, such as lens distortion, one line each.
    pub(crate) notes: Vec<String>,
    text: String,
    /// Path of the data set as YAML.
    dataset: String,
    file: PathBuf,
}

impl Starter {
    /// Reads a folder of posed photographs and composes the pipeline `file` for it.
    pub(crate) fn new(folder: &Path, file: &Path) -> anyhow::Result<Self> {
        if !folder.exists() {
            bail_bad_input!("{}: no such folder", folder.display());
        }
        let set = Dataset::read(folder).map_err(|error| read_failure(folder, &error))?;
        let parent = file.parent().filter(|parent| !parent.as_os_str().is_empty());
        let dataset = data_path(folder, parent.unwrap_or(Path::new(".")))?;
        let (summary, sizes) = (summarize(&set), sizes(&set));
        let text = pipeline_text(&set, &format!("{summary}\n# {sizes}"), &dataset);
        Ok(Self { summary, sizes, notes: set.notes, text, dataset, file: file.to_path_buf() })
    }

    /// Writes the pipeline file and, in folders next to it, the shipped targets. Returns the
    /// written files. Writes nothing if any of them exists.
    pub(crate) fn write(&self) -> anyhow::Result<Vec<PathBuf>> {
        let name = self.file.file_name().unwrap_or_default().to_string_lossy();
        let mut files = vec![(self.file.clone(), self.text.clone())];
        for (folder, target, text) in TARGETS {
            let text = text.replace("../pipeline.yaml", &format!("../{name}"));
            let text = own_scene(&text, &self.dataset);
            files.push((self.file.with_file_name(folder).join(target), text));
        }
        if let Some((file, _)) = files.iter().find(|(file, _)| fs::symlink_metadata(file).is_ok()) {
            bail_usage!(
                "{} exists and was not changed; run `nerf-sr init` in a new folder",
                file.display()
            );
        }
        for (file, text) in &files {
            let folder = file.parent().unwrap_or(Path::new(""));
            fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
            fs::File::create_new(file)
                .and_then(|mut created| created.write_all(text.as_bytes()))
                .with_context(|| file.display().to_string())?;
        }
        Ok(files.into_iter().map(|(file, _)| file).collect())
    }
}

/// Returns a shipped target's text for the pipeline's own data set: experiments run on this scene
/// by default.
fn own_scene(text: &str, dataset: &str) -> String {
    // Paths in the file start from its folder.
    let path = serde_json::from_str(dataset).unwrap_or_else(|_| dataset.to_owned());
    let path = path.strip_prefix("./").map_or(path.clone(), |inside| format!("./../{inside}"));
    let path = serde_json::json!(path).to_string();
    let lines = text.lines().map(|line| {
        if line.starts_with("  scenes: [") {
            "  scenes: [demo] # the pipeline's own; others with --data DIR --scene NAME".to_owned()
        } else {
            line.replace("dataset: demo-scene", &format!("dataset: {path}"))
        }
    });
    lines.map(|line| line + "\n").collect()
}

/// Returns the YAML text for the data set's folder in a pipeline file of the folder `parent`: a
/// relative path if the data set is inside `parent`, otherwise an absolute one.
fn data_path(folder: &Path, parent: &Path) -> anyhow::Result<String> {
    let data = folder.canonicalize().with_context(|| folder.display().to_string())?;
    let parent = parent.canonicalize().with_context(|| parent.display().to_string())?;
    if parent.starts_with(&data) {
        bail_usage!(
            "{}: the pipeline and its results can't be inside the data set; change to another \
            folder, such as the parent",
            folder.display()
        );
    }
    let path = match data.strip_prefix(&parent) {
        Ok(relative) => Path::new(".").join(relative),
        Err(_) => data,
    };
    let Some(text) = path.to_str() else {
        bail_usage!("{}: path isn't UTF-8; rename the folder", folder.display());
    };
    if text.chars().all(|c| c.is_alphanumeric() || "./_-+".contains(c)) {
        return Ok(text.to_owned());
    }
    // A JSON string is a YAML string, too.
    Ok(serde_json::json!(text).to_string())
}

/// Returns the format of a data set, and number and size of its photographs, as text.
fn summarize(set: &Dataset) -> String {
    let size = match common_size(set) {
        Some((width, height)) => format!(" of {width}×{height}"),
        None => " of several sizes".to_owned(),
    };
    format!("{}: {}{size}", set.format.title(), format_count(set.frames.len(), "photograph"))
}

/// Returns the size of the photographs if all have the same.
fn common_size(set: &Dataset) -> Option<(u32, u32)> {
    let mut sizes = set.frames.iter().map(Frame::intrinsics).map(|i| (i.width, i.height));
    let first = sizes.next()?;
    sizes.all(|size| size == first).then_some(first)
}

/// Returns the widths of photographs, training images and views as text, and the width of views
/// with `lr_source=photographs`.
fn sizes(set: &Dataset) -> String {
    let size = common_size(set);
    let (photographs, unshrunk_views) = match size {
        Some((width, height)) => {
            (format!("photographs {width}×{height}"), format!("views at {}", width * SCALE))
        }
        None => (
            "photographs of several sizes".to_owned(),
            format!("views {SCALE} times as wide as each photograph"),
        ),
    };
    let training = match (ImageSource::of(set), size) {
        (ImageSource::Shrunk, _) => {
            format!("training at {}, views at {MAX_WIDTH}", MAX_WIDTH / SCALE)
        }
        (ImageSource::Benchmark, Some((width, _))) => {
            format!("training at {}, views at {width}", width / SCALE)
        }
        (ImageSource::Benchmark, None) => {
            format!("training at 1/{SCALE} of their size, views at their size")
        }
        (ImageSource::Photographs, _) => {
            return format!("{photographs}; training at their size, {unshrunk_views}");
        }
    };
    format!("{photographs}; {training}; `-p lr_source=photographs` gives {unshrunk_views}")
}

/// Source of LR images that [`image_parameters`] selects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ImageSource {
    /// Photographs wider than [`MAX_WIDTH`]: shrunk to it for scoring, and by [`SCALE`] more for
    /// training.
    Shrunk,
    /// Images of a benchmark, downscaled.
    Benchmark,
    /// Unmodified photographs.
    Photographs,
}

impl ImageSource {
    fn of(set: &Dataset) -> Self {
        // The narrowest image decides, since images are never enlarged.
        let width = set.frames.iter().map(|frame| frame.intrinsics().width).min().unwrap_or(0);
        if width > MAX_WIDTH {
            Self::Shrunk
        } else if set.format.is_benchmark() {
            Self::Benchmark
        } else {
            Self::Photographs
        }
    }
}

fn pipeline_text(set: &Dataset, found: &str, dataset: &str) -> String {
    let is_irregular = set.frames.iter().any(|frame| frame.camera().check().is_err());
    let lens = if is_irregular {
        "\n      lens: undo # some lens distortion can't be modelled up to the border; photographs \
        are undistorted and lose a border"
    } else {
        ""
    };
    let split = match &set.split {
        Some(split) if !split.test.is_empty() => "the default uses the data set's own test views",
        _ => "by default every eighth view is for testing only",
    };
    include_str!("pipeline.yaml")
        .replace("{found}", found)
        .replace("{scale}", &SCALE.to_string())
        .replace("{images}", &image_parameters(set))
        .replace("{lens}", lens)
        .replace("{split}", split)
        // Last, since a folder's name may contain braces.
        .replace("{dataset}", dataset)
}

/// Returns the YAML lines of the parameters that select the source of LR images.
fn image_parameters(set: &Dataset) -> String {
    match ImageSource::of(set) {
        ImageSource::Shrunk => {
            let lr_width = MAX_WIDTH / SCALE;
            format!(
                "      lr_width: {lr_width} # photographs are shrunk to {MAX_WIDTH} pixels for \
                scoring and to {lr_width} for training, which takes minutes on a CPU\n      \
                # lr_source: photographs # overrides lr_width: trains on the unmodified photographs"
            )
        }
        ImageSource::Benchmark => {
            "      lr_source: downscaled # LR images are made from the data set's images; \
            `photographs` trains on the unmodified images"
                .to_owned()
        }
        ImageSource::Photographs => {
            "      lr_source: photographs # trains on the unmodified photographs; `downscaled` \
            makes LR images from them first, so that views can be scored"
                .to_owned()
        }
    }
}

/// Converts an error of the data set's reader: if the folder contains images, the message names the
/// command that estimates their cameras.
fn read_failure(folder: &Path, error: &DatasetError) -> Failure {
    let is_unrecognised = matches!(error, DatasetError::Unrecognised(_));
    let images = UnposedImages::find(folder).filter(|_| is_unrecognised);
    let Some(images) = images else { return Failure::BadInput(error.to_string()) };
    let remedy = if images.files.len() == 1 {
        "give several photographs, taken from different positions".to_owned()
    } else {
        format!("estimate them with COLMAP: {}", images.colmap_instructions(folder))
    };
    let (folder, summary) = (folder.display(), images.summary());
    Failure::BadInput(format!("{folder}: {summary}, but no cameras; {remedy}"))
}

#[cfg(test)]
mod tests;
