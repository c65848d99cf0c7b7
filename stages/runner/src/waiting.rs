//! Waits that look at signals and say whom they wait for.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use stage_call::{StageFailure, seconds};
use store::{Entered, Holder, Locked, Store, StoreError, host_name};

/// Between two attempts.
const ATTEMPT_INTERVAL: Duration = Duration::from_millis(20);
/// So long nothing is said: most waits are over by then. Each later word comes after twice the
/// time.
const NOTICE_AFTER: Duration = Duration::from_secs(1);

/// Attempts until it is held. `say` is told by whom it is held, and since when it is waited for.
pub(crate) fn until_held<T>(
    stop: &AtomicBool,
    say: &dyn Fn(Option<&Holder>, Duration),
    mut attempt: impl FnMut() -> Result<Locked<T>, StoreError>,
) -> Result<T, StageFailure> {
    let (since, mut next) = (Instant::now(), NOTICE_AFTER);
    loop {
        match attempt().map_err(|e| StageFailure { code: 1, message: e.to_string() })? {
            Locked::Held(held) => return Ok(held),
            Locked::By(holder) => {
                if stop.load(Ordering::Relaxed) {
                    return Err(StageFailure {
                        code: 130,
                        message: "interrupted while it waited".to_owned(),
                    });
                }
                if since.elapsed() >= next {
                    say(holder.as_ref(), since.elapsed());
                    next *= 2;
                }
                std::thread::sleep(ATTEMPT_INTERVAL);
            }
        }
    }
}

/// Enters the store; waits while garbage is collected.
pub(crate) fn enter(
    store: &Store,
    stop: &AtomicBool,
    say: &dyn Fn(&str),
) -> Result<Entered, StageFailure> {
    until_held(
        stop,
        &|holder, waited| {
            say(&format!(
                "waits for garbage collection{}, for {} now",
                by(holder),
                seconds(waited.as_secs_f64())
            ));
        },
        || store.try_enter(),
    )
}

/// Enters the store for a verb that doesn't wait.
pub(crate) fn enter_at_once(store: &Store) -> anyhow::Result<Entered> {
    match store.try_enter()? {
        Locked::Held(entered) => Ok(entered),
        Locked::By(_) => {
            Err(anyhow::anyhow!("garbage is being collected just now; try again when that is done"))
        }
    }
}

/// Who holds a lock, in words.
pub(crate) fn by(holder: Option<&Holder>) -> String {
    let Some(holder) = holder else { return String::new() };
    if holder.host != host_name() {
        return format!(" by process {} on {}", holder.pid, holder.host);
    }
    let pid = i32::try_from(holder.pid).ok().and_then(rustix::process::Pid::from_raw);
    let lives = pid
        .is_some_and(|pid| rustix::process::test_kill_process(pid) != Err(rustix::io::Errno::SRCH));
    if lives {
        format!(" by process {}", holder.pid)
    } else {
        format!(" by a stage that process {} left, which has ended", holder.pid)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;

    /// A wait ends with the signal, however long the lock is held, and says whom it waits for.
    #[test]
    fn a_wait_looks_at_signals() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let Locked::Held(_lock) = store.try_lock("k").unwrap() else { panic!("held") };
        let stop = AtomicBool::new(false);
        let said = RefCell::new(Vec::new());
        let say = |holder: Option<&Holder>, _: Duration| {
            said.borrow_mut().push(by(holder));
            stop.store(true, Ordering::Relaxed);
        };
        let failure = until_held(&stop, &say, || store.try_lock("k")).unwrap_err();
        assert_eq!(failure.code, 130);
        assert_eq!(said.into_inner(), [format!(" by process {}", std::process::id())]);
    }

    #[test]
    fn holders_are_told_by_machine_and_life() {
        let holder = Holder::this_process();
        assert_eq!(
            by(Some(&Holder { host: "far".into(), ..holder.clone() })),
            format!(" by process {} on far", holder.pid)
        );
        let gone = by(Some(&Holder { pid: 0x7fff_fff0, ..holder }));
        assert!(gone.ends_with("which has ended"), "{gone}");
        assert_eq!(by(None), "");
    }
}
