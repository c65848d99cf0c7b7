use std::backtrace::{Backtrace, BacktraceStatus};
use std::fs::File;
use std::io::{IsTerminal as _, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::panic::PanicHookInfo;
use std::sync::atomic::{AtomicBool, Ordering};

use artifact::printable;

use crate::memory::out_of_memory;
use crate::progress::failed_event;

/// Exit code of a panic: a fault of the program, not of what it was given.
const INTERNAL_ERROR: i32 = 70;

/// From now on a panic in any thread ends the process with one line, and exit code 70. Memory that
/// isn't to be had ends it with exit code 1: some libraries panic then. A backtrace comes before
/// the line where `RUST_BACKTRACE` asks for it.
pub fn install_panic_hook(name: &'static str) {
    std::panic::set_hook(Box::new(move |panic| end(name, panic)));
}

/// Ends at once: unwinding would leave other threads waiting, and destructors may panic again.
fn end(name: &str, panic: &PanicHookInfo<'_>) -> ! {
    static ENDING: AtomicBool = AtomicBool::new(false);
    if ENDING.swap(true, Ordering::SeqCst) {
        // Another thread's panic is being told.
        loop {
            std::thread::park();
        }
    }
    let (message, code) = told(panic);
    let backtrace = Backtrace::capture();
    if backtrace.status() == BacktraceStatus::Captured {
        write(std::io::stderr().as_fd(), &format!("{backtrace}"));
    }
    end_process(name, &message, code)
}

/// Ends the process from any thread, with the reason on stderr and, for a runner, as an event.
pub(crate) fn end_process(name: &str, message: &str, code: i32) -> ! {
    // The line of a progress bar may be there.
    let clear = if std::io::stderr().is_terminal() { "\r\x1b[K" } else { "" };
    write(std::io::stderr().as_fd(), &format!("{clear}{name}: {message}\n"));
    if let Some(event) = failed_event(message) {
        write(std::io::stdout().as_fd(), &event);
    }
    signal_hook::low_level::exit(code)
}

fn told(panic: &PanicHookInfo<'_>) -> (String, i32) {
    let said = panic.payload_as_str().unwrap_or("no message");
    if let Some(message) = out_of_memory(said) {
        return (message, 1);
    }
    let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
    let place =
        panic.location().map(|at| format!(" ({}:{})", at.file(), at.line())).unwrap_or_default();
    (format!("internal error: {}{place}; please report it", printable(&said)), INTERNAL_ERROR)
}

/// Writes past the locks of `std::io::stdout` and `stderr`, which this or another thread may hold.
fn write(to: BorrowedFd<'_>, text: &str) {
    if let Ok(own) = to.try_clone_to_owned() {
        File::from(own).write_all(text.as_bytes()).ok();
    }
}
