//! `run --watch`: shows a test view of a field in training. A look makes a field of the latest
//! checkpoint; the plan's own stages then render the view and score it. The training process
//! doesn't take part.
//!
//! * `chain`: the stages that render and score a node's checkpoints.
//! * `one_view`: a folder of views with only one of them.
//! * `budget`: when the next look is due.
//! * `half_blocks`: a picture as text.

mod budget;
mod chain;
mod half_blocks;
mod one_view;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use stage::{Event, SUMMARY_FILE};
use stage_call::{Call, Display, StageFailure, Watcher, seconds};

use budget::LookBudget;
pub(crate) use chain::Chain;
use chain::Link;
use half_blocks::half_blocks;
use one_view::OneView;

/// Interval between two checks whether a look is due.
const TICK: Duration = Duration::from_millis(50);
/// Limit of a look, as a multiple of its expected time. Beyond it the watching ends: on a CPU the
/// paper's field is too slow to watch.
const MOST_EXPECTED_TIMES: u32 = 10;
/// The limit is at least so long, for busy machines.
const LEAST_TIME_LIMIT: Duration = Duration::from_secs(60);

/// The options of `--watch`.
pub(crate) struct Watch {
    /// The test view's name; empty for the first view.
    pub(crate) view: String,
    /// Folder of the pictures.
    pub(crate) folder: PathBuf,
}

/// A training that is watched.
pub(crate) struct Watching<'a> {
    pub(crate) watch: &'a Watch,
    pub(crate) chain: &'a Chain,
    pub(crate) label: &'a str,
    /// A temporary folder for this training's looks, removed when the training ends.
    pub(crate) scratch: PathBuf,
    pub(crate) display: &'a Display,
    /// Whether the training has ended.
    pub(crate) is_over: &'a AtomicBool,
}

impl Watching<'_> {
    /// Takes looks until `training` ends, and shows each. An error is printed and ends the
    /// watching; the training goes on.
    pub(crate) fn run(&self, training: &Call<'_>) {
        if let Err(problem) = self.look_on(training) {
            self.display.line(&format!("{}: {problem:#}", self.label));
        }
        // Leftovers have no value; the run's folder may hold those of others.
        std::fs::remove_dir_all(&self.scratch).ok();
        self.scratch.parent().map(std::fs::remove_dir);
    }

    fn look_on(&self, training: &Call<'_>) -> anyhow::Result<()> {
        let view = OneView::find(self.chain, &self.watch.view).context("not watched")?;
        let begin = Instant::now();
        let mut budget = LookBudget::new(training.threads, view.pixels);
        while !self.is_over.load(Ordering::Relaxed) {
            if begin.elapsed() < budget.next() {
                std::thread::sleep(TICK);
                continue;
            }
            let (started, limit) =
                (Instant::now(), LEAST_TIME_LIMIT.max(budget.expected() * MOST_EXPECTED_TIMES));
            let look = Look { watching: self, view: &view, deadline: started + limit };
            match look.at(training) {
                Ok(Some(seen)) => {
                    budget.took(seen.processor);
                    self.show(&seen, &view.name)?;
                }
                Ok(None) => budget.wasted(started.elapsed()),
                Err(_) if self.is_over.load(Ordering::Relaxed) => return Ok(()),
                Err(_) if Instant::now() >= look.deadline => {
                    let limit = seconds(limit.as_secs_f64());
                    anyhow::bail!("no longer watched: view {} takes {limit}", view.name);
                }
                Err(failure) => return Err(failure).context("no longer watched"),
            }
        }
        Ok(())
    }

    /// Prints the scores and writes the picture to the folder of pictures.
    fn show(&self, seen: &Seen, view: &str) -> anyhow::Result<()> {
        let folder = &self.watch.folder;
        let picture = folder.join(file_name(self.label));
        let beside = picture.with_extension("partial");
        std::fs::create_dir_all(folder)
            .and_then(|()| std::fs::copy(&seen.picture, &beside))
            .and_then(|_| std::fs::rename(&beside, &picture))
            .with_context(|| format!("no longer watched: {}", picture.display()))?;
        if std::env::var_os("NO_COLOR").is_none()
            && let Ok(image) = pixels::read_png(&picture)
        {
            self.display.picture(|columns, rows| half_blocks(&image, columns, rows));
        }
        let Seen { field, scores, .. } = seen;
        let (label, picture) = (self.label, picture.display());
        self.display.line(&format!("{label}: view {view}: {scores} ({field}): {picture}"));
        Ok(())
    }
}

/// The picture's file name: the label with `_` for each character that isn't plain.
fn file_name(label: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "-_=.,".contains(c);
    label.replace(|c| !is_plain(c), "_").trim_end_matches('_').to_owned() + ".png"
}

/// One look at the latest checkpoint.
struct Look<'a> {
    watching: &'a Watching<'a>,
    view: &'a OneView,
    deadline: Instant,
}

/// A look's result.
struct Seen {
    picture: PathBuf,
    /// The field so far, in words.
    field: String,
    /// The view's scores, in words.
    scores: String,
    /// Processor time of the look.
    processor: Duration,
}

impl Look<'_> {
    /// None where the stage makes no field of a checkpoint, mostly because there is none yet.
    fn at(&self, training: &Call<'_>) -> Result<Option<Seen>, StageFailure> {
        let scratch = &self.watching.scratch;
        if scratch.exists() {
            std::fs::remove_dir_all(scratch).map_err(|e| StageFailure::at(scratch, &e))?;
        }
        std::fs::create_dir_all(scratch).map_err(|e| StageFailure::at(scratch, &e))?;
        let [field, views, scores] =
            ["field", "views", "scores"].map(|folder| scratch.join(folder));
        let call =
            Call { output: &field, from_checkpoint: true, threads: 1, lock: None, ..*training };
        let Ok(reading) = self.call(&call) else { return Ok(None) };
        let Chain { render, score } = self.watching.chain;
        let rendering = self.follow(render, "render", &field, &views)?;
        let scoring = self.follow(score, "score", &views, &scores)?;
        Ok(Some(Seen {
            // As `scene::preview_file` has it, which the runner doesn't link.
            picture: views.join(format!("previews/{}.png", self.view.name)),
            field: summary(&field)?,
            scores: summary(&scores)?,
            processor: reading + rendering + scoring,
        }))
    }

    /// Calls a stage with the previous stage's output; other inputs are cut to the watched view.
    fn follow(
        &self,
        link: &Link,
        name: &str,
        fed: &Path,
        output: &Path,
    ) -> Result<Duration, StageFailure> {
        let scratch = self.watching.scratch.join(format!("{name}-inputs"));
        let params = scratch.join("params.json");
        std::fs::create_dir_all(&scratch)
            .and_then(|()| artifact::write_json(&params, &link.parameters))
            .map_err(|e| StageFailure::at(&params, &e))?;
        let mut inputs = vec![(link.fed.clone(), fed.to_path_buf())];
        for (input, folder) in &link.inputs {
            let cut = scratch.join(input);
            self.view.of(folder, &cut).map_err(|e| StageFailure::at(&cut, &e))?;
            inputs.push((input.clone(), cut));
        }
        self.call(&Call {
            label: self.watching.label,
            program: &link.program.path,
            description: &link.program.description,
            params: &params,
            inputs: &inputs,
            hashes: &[],
            output,
            work: None,
            from_checkpoint: false,
            device: &link.device,
            threads: 1,
            lock: None,
        })
    }

    /// Calls a stage and returns its processor time.
    fn call(&self, call: &Call<'_>) -> Result<Duration, StageFailure> {
        let stop = AtomicBool::new(false);
        let end = EndInTime { look: self, stop: &stop };
        let usage = call.run(&self.watching.scratch.join("log"), &end, &stop)?;
        Ok(Duration::from_secs_f64(usage.processor_seconds))
    }
}

/// A stage's few words on its result.
fn summary(output: &Path) -> Result<String, StageFailure> {
    let file = output.join(SUMMARY_FILE);
    let text = std::fs::read_to_string(&file).map_err(|e| StageFailure::at(&file, &e))?;
    Ok(text.trim().to_owned())
}

/// Stops a call when the training has ended or the deadline has passed. Prints nothing.
struct EndInTime<'a> {
    look: &'a Look<'a>,
    stop: &'a AtomicBool,
}

impl Watcher for EndInTime<'_> {
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
    use super::file_name;

    #[test]
    fn labels_become_names_of_files() {
        assert_eq!(file_name("train-ss"), "train-ss.png");
        assert_eq!(file_name("train-ss [supersample=2 a/b]"), "train-ss__supersample=2_a_b.png");
    }
}
