//! `run --watch` shows a test view of a field during training (docs/design/044). A look creates a
//! field from the latest checkpoint; the plan's own stages then render the view and score it. The
//! training process doesn't take part.
//!
//! * `chain`: the stages that render and score a node's checkpoints.
//! * `single_view`: a folder of views cut to the watched one.
//! * `look_budget`: time of the next look.
//! * `half_blocks`: an image as text.

mod chain;
mod half_blocks;
mod look_budget;
mod single_view;

use artifact::{format_duration, hash_json};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use planning::stage_call::{Call, Display, Watcher, read_summary};
use stage::Event;

pub(crate) use chain::Chain;
use chain::Link;
use half_blocks::half_blocks;
use look_budget::LookBudget;
use single_view::WatchedView;

use crate::publish::remove_folder;

/// Interval between two checks of the next look's time.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);
/// Time limit of a look as a multiple of its expected time (docs/design/044). Watching ends after a
/// longer look: on a CPU the paper's field renders too slowly to be watched.
const MAX_TIME_FACTOR: u32 = 10;
/// Minimum time limit of a look, for busy machines (docs/design/044).
const MIN_TIME_LIMIT: Duration = Duration::from_secs(60);

/// Options of `--watch`.
pub(crate) struct Watch {
    /// Name of the test view; empty for the first view.
    pub(crate) view: String,
    /// Folder of the pictures.
    pub(crate) folder: PathBuf,
}

/// A watched training.
pub(crate) struct Watching<'a> {
    pub(crate) watch: &'a Watch,
    pub(crate) chain: &'a Chain<'a>,
    pub(crate) label: &'a str,
    /// Temporary folder of this training's looks, removed when the training ends.
    pub(crate) scratch: PathBuf,
    pub(crate) display: &'a Display,
    /// True after the training has ended.
    pub(crate) is_over: &'a AtomicBool,
}

impl Watching<'_> {
    /// Takes looks until `training` ends, and shows each. An error is printed and ends watching;
    /// training continues.
    pub(crate) fn run(&self, training: &Call<'_>) {
        if let Err(problem) = self.take_looks(training) {
            self.display.line(&format!("{}: {problem:#}", self.label));
        }
        // Leftovers have no value. The parent folder may contain those of other training runs.
        std::fs::remove_dir_all(&self.scratch).ok();
        self.scratch.parent().map(std::fs::remove_dir);
    }

    fn take_looks(&self, training: &Call<'_>) -> anyhow::Result<()> {
        let view = WatchedView::find(self.chain, &self.watch.view).context("not watched")?;
        let begin = Instant::now();
        let mut budget = LookBudget::new(training.threads, view.pixels);
        while !self.is_over.load(Ordering::Relaxed) {
            if begin.elapsed() < budget.next_due() {
                std::thread::sleep(CHECK_INTERVAL);
                continue;
            }
            let started = Instant::now();
            let limit = MIN_TIME_LIMIT.max(budget.expected() * MAX_TIME_FACTOR);
            let look = Look { watching: self, view: &view, deadline: started + limit };
            match look.take(training) {
                Ok(Some(processor)) => budget.record_look(processor),
                Ok(None) => budget.record_miss(started.elapsed()),
                Err(_) if self.is_over.load(Ordering::Relaxed) => return Ok(()),
                Err(_) if Instant::now() >= look.deadline => {
                    let limit = format_duration(limit.as_secs_f64());
                    anyhow::bail!("no longer watched: view {} takes more than {limit}", view.name);
                }
                Err(failure) => return Err(failure).context("no longer watched"),
            }
        }
        Ok(())
    }
}

/// Returns the name of the temporary folder of a training's looks: a label may contain slashes.
pub(crate) fn scratch_name(label: &str) -> String {
    format!("watch-{}", hash_json(&label))
}

/// Returns the picture's file name: the label with `_` for each special character.
fn picture_file_name(label: &str) -> String {
    let plain = label.replace(|c: char| !(c.is_alphanumeric() || "-_=.,".contains(c)), "_");
    format!("{}.png", plain.trim_end_matches('_'))
}

/// Returns `: SCORES (FIELD)` for the summaries of a field and of its scores, without one that is
/// empty.
fn summary_text(field: &str, scores: &str) -> String {
    let mut text = String::new();
    if !scores.is_empty() {
        text += &format!(": {scores}");
    }
    if !field.is_empty() {
        text += &format!(" ({field})");
    }
    text
}

/// One look at the latest checkpoint.
struct Look<'a> {
    watching: &'a Watching<'a>,
    view: &'a WatchedView,
    deadline: Instant,
}

impl Look<'_> {
    /// Takes the look and shows it. Returns its processor time; `None` if the stage can't create a
    /// field, usually because no checkpoint exists yet.
    fn take(&self, training: &Call<'_>) -> anyhow::Result<Option<Duration>> {
        let scratch = &self.watching.scratch;
        remove_folder(scratch)
            .and_then(|()| std::fs::create_dir_all(scratch))
            .with_context(|| scratch.display().to_string())?;
        let [field, views, scores] =
            ["field", "views", "scores"].map(|folder| scratch.join(folder));
        let call =
            Call { output: &field, from_checkpoint: true, threads: 1, lock: None, ..*training };
        let Ok(reading) = self.call(&call) else { return Ok(None) };
        let Chain { render, score } = self.watching.chain;
        let rendering = self.call_link(render, "render", &field, &views)?;
        let scoring = self.call_link(score, "score", &views, &scores)?;
        // Stages needn't write a summary.
        let [field, scores] =
            [field, scores].map(|output| read_summary(&output).unwrap_or_default());
        self.show(&views.join(scene::preview_file(&self.view.name)), field.trim(), scores.trim())?;
        Ok(Some(reading + rendering + scoring))
    }

    /// Prints the summaries of the field and the scores, and copies the picture to the folder of
    /// pictures.
    fn show(&self, rendered: &Path, field: &str, scores: &str) -> anyhow::Result<()> {
        let Watching { watch, label, display, .. } = self.watching;
        let picture = watch.folder.join(picture_file_name(label));
        let partial = picture.with_extension("partial");
        std::fs::create_dir_all(&watch.folder)
            .and_then(|()| std::fs::copy(rendered, &partial))
            .and_then(|_| std::fs::rename(&partial, &picture))
            .with_context(|| picture.display().to_string())?;
        if std::env::var_os("NO_COLOR").is_none()
            && let Ok(image) = pixels::read_png(&picture)
        {
            display.picture(|columns, rows| half_blocks(&image, columns, rows));
        }
        let (view, picture) = (&self.view.name, picture.display());
        display.line(&format!("{label}: view {view}{}: {picture}", summary_text(field, scores)));
        Ok(())
    }

    /// Calls a block with the previous block's output; the other inputs are cut to the watched
    /// view. Returns the processor time.
    fn call_link(
        &self,
        link: &Link<'_>,
        name: &str,
        previous: &Path,
        output: &Path,
    ) -> anyhow::Result<Duration> {
        let scratch = self.watching.scratch.join(format!("{name}-inputs"));
        let params = scratch.join("params.json");
        std::fs::create_dir_all(&scratch)
            .and_then(|()| artifact::write_json(&params, &link.node.parameters))
            .with_context(|| params.display().to_string())?;
        let mut inputs = vec![(link.chained_input.to_owned(), previous.to_path_buf())];
        for (input, folder) in &link.inputs {
            let cut = scratch.join(input);
            self.view.copy_cut(folder, &cut).with_context(|| cut.display().to_string())?;
            inputs.push(((*input).to_owned(), cut));
        }
        self.call(&Call {
            label: self.watching.label,
            program: &link.node.program.path,
            description: &link.node.program.description,
            params: &params,
            inputs: &inputs,
            hashes: &[],
            output,
            work: None,
            from_checkpoint: false,
            device: link.device,
            threads: 1,
            lock: None,
        })
    }

    /// Calls a stage and returns its processor time.
    fn call(&self, call: &Call<'_>) -> anyhow::Result<Duration> {
        let stop = AtomicBool::new(false);
        let deadline = StopAtDeadline { look: self, stop: &stop };
        let (usage, result) = call.run(&self.watching.scratch.join("log"), &deadline, &stop);
        result?;
        Ok(Duration::from_secs_f64(usage.processor_seconds))
    }
}

/// Stops a call when the training has ended or the deadline has passed. Prints nothing.
struct StopAtDeadline<'a> {
    look: &'a Look<'a>,
    stop: &'a AtomicBool,
}

impl Watcher for StopAtDeadline<'_> {
    fn progress(&self, _: &Event) {}

    fn stderr_line(&self, _: &str) {}

    fn tick(&self) {
        let is_over = self.look.watching.is_over.load(Ordering::Relaxed);
        if is_over || Instant::now() >= self.look.deadline {
            self.stop.store(true, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{picture_file_name, scratch_name, summary_text};

    #[test]
    fn missing_summaries_are_left_out() {
        for (field, scores, expected) in [
            ("100 rays", "PSNR 20.0", ": PSNR 20.0 (100 rays)"),
            ("", "PSNR 20.0", ": PSNR 20.0"),
            ("", "", ""),
        ] {
            assert_eq!(summary_text(field, scores), expected);
        }
    }

    #[test]
    fn labels_become_file_names() {
        assert_eq!(picture_file_name("train-ss"), "train-ss.png");
        assert_eq!(
            picture_file_name("train-ss [supersample=2 a/b]"),
            "train-ss__supersample=2_a_b.png"
        );
        let (name, other) = (scratch_name("a [b=../c/d]"), scratch_name("a [b=.._c_d]"));
        assert!(!name.contains('/') && name != other, "{name}");
    }
}
