use std::fs;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use artifact::Failure;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use crate::panics::end_process;

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
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
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
