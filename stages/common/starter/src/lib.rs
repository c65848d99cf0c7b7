//! The first pipeline for a folder of posed photographs: what `nerf-sr init` writes.
//!
//! * [`Starter`]: the form of the folder, in words, and a commented pipeline file for it. The file
//!   is whole: it runs as it is.
//! * [`Starter::write`]: the pipeline, and beside it `pipelines/` with the shipped further targets.
//!   Nothing that is there is overwritten.
//!
//! Images up to [`LARGEST_WIDTH`] pixels wide keep their size. Larger ones are shrunk first: on a
//! CPU, training on twelve million pixels a photograph takes hours.
//!
//! ```no_run
//! let starter = starter::Starter::new("photographs".as_ref(), "pipeline.yaml".as_ref())?;
//! println!("{}", starter.found());
//! starter.write()?;
//! # Ok::<(), starter::StarterError>(())
//! ```

mod pictures;

use std::fs;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use artifact::counted;
use dataset::{Dataset, DatasetError, Frame};

use pictures::Pictures;

/// Widest images, in pixels, that keep their size.
pub const LARGEST_WIDTH: u32 = 800;
/// HR width over LR width.
const SCALE: u32 = 2;
/// Rays of the training.
const TRAINING_RAYS: u64 = 20_000_000;
/// The shipped further targets, `pipelines/` of the repository: file names and texts.
const TARGETS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/targets.rs"));

/// A pipeline for a data set, not written yet.
#[derive(Clone, Debug)]
pub struct Starter {
    found: String,
    notes: Vec<String>,
    text: String,
    file: PathBuf,
}

/// Why there is no pipeline.
#[derive(Debug, thiserror::Error)]
pub enum StarterError {
    /// The folder holds no data set.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The folder holds images whose cameras aren't known.
    #[error(
        "{}: {found}, but no cameras; COLMAP finds them: {command}", folder.display()
    )]
    NoCameras {
        /// The folder.
        folder: PathBuf,
        /// What it holds, in words.
        found: String,
        /// The command that finds the cameras.
        command: String,
    },
    /// The pipeline would lie among the images.
    #[error(
        "{}: the pipeline and its results can't lie among the data; go to another folder first, \
        such as the one above",
        folder.display()
    )]
    Inside {
        /// The data's folder.
        folder: PathBuf,
    },
    /// A path can't stand in a pipeline file.
    #[error("{}: a pipeline file names folders in UTF-8; rename the folder", folder.display())]
    Name {
        /// The data's folder.
        folder: PathBuf,
    },
    /// A file is there already.
    #[error(
        "{} is there already and stays as it is; call `nerf-sr init` in a new folder",
        file.display()
    )]
    There {
        /// The file.
        file: PathBuf,
    },
    /// A file can't be written.
    #[error("{}: {source}", file.display())]
    Io {
        /// The file.
        file: PathBuf,
        /// Why.
        source: io::Error,
    },
}

impl Starter {
    /// Looks at a folder of posed photographs; `file` is the pipeline file to be.
    pub fn new(folder: &Path, file: &Path) -> Result<Self, StarterError> {
        let set = Dataset::read(folder).map_err(|error| without_cameras(folder, error))?;
        let home = file.parent().filter(|home| !home.as_os_str().is_empty());
        let named = named(folder, home.unwrap_or(Path::new(".")))?;
        let found = found(&set);
        let text = text(&set, &found, &named);
        Ok(Self { found, notes: set.notes, text, file: file.to_path_buf() })
    }

    /// The folder's form, and number and size of its photographs.
    pub fn found(&self) -> &str {
        &self.found
    }

    /// What is special about the photographs, a line each.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Writes the pipeline and, in `pipelines/` beside it, the further targets, unless one of these
    /// files is there. Returns the written files.
    pub fn write(&self) -> Result<Vec<PathBuf>, StarterError> {
        let shelf = self.file.with_file_name("pipelines");
        let name = self.file.file_name().unwrap_or_default().to_string_lossy();
        let targets = TARGETS.iter().map(|(target, text)| {
            (shelf.join(target), text.replace("../pipeline.yaml", &format!("../{name}")))
        });
        let files: Vec<(PathBuf, String)> =
            [(self.file.clone(), self.text.clone())].into_iter().chain(targets).collect();
        if let Some((file, _)) = files.iter().find(|(file, _)| fs::symlink_metadata(file).is_ok()) {
            return Err(StarterError::There { file: file.clone() });
        }
        let fail = |file: &Path, source| StarterError::Io { file: file.to_path_buf(), source };
        fs::create_dir_all(&shelf).map_err(|e| fail(&shelf, e))?;
        for (file, text) in &files {
            let written = fs::File::create_new(file).and_then(|mut f| f.write_all(text.as_bytes()));
            written.map_err(|e| fail(file, e))?;
        }
        Ok(files.into_iter().map(|(file, _)| file).collect())
    }
}

/// The data's folder as a pipeline file in `home` names it: relative where the data lie below.
fn named(folder: &Path, home: &Path) -> Result<String, StarterError> {
    let (data, home) = (absolute(folder)?, absolute(home)?);
    if home.starts_with(&data) {
        return Err(StarterError::Inside { folder: folder.to_path_buf() });
    }
    let path = match data.strip_prefix(&home) {
        Ok(below) => Path::new(".").join(below),
        Err(_) => data.clone(),
    };
    let text = path.to_str().ok_or_else(|| StarterError::Name { folder: folder.to_path_buf() })?;
    // A JSON string is a YAML string, too.
    let plain = |c: char| c.is_alphanumeric() || "./_-+".contains(c);
    Ok(if text.chars().all(plain) { text.to_owned() } else { serde_json::json!(text).to_string() })
}

fn absolute(path: &Path) -> Result<PathBuf, StarterError> {
    path.canonicalize().map_err(|source| StarterError::Io { file: path.to_path_buf(), source })
}

/// A data set's form, and number and size of its photographs, in words.
fn found(set: &Dataset) -> String {
    let sizes = || set.frames.iter().map(Frame::intrinsics);
    let size = sizes().next().map(|size| format!("{}×{}", size.width, size.height));
    let alike =
        sizes().zip(sizes().skip(1)).all(|(a, b)| (a.width, a.height) == (b.width, b.height));
    let of = match size {
        Some(size) if alike => format!(" of {size}"),
        _ => " of several sizes".to_owned(),
    };
    format!("{}: {}{of}", set.format.title(), counted(set.frames.len(), "photograph"))
}

fn text(set: &Dataset, found: &str, dataset: &str) -> String {
    let is_bent = set.frames.iter().any(|frame| frame.camera().check().is_err());
    let lens = if is_bent {
        "\n      lens: undo # the lenses' distortion can't be followed everywhere; photographs \
        lose a border"
    } else {
        ""
    };
    let split = match &set.split {
        Some(split) if !split.test.is_empty() => {
            "left out, the data set's own test views are tested"
        }
        _ => "left out, every eighth view is only tested",
    };
    include_str!("pipeline.yaml")
        .replace("{found}", found)
        .replace("{scale}", &SCALE.to_string())
        .replace("{images}", &images(set))
        .replace("{lens}", lens)
        .replace("{split}", split)
        .replace("{rays}", &TRAINING_RAYS.to_string())
        // Last: what a folder is called is no part of the template.
        .replace("{dataset}", dataset)
}

/// The parameters that say where LR images come from.
fn images(set: &Dataset) -> String {
    let width = set.frames.iter().map(|frame| frame.intrinsics().width).min().unwrap_or(0);
    if width > LARGEST_WIDTH {
        let (lr, hr) = (LARGEST_WIDTH / SCALE, LARGEST_WIDTH);
        format!(
            "      lr_width: {lr} # images are shrunk to {hr} pixels, and to {lr} to train on: \
            views can be scored, and a CPU is done in minutes\n      \
            # lr_source: photographs # instead of lr_width: trains on the photographs as they are"
        )
    } else if set.format.is_benchmark() {
        "      lr_source: downscaled # LR images are made from these; `photographs` trains on them \
        as they are"
            .to_owned()
    } else {
        "      lr_source: photographs # they are trained on as they are; `downscaled` makes LR \
        images from them first, to score views"
            .to_owned()
    }
}

/// What to say of a folder without a data set: where it holds images, how to find their cameras.
fn without_cameras(folder: &Path, error: DatasetError) -> StarterError {
    let pictures = Pictures::of(folder);
    if !matches!(error, DatasetError::Unknown { nearby: None, .. }) || pictures.count() == 0 {
        return StarterError::Dataset(error);
    }
    StarterError::NoCameras {
        folder: folder.to_path_buf(),
        found: pictures.found(),
        command: pictures.command(folder),
    }
}

#[cfg(test)]
mod tests;
