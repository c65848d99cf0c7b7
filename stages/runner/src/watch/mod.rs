//! `run --watch`: one test view of a field while the field trains. The plan's own stages render it
//! from the latest checkpoint and score it; the training stage is neither asked nor disturbed, and
//! never gets that view.
//!
//! * `chain`: which stages of the plan show a node's checkpoints.
//! * `one_view`: a folder of views with only one of them.
//! * `pace`: how often there is time to look.
//! * `half_blocks`: a picture as text.

mod chain;
mod half_blocks;
mod one_view;
mod pace;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use artifact::{Event, SUMMARY_FILE};
use stage_call::{Call, Display, StageFailure, Watcher, seconds};

pub(crate) use chain::Chain;
use chain::Step;
use half_blocks::half_blocks;
use one_view::OneView;
use pace::Pace;

/// How often it is looked whether it is time.
const TICK: Duration = Duration::from_millis(50);
/// A look that takes so many times what was expected is given up, and so is watching: some fields
/// take hours a view.
const MOST: u32 = 10;

/// What `--watch` asks for.
pub(crate) struct Watch {
    /// The view's name; empty for the first.
    pub(crate) view: String,
    /// Folder of the pictures.
    pub(crate) folder: PathBuf,
}

/// A training that is watched.
pub(crate) struct Watching<'a> {
    pub(crate) watch: &'a Watch,
    pub(crate) chain: &'a Chain,
    pub(crate) label: &'a str,
    /// A folder of its own, removed at the end.
    pub(crate) scratch: PathBuf,
    pub(crate) display: &'a Display,
    /// Whether the training has ended.
    pub(crate) is_over: &'a AtomicBool,
}

impl Watching<'_> {
    /// Looks at checkpoints of `training` until it is over, and says what it sees. What goes wrong
    /// is said and ends the watching alone.
    pub(crate) fn run(&self, training: &Call<'_>) {
        if let Err(problem) = self.look_on(training) {
            self.display.line(&format!("{}: not watched: {problem}", self.label));
        }
        // Leftovers have no value.
        std::fs::remove_dir_all(&self.scratch).ok();
    }

    fn look_on(&self, training: &Call<'_>) -> Result<(), String> {
        let view = OneView::find(self.chain, &self.watch.view)?;
        let begin = Instant::now();
        let mut pace = Pace::new(training.threads, view.pixels);
        while !self.is_over.load(Ordering::Relaxed) {
            if begin.elapsed() < pace.next() {
                std::thread::sleep(TICK);
                continue;
            }
            let (started, limit) = (Instant::now(), pace.expected() * MOST);
            let after = begin.elapsed().as_secs_f64();
            let look = Look { watching: self, view: &view, deadline: started + limit };
            match look.at(training) {
                Ok(Some(seen)) => {
                    pace.took(seen.processor);
                    self.show(&seen, &view.name, after)?;
                }
                Ok(None) => pace.took(started.elapsed()),
                Err(_) if self.is_over.load(Ordering::Relaxed) => return Ok(()),
                Err(_) if Instant::now() >= look.deadline => {
                    let limit = seconds(limit.as_secs_f64());
                    return Err(format!("view {} takes more than {limit}", view.name));
                }
                Err(failure) => return Err(failure.message),
            }
        }
        Ok(())
    }

    /// Says the scores, and puts the picture where it can be found.
    fn show(&self, seen: &Seen, view: &str, after: f64) -> Result<(), String> {
        let folder = &self.watch.folder;
        let picture = folder.join(file_name(self.label));
        let beside = picture.with_extension("partial");
        std::fs::create_dir_all(folder)
            .and_then(|()| std::fs::copy(&seen.picture, &beside))
            .and_then(|_| std::fs::rename(&beside, &picture))
            .map_err(|e| format!("{}: {e}", picture.display()))?;
        if std::env::var_os("NO_COLOR").is_none()
            && let Ok(image) = pixels::read_png(&picture)
        {
            self.display.picture(|columns, rows| half_blocks(&image, columns, rows));
        }
        let (label, scores, after) = (self.label, &seen.scores, seconds(after));
        self.display
            .line(&format!("{label}: view {view} after {after}: {scores} · {}", picture.display()));
        Ok(())
    }
}

/// A file's name for a label, which may hold parameters.
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

/// What a look has seen.
struct Seen {
    picture: PathBuf,
    scores: String,
    /// Processor time that it took.
    processor: Duration,
}

impl Look<'_> {
    /// None where there is no checkpoint yet.
    fn at(&self, training: &Call<'_>) -> Result<Option<Seen>, StageFailure> {
        let scratch = &self.watching.scratch;
        let fail = |e: std::io::Error| StageFailure {
            code: 1,
            message: format!("{}: {e}", scratch.display()),
        };
        if scratch.exists() {
            std::fs::remove_dir_all(scratch).map_err(fail)?;
        }
        std::fs::create_dir_all(scratch).map_err(fail)?;
        let [field, views, scores] =
            ["field", "views", "scores"].map(|folder| scratch.join(folder));
        let call =
            Call { output: &field, from_checkpoint: true, threads: 1, lock: None, ..*training };
        let Ok(reading) = self.call(&call) else { return Ok(None) };
        let Chain { render, score } = self.watching.chain;
        let rendering = self.step(render, "render", &field, &views)?;
        let scoring = self.step(score, "score", &views, &scores)?;
        let said = std::fs::read_to_string(scores.join(SUMMARY_FILE)).map_err(fail)?;
        Ok(Some(Seen {
            picture: views.join(format!("previews/{}.png", self.view.name)),
            scores: said.trim().to_owned(),
            processor: reading + rendering + scoring,
        }))
    }

    /// Calls a stage with what was made before, and with one view of its other inputs.
    fn step(
        &self,
        step: &Step,
        name: &str,
        fed: &Path,
        output: &Path,
    ) -> Result<Duration, StageFailure> {
        let scratch = self.watching.scratch.join(format!("{name}-inputs"));
        let params = scratch.join("params.json");
        let fail = |e: std::io::Error| StageFailure {
            code: 1,
            message: format!("{}: {e}", scratch.display()),
        };
        std::fs::create_dir_all(&scratch).map_err(fail)?;
        artifact::write_json(&params, &step.parameters).map_err(fail)?;
        let mut inputs = vec![(step.fed.clone(), fed.to_path_buf())];
        for (input, folder) in &step.inputs {
            let narrow = scratch.join(input);
            self.view.of(folder, &narrow).map_err(fail)?;
            inputs.push((input.clone(), narrow));
        }
        self.call(&Call {
            label: self.watching.label,
            program: &step.program.path,
            description: &step.program.description,
            params: &params,
            inputs: &inputs,
            hashes: &[],
            output,
            work: None,
            from_checkpoint: false,
            device: &step.device,
            threads: 1,
            lock: None,
        })
    }

    /// Calls a stage; the processor time that it took.
    fn call(&self, call: &Call<'_>) -> Result<Duration, StageFailure> {
        let stop = AtomicBool::new(false);
        let end = EndInTime { look: self, stop: &stop };
        let usage = call.run(&self.watching.scratch.join("log"), &end, &stop)?;
        Ok(Duration::from_secs_f64(usage.processor_seconds))
    }
}

/// Ends a call that nobody waits for any more, or that takes too long; says nothing.
struct EndInTime<'a> {
    look: &'a Look<'a>,
    stop: &'a AtomicBool,
}

impl Watcher for EndInTime<'_> {
    fn progress(&self, _: &Event) {}

    fn said(&self, _: &str) {}

    fn alive(&self) {
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
        assert_eq!(file_name("train-ss (supersample=2, a/b)"), "train-ss__supersample=2,_a_b.png");
    }
}
