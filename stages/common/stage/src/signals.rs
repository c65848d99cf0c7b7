use std::io;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use artifact::Failure;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

/// Returns a flag that the [`stop_signals`] set. The second of them ends the process at once, with
/// exit code 130.
pub fn stop_on_signals() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in stop_signals() {
        let code = i32::from(Failure::Interrupted.exit_code());
        // The order matters: this looks at the flag before that sets it.
        signal_hook::flag::register_conditional_shutdown(signal, code, Arc::clone(&stop))?;
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

/// Returns the signals that ask a program to end: SIGINT, SIGTERM and SIGHUP. SIGHUP is left out
/// where it is ignored (`nohup`): such a process shall outlive its terminal.
pub fn stop_signals() -> Vec<i32> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let hangup = (!ignores(&status, SIGHUP)).then_some(SIGHUP);
    [SIGINT, SIGTERM].into_iter().chain(hangup).collect()
}

/// Whether a process ignores a signal, by the kernel's text on it.
fn ignores(status: &str, signal: i32) -> bool {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).map(str::trim);
    mask.and_then(|mask| u64::from_str_radix(mask, 16).ok())
        .is_some_and(|mask| (mask >> (signal - 1)) & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status(mask: &str) -> String {
        format!(
            "Name:\tprep\nSigBlk:\tffffffffffffffff\nSigIgn:\t{mask}\n\
            SigCgt:\tffffffffffffffff\n"
        )
    }

    #[test]
    fn what_nohup_leaves_behind_is_seen() {
        assert!(ignores(&status("0000000000001001"), SIGHUP));
        assert!(!ignores(&status("0000000000001000"), SIGHUP));
        assert!(!ignores("", SIGHUP));
    }
}
