//! Process groups: a stage with all that it starts. Ctrl-C in a terminal reaches the runner alone,
//! which asks its stages to end, once; a second Ctrl-C kills them.

use std::collections::BTreeSet;
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

/// Process ids of the leaders of all running groups. None has been waited for, so no other process
/// can have the same id.
static RUNNING: Mutex<BTreeSet<i32>> = Mutex::new(BTreeSet::new());

fn running() -> MutexGuard<'static, BTreeSet<i32>> {
    RUNNING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A running program that leads a process group. The group is killed when this is dropped.
pub(crate) struct Group {
    id: Pid,
    /// The program; none once it has been waited for.
    leader: Option<Child>,
}

/// The pipes of a program's stdout and stderr, where it has them.
pub(crate) type Pipes = (Option<ChildStdout>, Option<ChildStderr>);

impl Group {
    /// Starts a program.
    pub(crate) fn start(command: &mut Command) -> io::Result<(Self, Pipes)> {
        // Held meanwhile, so that nothing starts unseen while all groups are killed.
        let mut running = running();
        let mut leader = command.process_group(0).spawn()?;
        let id = i32::try_from(leader.id()).ok().and_then(Pid::from_raw);
        let id = id.ok_or(io::ErrorKind::InvalidInput)?;
        running.insert(id.as_raw_pid());
        let pipes = (leader.stdout.take(), leader.stderr.take());
        Ok((Self { id, leader: Some(leader) }, pipes))
    }

    /// Returns whether the leader has ended. It isn't waited for yet.
    pub(crate) fn is_over(&self) -> io::Result<bool> {
        let options = WaitIdOptions::EXITED | WaitIdOptions::NOWAIT | WaitIdOptions::NOHANG;
        Ok(waitid(WaitId::Pid(self.id), options)?.is_some())
    }

    /// Asks all processes of the group to end: a wrapper script would not pass the signal on.
    pub(crate) fn ask_to_end(&self) {
        // They may just have ended by themselves.
        kill_process_group(self.id, Signal::TERM).ok();
    }

    /// Kills what is left of the group, which would write unseen and hold pipes and locks. Returns
    /// how the leader ended, and what it used.
    pub(crate) fn end(mut self) -> io::Result<ResUse> {
        let leader = self.leader.take().ok_or(io::ErrorKind::InvalidInput)?;
        end(self.id, leader)
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        if let Some(leader) = self.leader.take() {
            end(self.id, leader).ok();
        }
    }
}

fn end(id: Pid, leader: Child) -> io::Result<ResUse> {
    // Mostly there is nothing left.
    kill_process_group(id, Signal::KILL).ok();
    // First: the number is free for others as soon as the leader is waited for.
    running().remove(&id.as_raw_pid());
    leader.wait4()
}

/// Returns a flag that SIGINT, SIGTERM and SIGHUP set. The second of them kills all groups that
/// run, and ends the process at once, with exit code 130.
pub fn stop_on_signals() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let (mut signals, sender) = UnixStream::pair()?;
    for signal in stop_signals() {
        signal_hook::low_level::pipe::register(signal, sender.try_clone()?)?;
    }
    let flag = Arc::clone(&stop);
    std::thread::Builder::new().spawn(move || {
        // A byte for each signal; `sender` lives as long as the process.
        while signals.read_exact(&mut [0]).is_ok() {
            if flag.swap(true, Ordering::SeqCst) {
                kill_all();
                signal_hook::low_level::exit(Failure::Interrupted.exit_code().into());
            }
        }
    })?;
    Ok(stop)
}

/// Kills all groups. None starts from then on.
fn kill_all() {
    let running = running();
    for id in running.iter().filter_map(|id| Pid::from_raw(*id)) {
        kill_process_group(id, Signal::KILL).ok();
    }
    std::mem::forget(running);
}
