//! Early end of a program: by a panic, by a signal, or after a signal's deadline.

use std::backtrace::{Backtrace, BacktraceStatus};
use std::fs::{self, File};
use std::io::{self, IsTerminal as _, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::panic::PanicHookInfo;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use artifact::{Failure, printable};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use crate::memory::out_of_memory_message;
use crate::progress::failed_event;

/// Exit code of a panic, which is an error of the program, not of its input.
const INTERNAL_ERROR: i32 = 70;

/// Makes a panic in any thread end the process with a one-line message and exit code 70, or with
/// exit code 1 if a library panics because memory is exhausted. With `RUST_BACKTRACE` a backtrace
/// precedes the message.
pub fn install_panic_hook(name: &'static str) {
    std::panic::set_hook(Box::new(move |panic| end_by_panic(name, panic)));
}

/// Ends the process without unwinding, which would leave other threads waiting, and in which
/// destructors may panic again.
fn end_by_panic(name: &str, panic: &PanicHookInfo<'_>) -> ! {
    static IS_ENDING: AtomicBool = AtomicBool::new(false);
    if IS_ENDING.swap(true, Ordering::SeqCst) {
        // Another thread's panic is being reported.
        loop {
            std::thread::park();
        }
    }
    let (message, code) = describe_panic(panic);
    let backtrace = Backtrace::capture();
    if backtrace.status() == BacktraceStatus::Captured {
        write(std::io::stderr().as_fd(), &format!("{backtrace}"));
    }
    end_process(name, &message, code)
}

/// Ends the process from any thread, with a message on stderr and, if enabled, as an event.
fn end_process(name: &str, message: &str, code: i32) -> ! {
    // Clears the line of a progress bar.
    let clear = if std::io::stderr().is_terminal() { "\r\x1b[K" } else { "" };
    write(std::io::stderr().as_fd(), &format!("{clear}{name}: {message}\n"));
    if let Some(event) = failed_event(message) {
        write(std::io::stdout().as_fd(), &event);
    }
    signal_hook::low_level::exit(code)
}

/// Returns the message and the exit code of a panic.
fn describe_panic(panic: &PanicHookInfo<'_>) -> (String, i32) {
    let payload = panic.payload_as_str().unwrap_or("no message");
    if let Some(message) = out_of_memory_message(payload) {
        return (message, 1);
    }
    let line = payload.split_whitespace().collect::<Vec<_>>().join(" ");
    let location =
        panic.location().map_or_else(String::new, |l| format!(" ({}:{})", l.file(), l.line()));
    (format!("internal error: {}{location}; please report it", printable(&line)), INTERNAL_ERROR)
}

/// Writes without the locks of `std::io::stdout` and `stderr`, which any thread may hold.
fn write(file: BorrowedFd<'_>, text: &str) {
    if let Ok(owned) = file.try_clone_to_owned() {
        File::from(owned).write_all(text.as_bytes()).ok();
    }
}

/// Time after a signal in which a stage may write a checkpoint and end by itself. Chosen by hand,
/// so that the process ends within two seconds, including the time to free many gigabytes.
const GRACE_PERIOD: Duration = Duration::from_secs(1);
/// Interval between checks of the flag that signals set.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);

/// Returns a flag that is set when the first of any of the [`stop_signals`] arrives. The second
/// signal, the same or another, ends the process immediately with exit code 130.
pub fn stop_on_signals() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in stop_signals() {
        let code = i32::from(Failure::Interrupted.exit_code());
        // The order matters: the flag is tested before the same signal sets it.
        signal_hook::flag::register_conditional_shutdown(signal, code, Arc::clone(&stop))?;
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

/// Returns the signals that end a program: SIGINT, SIGTERM and SIGHUP. SIGHUP is omitted if the
/// process ignores it (`nohup`), since such a process outlives its terminal.
pub fn stop_signals() -> Vec<i32> {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let hangup = (!is_ignored(&status, SIGHUP)).then_some(SIGHUP);
    [SIGINT, SIGTERM].into_iter().chain(hangup).collect()
}

/// Returns whether a process ignores a signal, given its `/proc/PID/status`.
fn is_ignored(status: &str, signal: i32) -> bool {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).map(str::trim);
    mask.and_then(|mask| u64::from_str_radix(mask, 16).ok())
        .is_some_and(|mask| (mask >> (signal - 1)) & 1 == 1)
}

/// Right to end the process, claimed by the stage or by its deadline, whichever comes first.
///
/// The deadline exists because one call of libtorch, a decoder or the file system may take minutes,
/// during which no loop checks for signals. Ending the process is always safe, since outputs, parts
/// and checkpoints only appear by renaming.
#[derive(Clone, Default)]
pub(crate) struct EndClaim {
    is_claimed: Arc<AtomicBool>,
}

impl EndClaim {
    /// Claims the end for the calling thread. If another thread has claimed it, the calling thread
    /// waits for the process to end.
    pub(crate) fn claim(&self) {
        if self.is_claimed.swap(true, Ordering::SeqCst) {
            loop {
                std::thread::park();
            }
        }
    }

    /// Starts a thread that ends the process and removes the unpublished `output`, unless the stage
    /// ends by itself within [`GRACE_PERIOD`] after `interrupted` is set.
    pub(crate) fn enforce_deadline(
        &self,
        stage: &'static str,
        interrupted: &Arc<AtomicBool>,
        output: &Path,
    ) -> io::Result<()> {
        let (claim, interrupted) = (self.clone(), Arc::clone(interrupted));
        let output = output.to_path_buf();
        let watch = move || {
            while !interrupted.load(Ordering::Relaxed) {
                std::thread::sleep(CHECK_INTERVAL);
            }
            std::thread::sleep(GRACE_PERIOD);
            claim.claim();
            fs::remove_dir_all(&output).ok();
            let failure = Failure::Interrupted;
            end_process(stage, &failure.to_string(), i32::from(failure.exit_code()))
        };
        std::thread::Builder::new().name("deadline".to_owned()).spawn(watch)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the `/proc/PID/status` of a process with a mask of ignored signals.
    fn status(mask: &str) -> String {
        format!(
            "Name:\tprep\nSigBlk:\tffffffffffffffff\nSigIgn:\t{mask}\n\
            SigCgt:\tffffffffffffffff\n"
        )
    }

    #[test]
    fn a_hangup_ignored_through_nohup_is_detected() {
        assert!(is_ignored(&status("0000000000001001"), SIGHUP));
        assert!(!is_ignored(&status("0000000000001000"), SIGHUP));
        assert!(!is_ignored("", SIGHUP));
    }
}
