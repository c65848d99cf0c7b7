//! Asking programs what they are: `STAGE describe`, several at once, none for ever.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use contract::Description;
use stage::out_of_memory;

use crate::group::Group;

/// After so long a program that has said nothing is taken to hang.
const LONGEST_ANSWER: Duration = Duration::from_secs(120);
/// Asking that takes longer than this is said.
const NOTICE_AFTER: Duration = Duration::from_secs(1);
/// Descriptions are some kilobytes.
const MOST_BYTES: u64 = 1 << 24;

/// The asking was interrupted.
#[derive(Debug, PartialEq, Eq)]
pub struct Interrupted;

/// Why a program doesn't say what it is.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DescribeError {
    /// It can't be started or waited for.
    #[error("`{program} describe`: {problem}")]
    Start {
        /// The program.
        program: PathBuf,
        /// What the system says.
        problem: String,
    },
    /// It says nothing.
    #[error(
        "`{program} describe` gave no answer in {longest:?}; end what it waits for, or set `run:` \
        to another program"
    )]
    Silent {
        /// The program.
        program: PathBuf,
        /// How long it was waited for.
        longest: Duration,
    },
    /// It fails.
    #[error("`{program} describe` failed ({status}): {said}")]
    Failed {
        /// The program.
        program: PathBuf,
        /// How it ended.
        status: ExitStatus,
        /// Its last line on stderr.
        said: String,
    },
    /// Its answer is no description.
    #[error("`{program} describe` gave no description: {problem}")]
    Form {
        /// The program.
        program: PathBuf,
        /// What is wrong.
        problem: String,
    },
}

/// What came of asking, by path.
pub type Answers = BTreeMap<PathBuf, Result<Description, DescribeError>>;

/// Asks programs, as many at once as there are cores.
pub fn ask_all(paths: &[PathBuf], stop: Option<&AtomicBool>) -> Result<Answers, Interrupted> {
    let is_stopped = &|| stop.is_some_and(|stop| stop.load(Ordering::Relaxed));
    let threads =
        std::thread::available_parallelism().map_or(1, std::num::NonZero::get).min(paths.len());
    let next = &AtomicUsize::new(0);
    let (sender, receiver) = mpsc::channel();
    let mut answers = Answers::new();
    std::thread::scope(|scope| {
        for _ in 0..threads {
            let sender = sender.clone();
            scope.spawn(move || ask_in_turn(paths, next, is_stopped, &sender));
        }
        drop(sender);
        let mut patience = NOTICE_AFTER;
        loop {
            match receiver.recv_timeout(patience) {
                Ok((path, answer)) => _ = answers.insert(path, answer),
                Err(mpsc::RecvTimeoutError::Timeout) => {
                    artifact::report_line!("asking the stages what they are, once for each build");
                    patience = Duration::MAX;
                }
                Err(mpsc::RecvTimeoutError::Disconnected) => break,
            }
        }
    });
    if is_stopped() { Err(Interrupted) } else { Ok(answers) }
}

/// Asks one program after the other, until all are asked or the asking is stopped.
fn ask_in_turn(
    paths: &[PathBuf],
    next: &AtomicUsize,
    is_stopped: &dyn Fn() -> bool,
    sender: &mpsc::Sender<(PathBuf, Result<Description, DescribeError>)>,
) {
    while let Some(path) = paths.get(next.fetch_add(1, Ordering::Relaxed)).filter(|_| !is_stopped())
    {
        // The receiver lives as long as the scope.
        sender.send((path.clone(), ask(path, LONGEST_ANSWER, is_stopped))).ok();
    }
}

/// A program's answer, or what is wrong with it.
fn ask(
    path: &Path,
    longest: Duration,
    is_stopped: &dyn Fn() -> bool,
) -> Result<Description, DescribeError> {
    let program = || path.to_path_buf();
    let fail = |problem| cannot_start(path, &problem);
    let mut command = Command::new(path);
    command.arg("describe").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let (group, (stdout, stderr)) = Group::start(&mut command).map_err(fail)?;
    let (stdout, stderr) = (read(stdout), read(stderr));
    let deadline = Instant::now() + longest;
    let is_over = wait(&group, deadline, is_stopped).map_err(fail)?;
    let left = || deadline.saturating_duration_since(Instant::now());
    let answer = is_over
        .then(|| Some((stdout.recv_timeout(left()).ok()?, stderr.recv_timeout(left()).ok()?)));
    let status = group.end().map_err(fail)?.status;
    let Some((stdout, stderr)) = answer.flatten() else {
        return Err(DescribeError::Silent { program: program(), longest });
    };
    if !status.success() {
        let stderr = String::from_utf8_lossy(&stderr);
        let last = || stderr.trim_end().lines().last().unwrap_or_default();
        let said = stderr.lines().rev().find_map(out_of_memory);
        let said = said.unwrap_or_else(|| last().replace(char::is_control, " "));
        return Err(DescribeError::Failed { program: program(), status, said });
    }
    serde_json::from_slice(&stdout)
        .map_err(|e| DescribeError::Form { program: program(), problem: e.to_string() })
}

fn cannot_start(program: &Path, problem: &std::io::Error) -> DescribeError {
    DescribeError::Start { program: program.to_path_buf(), problem: problem.to_string() }
}

/// Waits for a program to end. Returns false where it is too late or nobody waits any more.
fn wait(group: &Group, deadline: Instant, is_stopped: &dyn Fn() -> bool) -> std::io::Result<bool> {
    while Instant::now() < deadline && !is_stopped() {
        if group.is_over()? {
            return Ok(true);
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(false)
}

/// Reads a pipe to its end, beside; nobody has to wait for that.
fn read(pipe: Option<impl Read + Send + 'static>) -> mpsc::Receiver<Vec<u8>> {
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(pipe) = pipe {
            // What can't be read any more is no description.
            pipe.take(MOST_BYTES).read_to_end(&mut bytes).ok();
        }
        sender.send(bytes).ok();
    });
    receiver
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A program, written by another process: while this one's threads start others, a file that it
    /// has open itself can't be run.
    fn program(folder: &Path, name: &str, text: &str) -> PathBuf {
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
    fn programs_that_give_no_description() {
        let folder = tempfile::tempdir().unwrap();
        let never = || false;
        for (text, longest, words) in [
            ("#!/bin/sh\nsleep 1000\n", Duration::from_millis(50), "gave no answer in 50ms"),
            ("#!/bin/sh\nsleep 1000 &\n", Duration::from_millis(200), "gave no answer in 200ms"),
            (
                "#!/bin/sh\necho one >&2\nprintf 'two\\033[31m\\n' >&2\nexit 3\n",
                LONGEST_ANSWER,
                "failed (exit status: 3): two [31m",
            ),
            (
                "#!/bin/sh\necho '  what():  std::bad_alloc' >&2\nkill -ABRT $$\n",
                LONGEST_ANSWER,
                "failed (signal: 6 (SIGABRT)): out of memory; end other programs",
            ),
            ("#!/bin/sh\necho '{}'\n", LONGEST_ANSWER, "gave no description: missing field"),
            ("#!/nowhere/at/all\n", LONGEST_ANSWER, "describe`: No such file"),
        ] {
            let path = program(folder.path(), "stage", text);
            let problem = ask(&path, longest, &never).unwrap_err().to_string();
            assert!(problem.contains(words), "{problem}");
        }
        let path = program(folder.path(), "waits", "#!/bin/sh\nsleep 1000\n");
        let stop = AtomicBool::new(true);
        assert!(matches!(ask_all(std::slice::from_ref(&path), Some(&stop)), Err(Interrupted)));
        // Asked to end while it waits.
        assert!(ask(&path, LONGEST_ANSWER, &|| true).is_err());
    }
}
