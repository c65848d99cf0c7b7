//! Descriptions of programs, from `STAGE describe`: several programs in parallel, each with a time
//! limit.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Once, mpsc};
use std::time::{Duration, Instant};

use rayon::prelude::*;
use stage::{Description, out_of_memory_message};

use crate::stage_call::call::set_environment;
use crate::stage_call::group::Group;

/// Time limit of `describe`, chosen by hand. A program that exceeds it is killed.
const MAX_DESCRIBE_TIME: Duration = Duration::from_secs(120);
/// Time after which the wait for descriptions is reported, chosen by hand.
const NOTICE_AFTER: Duration = Duration::from_secs(1);
/// Set after the wait was reported: this process reports it once.
static REPORTED: Once = Once::new();
/// Maximum size of a program's output, chosen by hand; descriptions have some kilobytes.
const MAX_OUTPUT_BYTES: u64 = 1 << 24;
/// Interval between two checks whether a program has ended; chosen by hand.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// Error returned when a stage's program can't be used or described.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ProgramError(pub(crate) String);

impl ProgramError {
    /// Returns the error for a program whose description isn't given.
    pub(crate) fn undescribed(path: &Path) -> Self {
        Self(format!("no description of {}", path.display()))
    }
}

/// Descriptions, or the errors instead, by the program's path.
pub type Descriptions = BTreeMap<PathBuf, Result<Description, ProgramError>>;

/// Describes programs, as many in parallel as this process has processors. Returns `None` if `stop`
/// is set.
pub fn describe_all(paths: &[PathBuf], stop: Option<&AtomicBool>) -> Option<Descriptions> {
    let describe_one = |path: &PathBuf| (path.clone(), describe(path, MAX_DESCRIBE_TIME, stop));
    let threads = stage::processors().count.min(paths.len()).max(1);
    // The global pool hashes inputs; slow programs must not block it.
    let descriptions = match rayon::ThreadPoolBuilder::new().num_threads(threads).build() {
        Ok(pool) => pool.install(|| paths.par_iter().map(describe_one).collect()),
        // The system starts no further thread.
        Err(_) => paths.iter().map(describe_one).collect(),
    };
    (!is_set(stop)).then_some(descriptions)
}

fn is_set(stop: Option<&AtomicBool>) -> bool {
    stop.is_some_and(|stop| stop.load(Ordering::Relaxed))
}

/// Returns a program's description.
fn describe(
    path: &Path,
    limit: Duration,
    stop: Option<&AtomicBool>,
) -> Result<Description, ProgramError> {
    let call = format!("`{} describe`", path.display());
    let Some(Output { status, stdout, stderr }) = run_describe(path, limit, stop)
        .map_err(|problem| ProgramError(format!("{call}: {problem}")))?
    else {
        // After an interruption, `describe_all` discards this error.
        return Err(ProgramError(format!(
            "{call} didn't finish within {limit:?}; check what it waits for, or set `run:` to \
            another program"
        )));
    };
    if !status.success() {
        let stderr = String::from_utf8_lossy(&stderr);
        let message = stderr.lines().rev().find_map(out_of_memory_message).unwrap_or_else(|| {
            let last = stderr.trim_end().lines().last().unwrap_or_default();
            last.replace(char::is_control, " ")
        });
        return Err(ProgramError(format!("{call} failed ({status}): {message}")));
    }
    serde_json::from_slice(&stdout)
        .map_err(|problem| ProgramError(format!("output of {call} isn't a description: {problem}")))
}

/// Runs `describe`. Returns `None` if the time limit is exceeded or `stop` is set.
fn run_describe(
    path: &Path,
    limit: Duration,
    stop: Option<&AtomicBool>,
) -> std::io::Result<Option<Output>> {
    if is_set(stop) {
        return Ok(None);
    }
    let mut command = Command::new(path);
    command.arg("describe").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    set_environment(&mut command, &[]);
    let (group, (stdout, stderr)) = Group::start(&mut command)?;
    let (stdout, stderr) = (read_in_background(stdout), read_in_background(stderr));
    let started = Instant::now();
    let deadline = started + limit;
    while !group.has_exited()? {
        if Instant::now() >= deadline || is_set(stop) {
            return Ok(None);
        }
        if started.elapsed() >= NOTICE_AFTER {
            let text = "reading the stages' descriptions (once per program version)";
            // A run describes users' programs several times.
            REPORTED.call_once(|| artifact::report_line!("{text}"));
        }
        std::thread::sleep(POLL_INTERVAL);
    }
    // A child process of the program may keep the pipes open.
    let stdout = stdout.recv_timeout(deadline.saturating_duration_since(Instant::now()));
    let stderr = stderr.recv_timeout(deadline.saturating_duration_since(Instant::now()));
    let status = group.kill()?.status;
    let (Ok(stdout), Ok(stderr)) = (stdout, stderr) else { return Ok(None) };
    Ok(Some(Output { status, stdout, stderr }))
}

/// Reads a pipe to its end on another thread.
fn read_in_background(pipe: Option<impl Read + Send + 'static>) -> mpsc::Receiver<Vec<u8>> {
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(pipe) = pipe {
            // After an error the bytes so far are no valid description, which is reported.
            pipe.take(MAX_OUTPUT_BYTES).read_to_end(&mut bytes).ok();
        }
        sender.send(bytes).ok();
    });
    receiver
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes a program with `install`. A file written by this process can't be run while a child
    /// just forked by another thread still has the file open.
    fn write_program(folder: &Path, name: &str, text: &str) -> PathBuf {
        let (source, target) = (folder.join(format!("{name}.sh")), folder.join(name));
        std::fs::write(&source, text).unwrap();
        assert!(
            Command::new("install")
                .args(["-m", "755"])
                .args([&source, &target])
                .status()
                .unwrap()
                .success()
        );
        target
    }

    #[test]
    fn programs_without_a_description_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        for (text, limit, expected) in [
            ("#!/bin/sh\nsleep 1000\n", Duration::from_millis(50), "didn't finish within 50ms"),
            ("#!/bin/sh\nsleep 1000 &\n", Duration::from_millis(200), "didn't finish within 200ms"),
            (
                "#!/bin/sh\necho one >&2\nprintf 'two\\033[31m\\n' >&2\nexit 3\n",
                MAX_DESCRIBE_TIME,
                "failed (exit status: 3): two [31m",
            ),
            (
                "#!/bin/sh\necho '  what():  std::bad_alloc' >&2\nkill -ABRT $$\n",
                MAX_DESCRIBE_TIME,
                "failed (signal: 6 (SIGABRT)): out of memory",
            ),
            (
                "#!/bin/sh\necho \"with ${PATH:+PATH}$CARGO_MANIFEST_DIR.\" >&2\nexit 3\n",
                MAX_DESCRIBE_TIME,
                "failed (exit status: 3): with PATH.",
            ),
            ("#!/bin/sh\necho '{}'\n", MAX_DESCRIBE_TIME, "isn't a description: missing field"),
            ("#!/nowhere/at/all\n", MAX_DESCRIBE_TIME, "describe`: No such file"),
        ] {
            let path = write_program(folder.path(), "stage", text);
            let problem = describe(&path, limit, None).unwrap_err().to_string();
            assert!(problem.contains(expected), "{problem}");
        }
    }

    #[test]
    fn a_signal_ends_a_program_and_starts_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let started = folder.path().join("started");
        let text = format!("#!/bin/sh\n: > '{}'\nsleep 1000\n", started.display());
        let path = write_program(folder.path(), "waits", &text);
        let stop = AtomicBool::new(true);
        assert!(describe_all(std::slice::from_ref(&path), Some(&stop)).is_none());
        assert!(!started.exists());
        stop.store(false, Ordering::Relaxed);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while !started.exists() {
                    std::thread::sleep(POLL_INTERVAL);
                }
                stop.store(true, Ordering::Relaxed);
            });
            assert!(describe_all(std::slice::from_ref(&path), Some(&stop)).is_none());
        });
    }
}
