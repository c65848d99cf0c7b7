//! Process groups: a stage with the processes that it starts. Ctrl-C in a terminal signals the
//! runner alone: the first one makes it terminate its stages, the second one kills them.

use std::collections::BTreeSet;
use std::fmt::Display;
use std::io::{self, Read as _};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt as _;
use std::process::{Child, ChildStderr, ChildStdout, Command};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use artifact::Failure;
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, kill_process_group, waitid};
use stage::stop_signals;
use wait4::{ResUse, Wait4 as _};

/// Process ids of the leaders of all running groups. None of these leaders has been waited for, and
/// therefore no other process can have one of these ids.
static RUNNING: Mutex<BTreeSet<i32>> = Mutex::new(BTreeSet::new());

fn running() -> MutexGuard<'static, BTreeSet<i32>> {
    RUNNING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Running program that leads a process group. Dropping it kills the group.
pub(crate) struct Group {
    id: Pid,
    /// Process of the program; `None` after it has been waited for.
    leader: Option<Child>,
}

/// Pipes of a program's stdout and stderr, as far as they were requested.
pub(crate) type Pipes = (Option<ChildStdout>, Option<ChildStderr>);

impl Group {
    /// Starts a program as the leader of a new group.
    pub(crate) fn start(command: &mut Command) -> io::Result<(Self, Pipes)> {
        // Locked until the id is listed, so that `kill_all` misses no group.
        let mut running = running();
        let mut leader = command.process_group(0).spawn()?;
        let id = Pid::from_child(&leader);
        running.insert(id.as_raw_pid());
        let pipes = (leader.stdout.take(), leader.stderr.take());
        Ok((Self { id, leader: Some(leader) }, pipes))
    }

    /// Returns whether the leader has ended, without waiting for it or releasing its id.
    pub(crate) fn has_exited(&self) -> io::Result<bool> {
        let options = WaitIdOptions::EXITED | WaitIdOptions::NOWAIT | WaitIdOptions::NOHANG;
        Ok(waitid(WaitId::Pid(self.id), options)?.is_some())
    }

    /// Returns the peak resident memory of the leader's program so far, in bytes; `None` after its
    /// end or without `/proc`.
    pub(crate) fn peak_memory(&self) -> Option<u64> {
        peak_memory(self.id.as_raw_pid())
    }

    /// Sends SIGTERM to all processes of the group: a wrapper script would not forward the signal.
    pub(crate) fn terminate(&self) {
        // An error means that all of them have ended.
        kill_process_group(self.id, Signal::TERM).ok();
    }

    /// Kills the remaining processes of the group, which could otherwise continue to write and
    /// would keep pipes and locks open. Returns the leader's exit status and resource usage.
    pub(crate) fn kill(mut self) -> io::Result<ResUse> {
        let leader = self.leader.take().ok_or(io::ErrorKind::InvalidInput)?;
        kill_and_wait(self.id, leader)
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        if let Some(leader) = self.leader.take() {
            kill_and_wait(self.id, leader).ok();
        }
    }
}

/// Returns the peak resident memory of a process in bytes; `None` without `/proc`. `process` is an
/// id or `self`.
pub(crate) fn peak_memory(process: impl Display) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(1024 * kibibytes)
}

fn kill_and_wait(id: Pid, leader: Child) -> io::Result<ResUse> {
    // An error means that all processes have ended, as is usual.
    kill_process_group(id, Signal::KILL).ok();
    // Before the wait, after which another process may get the same id.
    running().remove(&id.as_raw_pid());
    leader.wait4()
}

/// Returns a flag that SIGINT, SIGTERM and SIGHUP set. The second signal kills all running groups
/// and ends the process with exit code 130.
pub fn stop_on_signals() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let (mut signals, sender) = UnixStream::pair()?;
    for signal in stop_signals() {
        signal_hook::low_level::pipe::register(signal, sender.try_clone()?)?;
    }
    let flag = Arc::clone(&stop);
    std::thread::Builder::new().spawn(move || {
        // The pipe gets a byte per signal; `sender` lives as long as the process.
        while signals.read_exact(&mut [0]).is_ok() {
            if flag.swap(true, Ordering::SeqCst) {
                kill_all();
                signal_hook::low_level::exit(Failure::Interrupted.exit_code().into());
            }
        }
    })?;
    Ok(stop)
}

/// Kills all groups, and blocks the start of further ones by keeping the lock.
fn kill_all() {
    let running = running();
    for id in running.iter().filter_map(|id| Pid::from_raw(*id)) {
        kill_process_group(id, Signal::KILL).ok();
    }
    std::mem::forget(running);
}
