//! Words for people. Whoever reads them may go away (`| head -1`, a closed terminal): that stops
//! nothing and changes no exit code, so a write that fails is passed over. Control characters are
//! spelled out.

use std::io::Write;

use crate::printable::printable;

/// Prints one line to stdout, as `println!` does, but with control characters spelled out, and
/// without a panic when stdout is closed.
#[macro_export]
macro_rules! print_line {
    ($($arguments:tt)*) => { $crate::print_text(&format!($($arguments)*)) };
}

/// Prints one line to stderr, likewise.
#[macro_export]
macro_rules! report_line {
    ($($arguments:tt)*) => { $crate::report_text(&format!($($arguments)*)) };
}

/// What [`print_line!`] does.
pub fn print_text(line: &str) {
    write_line(&mut std::io::stdout(), line);
}

/// What [`report_line!`] does.
pub fn report_text(line: &str) {
    write_line(&mut std::io::stderr(), line);
}

/// Prints a text of several lines to stdout.
pub fn print_lines(text: &str) {
    let mut stdout = std::io::stdout().lock();
    text.lines().for_each(|line| write_line(&mut stdout, line));
}

fn write_line(to: &mut impl Write, text: &str) {
    // In one piece, so that lines of several threads don't mix.
    to.write_all(format!("{}\n", printable(text)).as_bytes()).ok();
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Closed;
    impl Write for Closed {
        fn write(&mut self, _: &[u8]) -> std::io::Result<usize> {
            Err(std::io::ErrorKind::BrokenPipe.into())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn lines_are_escaped_and_a_closed_pipe_is_no_panic() {
        let mut written = Vec::new();
        write_line(&mut written, "a\u{1b}[31mb\nc");
        assert_eq!(written, b"a\\u{1b}[31mb\\nc\n");
        write_line(&mut Closed, "nobody hears this");
    }
}
