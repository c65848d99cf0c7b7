use std::backtrace::{Backtrace, BacktraceStatus};
use std::fs::File;
use std::io::{IsTerminal as _, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::panic::PanicHookInfo;
use std::sync::atomic::{AtomicBool, Ordering};

use artifact::printable;

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
pub(crate) fn end_process(name: &str, message: &str, code: i32) -> ! {
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
