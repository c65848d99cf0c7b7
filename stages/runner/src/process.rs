use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use artifact::{Event, KeyLock};

use crate::stages::StageProgram;

/// Environment that a stage gets; what else changes its result must be declared in its description.
const ENVIRONMENT: [&str; 9] =
    ["PATH", "HOME", "LANG", "LC_ALL", "TMPDIR", "LD_LIBRARY_PATH", "CUDA_VISIBLE_DEVICES", "NO_COLOR", "RUST_BACKTRACE"];

/// One call of a stage by the contract.
pub(crate) struct Call<'a> {
    pub(crate) program: &'a StageProgram,
    pub(crate) params: &'a Path,
    pub(crate) inputs: &'a [(String, PathBuf)],
    pub(crate) output: &'a Path,
    pub(crate) work: Option<&'a Path>,
    pub(crate) device: &'a str,
    pub(crate) threads: usize,
    /// The key's lock, which the stage holds on to as its standard input.
    pub(crate) lock: Option<&'a KeyLock>,
}

/// How a stage ended, if not well.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{message}")]
pub(crate) struct StageFailure {
    /// Its exit code; 1 where a signal ended it.
    pub(crate) code: u8,
    /// Its last words.
    pub(crate) message: String,
}

/// What to do with a stage's output while it runs.
pub(crate) trait Watcher: Sync {
    fn progress(&self, event: &Event);
    fn said(&self, line: &str);
}

impl Call<'_> {
    /// Runs the stage; appends what it says to `log`. When `stop` is set the stage is asked to end, so that it leaves a checkpoint.
    pub(crate) fn run(&self, log: &Path, watcher: &dyn Watcher, stop: &AtomicBool) -> Result<(), StageFailure> {
        let fail = |message: String| StageFailure { code: 1, message };
        let mut log = File::options().create(true).append(true).open(log).map_err(|e| fail(format!("{}: {e}", log.display())))?;
        let path = self.program.path.display();
        let stdin = match self.lock {
            Some(lock) => Stdio::from(lock.share().map_err(|e| fail(format!("{path}: {e}")))?),
            None => Stdio::null(),
        };
        let mut child = self.command().stdin(stdin).spawn().map_err(|e| fail(format!("{path}: {e}")))?;
        let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
        let mut last_words = String::new();
        let status = std::thread::scope(|scope| {
            scope.spawn(|| {
                for line in lines(stdout) {
                    if let Ok(event) = serde_json::from_str::<Event>(&line) {
                        watcher.progress(&event);
                    }
                }
            });
            let reader = scope.spawn(|| {
                for line in lines(stderr) {
                    // The log is for people; a full disk shows itself in the output.
                    writeln!(log, "{line}").ok();
                    if !last_words.is_empty() {
                        watcher.said(&last_words);
                    }
                    last_words = line;
                }
            });
            let status = wait(&mut child, stop);
            reader.join().ok();
            status
        });
        let status = status.map_err(|e| fail(format!("{path}: {e}")))?;
        if status.success() {
            if !last_words.is_empty() {
                watcher.said(&last_words);
            }
            return Ok(());
        }
        let code = status.code().and_then(|c| u8::try_from(c).ok()).unwrap_or(1);
        let message =
            if last_words.is_empty() { format!("{} ended with {status}", self.program.description.name) } else { last_words };
        Err(StageFailure { code, message })
    }

    fn command(&self) -> Command {
        let mut command = Command::new(&self.program.path);
        command.arg("--params").arg(self.params).arg("--output").arg(self.output);
        for (name, folder) in self.inputs {
            let mut text = std::ffi::OsString::from(format!("{name}="));
            text.push(folder);
            command.arg("--input").arg(text);
        }
        if let Some(work) = self.work {
            command.arg("--work").arg(work);
        }
        command.args(["--device", self.device, "--threads", &self.threads.to_string(), "--progress", "json"]);
        let declared = self.program.description.environment.iter().map(String::as_str);
        let passed = ENVIRONMENT.into_iter().chain(declared).filter_map(|name| Some((name.to_owned(), std::env::var_os(name)?)));
        command.env_clear().envs(passed).env(artifact::RUNNER_VARIABLE, std::process::id().to_string());
        // A group of its own: Ctrl-C reaches the runner alone, which then asks its stages to end, once.
        command.process_group(0).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }
}

fn wait(child: &mut Child, stop: &AtomicBool) -> std::io::Result<ExitStatus> {
    let mut asked = false;
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        if stop.load(Ordering::Relaxed) && !asked {
            if let Some(pid) = rustix::process::Pid::from_raw(child.id() as i32) {
                // It may just have ended by itself.
                rustix::process::kill_process(pid, rustix::process::Signal::TERM).ok();
            }
            asked = true;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Lines of a pipe; bytes that aren't UTF-8 are replaced, not refused.
fn lines(pipe: Option<impl Read>) -> impl Iterator<Item = String> {
    let reader = pipe.map(BufReader::new);
    reader
        .into_iter()
        .flat_map(|r| r.split(b'\n').map_while(Result::ok))
        .map(|l| String::from_utf8_lossy(&l).trim_end().to_owned())
}
