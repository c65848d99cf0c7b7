//! Waits for locks. Each wait reports the lock's holder and ends on a signal.

use std::fs::{File, OpenOptions};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use artifact::{Failure, format_duration, report_line};
use store::{Entered, Holder, Locked, Store, StoreError, host_name, is_lock_acquired};

/// Interval between two attempts to lock; chosen by hand.
const ATTEMPT_INTERVAL: Duration = Duration::from_millis(20);
/// Delay before the first notice, since most waits are shorter; chosen by hand. The delay doubles
/// with each notice.
const NOTICE_DELAY: Duration = Duration::from_secs(1);

/// Attempts to lock until this succeeds or `stop` is set. `report` gets a notice that begins with
/// `cause`, and names the holder and the time waited so far.
pub(crate) fn wait_for_lock<T>(
    stop: &AtomicBool,
    cause: &str,
    report: &dyn Fn(&str),
    mut attempt: impl FnMut() -> Result<Locked<T>, StoreError>,
) -> anyhow::Result<T> {
    let begin = Instant::now();
    let mut next_notice = NOTICE_DELAY;
    loop {
        match attempt()? {
            Locked::Acquired(held) => return Ok(held),
            Locked::HeldBy(holder) => {
                if stop.load(Ordering::Relaxed) {
                    return Err(Failure::Interrupted.into());
                }
                if begin.elapsed() >= next_notice {
                    let holder = holder_text(holder.as_ref());
                    let waited = format_duration(begin.elapsed().as_secs_f64());
                    report(&format!("{cause}{holder}; waiting ({waited} so far)"));
                    next_notice *= 2;
                }
                std::thread::sleep(ATTEMPT_INTERVAL);
            }
        }
    }
}

/// Enters the store; waits while garbage collection runs.
pub(crate) fn enter_store(
    store: &Store,
    stop: &AtomicBool,
    report: &dyn Fn(&str),
) -> anyhow::Result<Entered> {
    wait_for_lock(stop, "garbage is being collected", report, || store.try_enter())
}

/// Opens and locks a file or folder; waits while another process holds the lock, and reports this
/// on stderr. For locks whose holder is unknown.
pub(crate) fn lock_file(
    path: &Path,
    options: &OpenOptions,
    stop: &AtomicBool,
) -> anyhow::Result<File> {
    let cause = format!("another run has locked {}", path.display());
    wait_for_lock(stop, &cause, &|text| report_line!("nerf-sr: {text}"), || {
        let file = options
            .open(path)
            .map_err(|source| StoreError::Io { path: path.to_path_buf(), source })?;
        let is_acquired = is_lock_acquired(path, file.try_lock())?;
        Ok(if is_acquired { Locked::Acquired(file) } else { Locked::HeldBy(None) })
    })
}

/// Enters the store, or fails if garbage collection runs.
pub(crate) fn try_enter_store(store: &Store) -> anyhow::Result<Entered> {
    match store.try_enter()? {
        Locked::Acquired(entered) => Ok(entered),
        Locked::HeldBy(_) => Err(anyhow::anyhow!("garbage collection is running; try again later")),
    }
}

/// Returns ` by process …` for a lock's holder; empty if the holder is unknown.
fn holder_text(holder: Option<&Holder>) -> String {
    let Some(Holder { pid, host, .. }) = holder else { return String::new() };
    if *host != host_name() {
        return format!(" by process {pid} on {host}");
    }
    let raw = i32::try_from(*pid).ok().and_then(rustix::process::Pid::from_raw);
    let is_alive = raw
        .is_some_and(|pid| rustix::process::test_kill_process(pid) != Err(rustix::io::Errno::SRCH));
    if is_alive {
        format!(" by process {pid}")
    } else {
        // A killed runner's stage inherited the lock.
        format!(" by a child of process {pid} (ended)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;

    /// A wait reports the holder and ends with the signal, however long the lock is held.
    #[test]
    fn a_signal_ends_a_wait() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let Locked::Acquired(_lock) = store.try_lock("k").unwrap() else { panic!("held") };
        let stop = AtomicBool::new(false);
        let reports = RefCell::new(Vec::new());
        let report = |text: &str| {
            reports.borrow_mut().push(text.to_owned());
            stop.store(true, Ordering::Relaxed);
        };
        let failure =
            wait_for_lock(&stop, "is in use", &report, || store.try_lock("k")).unwrap_err();
        assert_eq!(crate::exit_code(&failure), 130);
        let text = format!("is in use by process {}; waiting (1.0 s so far)", std::process::id());
        assert_eq!(reports.into_inner(), [text]);
    }

    #[test]
    fn a_file_is_locked_by_one_at_a_time() {
        let dir = tempfile::tempdir().unwrap();
        let stop = AtomicBool::new(false);
        let lock = || {
            let path = dir.path().join("lock");
            lock_file(&path, File::options().create(true).append(true), &stop)
        };
        let held = lock().unwrap();
        let failure = std::thread::scope(|scope| {
            let second = scope.spawn(lock);
            std::thread::sleep(5 * ATTEMPT_INTERVAL);
            assert!(!second.is_finished(), "the second one waits");
            stop.store(true, Ordering::Relaxed);
            second.join().unwrap().unwrap_err()
        });
        assert_eq!(crate::exit_code(&failure), 130);
        drop(held);
        stop.store(false, Ordering::Relaxed);
        lock().unwrap();
    }

    #[test]
    fn holders_are_named_by_machine_and_process() {
        let holder = Holder::this_process();
        assert_eq!(
            holder_text(Some(&Holder { host: "far".into(), ..holder.clone() })),
            format!(" by process {} on far", holder.pid)
        );
        let gone = holder_text(Some(&Holder { pid: 0x7fff_fff0, ..holder }));
        assert!(gone.ends_with("(ended)"), "{gone}");
        assert_eq!(holder_text(None), "");
    }
}
