//! One call of a stage: starts the process, reads its output and waits for its end.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use artifact::{format_count, format_duration, format_size, format_utc, printable, unix_time};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use stage::Description;
use stage::{Event, SUMMARY_FILE};
use wait4::ResUse;

use crate::stage_call::failure::{Exit, StageFailure, is_noise, memory_kills};
use crate::stage_call::group::{Group, Pipes, peak_memory};
use crate::stage_call::log::{ProgressFilter, StageLog};

/// Environment variables that every stage gets (docs/guide/swapping-a-stage.md). A description
/// declares the further variables that change the stage's result, since they are part of its key.
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

/// Maximum number of last stderr lines that are searched for the reason of a failure, chosen by
/// hand.
const MAX_TAIL_LINES: usize = 8;
/// Time for which a stage's last line is held, since it may be the reason of a failure: a stage
/// ends soon after it has printed the reason. Chosen by hand.
const MAX_HOLD_TIME: Duration = Duration::from_millis(500);
/// Interval between two checks of a running stage.
const POLL_INTERVAL: Duration = Duration::from_millis(10);
/// Time that a stopped stage has for its checkpoint after the end of the wrapper script that
/// started it (docs/design/001).
const MAX_CHECKPOINT_TIME: Duration = Duration::from_secs(10);

/// Time after a stage's end for which its pipes are read while a process that has left the stage's
/// group keeps them open. Chosen by hand.
const MAX_READ_TIME: Duration = Duration::from_secs(1);
/// Maximum number of bytes in a pipe (`pipe(7)`).
const PIPE_BYTES: usize = 1 << 16;
/// Interval between two checks whether a stage with silent pipes has ended: 100 ms, chosen by hand.
const PIPE_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };

/// Arguments of one call of a stage.
pub struct Call<'a> {
    /// Block and point, for the log and messages.
    pub label: &'a str,
    /// Path of the program.
    pub program: &'a Path,
    /// Description of the program.
    pub description: &'a Description,
    /// File of `--params`.
    pub params: &'a Path,
    /// Names and folders of `--input`.
    pub inputs: &'a [(String, PathBuf)],
    /// Content hashes of inputs by name, as far as known; for the log.
    pub hashes: &'a [(String, String)],
    /// Folder of `--output`.
    pub output: &'a Path,
    /// Folder of `--work`; `None` for a sink.
    pub work: Option<&'a Path>,
    /// True for `--from-checkpoint`: write the output from the latest checkpoint in `work`.
    pub from_checkpoint: bool,
    /// Value of `--device`.
    pub device: &'a str,
    /// Value of `--threads`.
    pub threads: usize,
    /// File of the key's lock. The stage inherits it as standard input, so that the key stays
    /// locked until the stage ends.
    pub lock: Option<&'a File>,
}

/// Memory and processor time of a call.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Usage {
    /// Peak resident memory in bytes: the larger one of the stage and the programs that it called.
    pub peak_memory: u64,
    /// Processor time in seconds, of all threads and of the programs that the stage called.
    pub processor_seconds: f64,
}

/// Receiver of a running stage's output. Control characters in the output are escaped.
pub trait Watcher: Sync {
    /// Takes a progress event.
    fn progress(&self, event: &Event);
    /// Takes a line of stderr.
    fn stderr_line(&self, line: &str);
    /// Runs every few milliseconds until the stage ends.
    fn tick(&self) {}
}

impl Call<'_> {
    /// Runs the stage, and appends its arguments, output and result to the file `log`. If `stop` is
    /// set, the stage is asked to end, so that it can write a checkpoint. Returns the usage of a
    /// failed stage, too.
    pub fn run(
        &self,
        log: &Path,
        watcher: &dyn Watcher,
        stop: &AtomicBool,
    ) -> (Usage, Result<(), StageFailure>) {
        let log = match StageLog::open(log) {
            Ok(log) => log,
            Err(error) => return (Usage::default(), Err(StageFailure::at(log, &error))),
        };
        self.log_arguments(&log);
        let started = Instant::now();
        let ended = self.run_process(&log, watcher, stop);
        let (usage, result) = ended.unwrap_or_else(|failure| (Usage::default(), Err(failure)));
        let time = format_duration(started.elapsed().as_secs_f64());
        match &result {
            Ok(()) => {
                log.line(format_args!(
                    "done in {time}; processor time {}, peak memory {}",
                    format_duration(usage.processor_seconds),
                    format_size(usage.peak_memory)
                ));
                for line in read_summary(self.output).unwrap_or_default().lines() {
                    log.line(format_args!("result: {line}"));
                }
            }
            Err(StageFailure { code, message }) => {
                log.line(format_args!("failed after {time} with exit code {code}: {message}"));
            }
        }
        (usage, result)
    }

    fn log_arguments(&self, log: &StageLog) {
        log.line(format_args!("{}: started {}", self.label, format_utc(unix_time())));
        log.line(format_args!(
            "program: {} {}, {}",
            self.program.display(),
            self.description.version,
            format_count(self.threads, "thread")
        ));
        log.line(format_args!("device: {}", self.device));
        let parameters = std::fs::read(self.params)
            .ok()
            .and_then(|b| serde_json::from_slice::<serde_json::Value>(&b).ok());
        log.line(format_args!("parameters: {}", parameters.unwrap_or_default()));
        for (name, folder) in self.inputs {
            let hash = self.hashes.iter().find(|(hashed, _)| hashed == name);
            let hash = hash.map(|(_, hash)| format!(" ({hash})")).unwrap_or_default();
            log.line(format_args!("input {name}: {}{hash}", folder.display()));
        }
    }

    fn run_process(
        &self,
        log: &StageLog,
        watcher: &dyn Watcher,
        stop: &AtomicBool,
    ) -> Result<(Usage, Result<(), StageFailure>), StageFailure> {
        let kills_before = memory_kills();
        let (group, (stdout, stderr)) =
            self.start().map_err(|e| StageFailure::at(self.program, &e))?;
        let output = OutputReader::new(log, watcher, &self.description.name);
        let is_over = AtomicBool::new(false);
        let (exit, stated_reason, tail) = std::thread::scope(|scope| {
            let stdout = scope.spawn(|| output.read_stdout(Pipe::new(stdout, &is_over)));
            let stderr = scope.spawn(|| output.read_stderr(Pipe::new(stderr, &is_over)));
            let are_closed = || stdout.is_finished() && stderr.is_finished();
            let exit = wait(group, stop, &|| output.tick(), &are_closed);
            if !wait_until(MAX_READ_TIME, &|| output.tick(), &are_closed) {
                let text = "a process that the stage has started still runs; its output is ignored";
                log.line(text);
                watcher.stderr_line(text);
            }
            is_over.store(true, Ordering::Relaxed);
            (exit, stdout.join().ok().flatten(), stderr.join().unwrap_or_default())
        });
        let (ResUse { status, rusage }, peak_memory) =
            exit.map_err(|e| StageFailure::at(self.program, &e))?;
        let processor_seconds = (rusage.utime + rusage.stime).as_secs_f64();
        let usage = Usage { peak_memory, processor_seconds };
        let result = if status.success() {
            Ok(())
        } else {
            let exit = Exit {
                status,
                stated_reason,
                tail,
                was_stopped: stop.load(Ordering::Relaxed),
                was_memory_exhausted: memory_kills() > kills_before,
            };
            Err(exit.failure(&self.description.name))
        };
        // The caller prints the reason: the same line must not appear twice.
        output.release(|held| match &result {
            Ok(()) => true,
            Err(failure) => !held.text.ends_with(&failure.message),
        });
        Ok((usage, result))
    }

    fn start(&self) -> std::io::Result<(Group, Pipes)> {
        let stdin = match self.lock {
            Some(lock) => Stdio::from(lock.try_clone()?),
            None => Stdio::null(),
        };
        Group::start(self.command().stdin(stdin))
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
        command.args(["--device", self.device, "--threads", &self.threads.to_string()]);
        command.args(["--progress", "json"]);
        set_environment(&mut command, &self.description.environment);
        command.env(stage::RUNNER_VARIABLE, std::process::id().to_string());
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }
}

/// Reduces a program's environment to [`ENVIRONMENT`] and the variables that its description
/// declares.
pub(crate) fn set_environment(command: &mut Command, declared: &[String]) {
    let names = ENVIRONMENT.into_iter().chain(declared.iter().map(String::as_str));
    let passed = names.filter_map(|name| Some((name.to_owned(), std::env::var_os(name)?)));
    command.env_clear().envs(passed);
}

/// Reader of a stage's output.
struct OutputReader<'a> {
    log: &'a StageLog,
    watcher: &'a dyn Watcher,
    /// Beginning of the line with which a stage reports its failure.
    failure_prefix: String,
    /// Last line of stderr, unless it was forwarded.
    held: Mutex<Option<HeldLine>>,
}

/// Line of stderr that may be the reason of a failure, which the caller prints.
struct HeldLine {
    text: String,
    since: Instant,
}

impl<'a> OutputReader<'a> {
    fn new(log: &'a StageLog, watcher: &'a dyn Watcher, stage: &str) -> Self {
        let failure_prefix = format!("{stage}: ");
        Self { log, watcher, failure_prefix, held: Mutex::default() }
    }

    fn held(&self) -> MutexGuard<'_, Option<HeldLine>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Forwards the held line if `is_due` returns true.
    fn release(&self, is_due: impl FnOnce(&HeldLine) -> bool) {
        let mut held = self.held();
        if let Some(line) = held.take_if(|line| is_due(line)) {
            self.watcher.stderr_line(&line.text);
        }
    }

    /// Runs every few milliseconds until the stage ends: forwards the held line after
    /// [`MAX_HOLD_TIME`], unless it begins like the reason of a failure.
    fn tick(&self) {
        self.release(|line| {
            line.since.elapsed() >= MAX_HOLD_TIME && !line.text.starts_with(&self.failure_prefix)
        });
        self.watcher.tick();
    }

    /// Reads stdout: progress events, and other lines, which are for the log alone. Returns the
    /// reason of a failure if the stage states one.
    fn read_stdout(&self, stdout: Option<impl Read>) -> Option<String> {
        let mut reason = None;
        let mut filter = ProgressFilter::default();
        for line in read_lines(stdout) {
            match serde_json::from_str(&line) {
                Ok(Event::Failed { message }) => reason = Some(printable(&message).into_owned()),
                Ok(Event::Progress { label, done, total, note, seconds_left }) => {
                    let label = printable(&label).into_owned();
                    let note = printable(&note).into_owned();
                    if let Some(line) = filter.line(&label, done, total, &note) {
                        self.log.line(line);
                    }
                    let event = Event::Progress { label, done, total, note, seconds_left };
                    self.watcher.progress(&event);
                }
                Err(_) => self.log.line(line),
            }
        }
        reason
    }

    /// Reads stderr, and forwards each line when the next one comes; [`Self::tick`] forwards it
    /// earlier if it is no reason of a failure. Returns the last lines.
    fn read_stderr(&self, stderr: Option<impl Read>) -> Vec<String> {
        let mut tail: VecDeque<String> = VecDeque::new();
        for line in read_lines(stderr) {
            self.log.line(&line);
            if is_noise(&line) {
                continue;
            }
            self.release(|_| true);
            *self.held() = Some(HeldLine { text: line.clone(), since: Instant::now() });
            if tail.len() == MAX_TAIL_LINES {
                tail.pop_front();
            }
            tail.push_back(line);
        }
        tail.into()
    }
}

/// Waits for the end of a stage, then kills the processes that it has left running. `tick` runs
/// every few milliseconds. `are_closed` returns whether all processes have closed the stage's
/// pipes. Returns the peak memory as well.
fn wait(
    group: Group,
    stop: &AtomicBool,
    tick: &dyn Fn(),
    are_closed: &dyn Fn() -> bool,
) -> std::io::Result<(ResUse, u64)> {
    // `maxrss` includes the runner's memory, which a new process shares until it runs the program:
    // a stage's smaller peak must be read while the stage runs.
    let runner_peak = peak_memory("self");
    let mut stage_peak = None;
    let mut was_terminated = false;
    while !group.has_exited()? {
        // An unknown peak, `None`, is less than any other.
        if stage_peak <= runner_peak {
            stage_peak = group.peak_memory().or(stage_peak);
        }
        if stop.load(Ordering::Relaxed) && !was_terminated {
            group.terminate();
            was_terminated = true;
        }
        tick();
        std::thread::sleep(POLL_INTERVAL);
    }
    if was_terminated {
        wait_until(MAX_CHECKPOINT_TIME, tick, are_closed);
    }
    let usage = group.kill()?;
    let peak = match (stage_peak, runner_peak) {
        (Some(stage), Some(runner)) if usage.rusage.maxrss <= runner => stage,
        _ => usage.rusage.maxrss,
    };
    Ok((usage, peak))
}

/// Waits until `is_done` returns true, for a limited time. Returns whether it did.
fn wait_until(limit: Duration, tick: &dyn Fn(), is_done: &dyn Fn() -> bool) -> bool {
    let started = Instant::now();
    while !is_done() {
        if started.elapsed() >= limit {
            return false;
        }
        tick();
        std::thread::sleep(POLL_INTERVAL);
    }
    true
}

/// Pipe of a stage. After the stage's end, only the bytes that are already in the pipe are read,
/// since another process may keep the pipe open.
struct Pipe<'a, R> {
    pipe: R,
    /// True after the stage's end.
    is_over: &'a AtomicBool,
    /// Maximum number of bytes still to read after the stage's end.
    left: usize,
}

impl<'a, R> Pipe<'a, R> {
    fn new(pipe: Option<R>, is_over: &'a AtomicBool) -> Option<Self> {
        Some(Self { pipe: pipe?, is_over, left: PIPE_BYTES })
    }
}

impl<R: Read + AsFd> Read for Pipe<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        loop {
            let is_over = self.is_over.load(Ordering::Relaxed);
            let mut polled = [PollFd::new(&self.pipe, PollFlags::IN)];
            if poll(&mut polled, Some(&PIPE_INTERVAL))? > 0 && (!is_over || self.left > 0) {
                let count = self.pipe.read(buffer)?;
                if is_over {
                    self.left = self.left.saturating_sub(count);
                }
                return Ok(count);
            }
            if is_over {
                return Ok(0);
            }
        }
    }
}

/// Returns the non-blank lines of a pipe. Bytes that aren't UTF-8 are replaced, control characters
/// are escaped. Of a line that is overwritten by `\r`, as by a progress bar, only the last state
/// is returned.
fn read_lines(pipe: Option<impl Read>) -> impl Iterator<Item = String> {
    let reader = pipe.map(BufReader::new);
    reader.into_iter().flat_map(|r| r.split(b'\n').map_while(Result::ok)).filter_map(|bytes| {
        let text = String::from_utf8_lossy(&bytes);
        let line = text.trim_end().rsplit('\r').find(|state| !state.trim().is_empty())?;
        Some(printable(line).into_owned())
    })
}

/// Reads the summary in a stage's output; `None` if the stage wrote none.
pub fn read_summary(output: &Path) -> Option<String> {
    let file = output.join(SUMMARY_FILE);
    // Reading a named pipe would never end.
    file.metadata().ok().filter(std::fs::Metadata::is_file)?;
    std::fs::read_to_string(file).ok()
}

#[cfg(test)]
#[path = "call_tests.rs"]
mod tests;
