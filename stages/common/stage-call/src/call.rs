//! One call of a stage: its process, its pipes, its end.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use artifact::{counted, printable, sized};
use contract::Description;
use stage::{Event, SUMMARY_FILE};
use wait4::ResUse;

use crate::clock::seconds;
use crate::group::Group;
use crate::log::{StageLog, Tenths};
use crate::verdict::{End, StageFailure, is_noise, memory_kills};

/// Environment that a stage gets; what else changes its result must be declared in its description.
const ENVIRONMENT: [&str; 12] = [
    stage::MEMORY_VARIABLE,
    "PATH",
    "HOME",
    "LANG",
    "LC_ALL",
    "TMPDIR",
    "LD_LIBRARY_PATH",
    "CUDA_VISIBLE_DEVICES",
    "NO_COLOR",
    "RUST_BACKTRACE",
    stage::STOP_VARIABLE,
    stage::SLOW_VARIABLE,
];

/// Last lines of a stage's stderr in which the reason of a failure is looked for.
const TAIL_LINES: usize = 8;
/// Interval between two looks at a running stage.
const LOOK_INTERVAL: Duration = Duration::from_millis(10);
/// Time to write a checkpoint for a stage that was asked to end, if the wrapper script that it runs
/// in has ended at once.
const GRACE: Duration = Duration::from_secs(10);

/// One call of a stage by the contract.
pub struct Call<'a> {
    /// Block and point, for the log.
    pub label: &'a str,
    /// The program.
    pub program: &'a Path,
    /// What it says of itself.
    pub description: &'a Description,
    /// `--params`.
    pub params: &'a Path,
    /// `--input`, by name.
    pub inputs: &'a [(String, PathBuf)],
    /// What the inputs' contents are, where that is known; for the log.
    pub hashes: &'a [(String, String)],
    /// `--output`.
    pub output: &'a Path,
    /// `--work`; none for a sink.
    pub work: Option<&'a Path>,
    /// `--from-checkpoint`: the stage writes its output from the latest checkpoint in `work`.
    pub from_checkpoint: bool,
    /// `--device`.
    pub device: &'a str,
    /// `--threads`.
    pub threads: usize,
    /// The file of the key's lock, which the stage holds on to as its standard input.
    pub lock: Option<&'a File>,
}

/// What a call took of the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Usage {
    /// Peak resident memory in bytes, of the stage or, where it is larger, of a program that it
    /// called.
    pub peak_memory: u64,
    /// Processor time of all its threads, and of the programs that it called, in seconds.
    pub processor_seconds: f64,
}

/// What to do with a stage's output while it runs. Control characters in it are spelled out.
pub trait Watcher: Sync {
    /// How far it is.
    fn progress(&self, event: &Event);
    /// A line that it said on stderr.
    fn said(&self, line: &str);
    /// It is still at work; called often.
    fn alive(&self) {}
}

impl Call<'_> {
    /// Runs the stage; appends to `log` what it was given, what it says and how it ends. When
    /// `stop` is set the stage is asked to end, so that it leaves a checkpoint.
    pub fn run(
        &self,
        log: &Path,
        watcher: &dyn Watcher,
        stop: &AtomicBool,
    ) -> Result<Usage, StageFailure> {
        let log = StageLog::open(log).map_err(|e| StageFailure::at(log, &e))?;
        self.log_start(&log);
        let started = Instant::now();
        let result = self.carry_out(&log, watcher, stop);
        let time = seconds(started.elapsed().as_secs_f64());
        match &result {
            Ok(usage) => {
                let (memory, processor) =
                    (sized(usage.peak_memory), seconds(usage.processor_seconds));
                log.line(format_args!(
                    "done in {time}; {processor} of processor time, {memory} of memory at most"
                ));
                let summary = summary_of(self.output).unwrap_or_default();
                summary.lines().for_each(|line| log.line(format_args!("result: {line}")));
            }
            Err(StageFailure { code, message }) => {
                log.line(format_args!("failed after {time} with {code}: {message}"));
            }
        }
        result
    }

    fn log_start(&self, log: &StageLog) {
        log.start(self.label);
        log.line(format_args!(
            "program: {} {}, {}",
            self.program.display(),
            self.description.version,
            counted(self.threads, "thread")
        ));
        log.line(format_args!("device: {}", self.device));
        let parameters = std::fs::read(self.params)
            .ok()
            .and_then(|b| serde_json::from_slice::<serde_json::Value>(&b).ok());
        log.line(format_args!("parameters: {}", parameters.unwrap_or_default()));
        for (name, folder) in self.inputs {
            let hash = self
                .hashes
                .iter()
                .find(|(of, _)| of == name)
                .map(|(_, hash)| format!(" ({hash})"))
                .unwrap_or_default();
            log.line(format_args!("input {name}: {}{hash}", folder.display()));
        }
    }

    fn carry_out(
        &self,
        log: &StageLog,
        watcher: &dyn Watcher,
        stop: &AtomicBool,
    ) -> Result<Usage, StageFailure> {
        let fail = |e: std::io::Error| StageFailure::at(self.program, &e);
        let stdin = match self.lock {
            Some(lock) => Stdio::from(lock.try_clone().map_err(fail)?),
            None => Stdio::null(),
        };
        let kills_before = memory_kills();
        let (group, (stdout, stderr)) = Group::start(self.command().stdin(stdin)).map_err(fail)?;
        let ear = Ear { log, watcher };
        let (end, stated, tail) = std::thread::scope(|scope| {
            let events = scope.spawn(|| ear.hear_events(stdout));
            let words = scope.spawn(|| ear.hear_words(stderr));
            let end = wait(group, stop, watcher, &|| events.is_finished() && words.is_finished());
            (end, events.join().ok().flatten(), words.join().unwrap_or_default())
        });
        let ResUse { status, rusage } = end.map_err(fail)?;
        let last = tail.last().cloned();
        let result = if status.success() {
            let processor_seconds = (rusage.utime + rusage.stime).as_secs_f64();
            Ok(Usage { peak_memory: rusage.maxrss, processor_seconds })
        } else {
            let end = End {
                status,
                stated,
                tail,
                asked: stop.load(Ordering::Relaxed),
                memory_ran_out: memory_kills() > kills_before,
            };
            Err(end.failure(&self.description.name))
        };
        // Not twice: as what it said, and as the reason.
        let is_reason =
            |line: &String| result.as_ref().is_err_and(|failure| line.ends_with(&failure.message));
        if let Some(last) = last.filter(|line| !is_reason(line)) {
            watcher.said(&last);
        }
        result
    }

    fn command(&self) -> Command {
        let mut command = Command::new(self.program);
        command.arg("--params").arg(self.params).arg("--output").arg(self.output);
        for (name, folder) in self.inputs {
            let mut text = std::ffi::OsString::from(format!("{name}="));
            text.push(folder);
            command.arg("--input").arg(text);
        }
        if let Some(work) = self.work {
            command.arg("--work").arg(work);
        }
        if self.from_checkpoint {
            command.arg("--from-checkpoint");
        }
        command.args([
            "--device",
            self.device,
            "--threads",
            &self.threads.to_string(),
            "--progress",
            "json",
        ]);
        let declared = self.description.environment.iter().map(String::as_str);
        let passed = ENVIRONMENT
            .into_iter()
            .chain(declared)
            .filter_map(|name| Some((name.to_owned(), std::env::var_os(name)?)));
        command
            .env_clear()
            .envs(passed)
            .env(stage::RUNNER_VARIABLE, std::process::id().to_string());
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }
}

/// Listens to a stage.
struct Ear<'a> {
    log: &'a StageLog,
    watcher: &'a dyn Watcher,
}

impl Ear<'_> {
    /// Hears stdout: events, and what a plain script prints, which is for the log alone. Returns
    /// the reason of a failure, where one is stated.
    fn hear_events(&self, stdout: Option<impl Read>) -> Option<String> {
        let (mut stated, mut tenths) = (None, Tenths::default());
        for line in lines(stdout) {
            match serde_json::from_str(&line) {
                Ok(Event::Failed { message }) => stated = Some(printable(&message).into_owned()),
                Ok(Event::Progress { label, done, total, note }) => {
                    let (label, note) =
                        (printable(&label).into_owned(), printable(&note).into_owned());
                    if let Some(told) = tenths.told(&label, done, total, &note) {
                        self.log.line(told);
                    }
                    self.watcher.progress(&Event::Progress { label, done, total, note });
                }
                Err(_) => self.log.line(line),
            }
        }
        stated
    }

    /// Hears stderr, and passes on all but the last line, which may be the reason of a failure.
    /// Returns the last lines.
    fn hear_words(&self, stderr: Option<impl Read>) -> Vec<String> {
        let mut tail: VecDeque<String> = VecDeque::new();
        for line in lines(stderr) {
            self.log.line(&line);
            if is_noise(&line) {
                continue;
            }
            if let Some(last) = tail.back() {
                self.watcher.said(last);
            }
            if tail.len() == TAIL_LINES {
                tail.pop_front();
            }
            tail.push_back(line);
        }
        tail.into()
    }
}

/// Waits for the end of a stage, and kills what the stage has left running. `is_silent` returns
/// whether all processes have closed the stage's pipes.
fn wait(
    group: Group,
    stop: &AtomicBool,
    watcher: &dyn Watcher,
    is_silent: &dyn Fn() -> bool,
) -> std::io::Result<ResUse> {
    let mut asked = false;
    while !group.is_over()? {
        if stop.load(Ordering::Relaxed) && !asked {
            group.ask_to_end();
            asked = true;
        }
        watcher.alive();
        std::thread::sleep(LOOK_INTERVAL);
    }
    let over = Instant::now();
    while asked && !is_silent() && over.elapsed() < GRACE {
        watcher.alive();
        std::thread::sleep(LOOK_INTERVAL);
    }
    group.end()
}

/// Lines of a pipe that hold something; bytes that aren't UTF-8 are replaced, and control
/// characters spelled out. Of what was written over in place (a foreign progress bar) the last
/// state counts.
fn lines(pipe: Option<impl Read>) -> impl Iterator<Item = String> {
    let reader = pipe.map(BufReader::new);
    reader.into_iter().flat_map(|r| r.split(b'\n').map_while(Result::ok)).filter_map(|bytes| {
        let text = String::from_utf8_lossy(&bytes);
        let line = text.trim_end().rsplit('\r').find(|state| !state.trim().is_empty())?;
        Some(printable(line).into_owned())
    })
}

/// Reads the summary that a stage wrote to its output, if there is one. A named pipe of this name
/// would never end.
pub fn summary_of(output: &Path) -> Option<String> {
    let file = output.join(SUMMARY_FILE);
    file.metadata().ok().filter(std::fs::Metadata::is_file)?;
    std::fs::read_to_string(file).ok()
}
