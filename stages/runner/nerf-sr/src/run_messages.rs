//! Messages at the end of a run.

use artifact::{format_count, shell_quoted};

/// Returns the message after a successful run: the numbers of stages that ran and were cached.
pub(crate) fn end_message(ran: usize, all: usize, has_written_page: bool) -> String {
    if ran == 0 && !has_written_page {
        return all_cached(all);
    }
    let cached = all - ran;
    format!("{ran} of {} ran, {cached} {} cached", format_count(all, "stage"), was_or_were(cached))
}

/// Returns the message of a run in which every stage was cached.
pub(crate) fn all_cached(all: usize) -> String {
    match all {
        1 => "nothing to run: the stage is cached".to_owned(),
        all => format!("nothing to run: all {all} stages are cached"),
    }
}

fn was_or_were(count: usize) -> &'static str {
    if count == 1 { "was" } else { "were" }
}

/// Returns the message after a stage's failure. `skipped` is the number of stages that were not run
/// because of the failure; `log_command` prints the stage's log.
pub(crate) fn failure_message(label: &str, skipped: usize, log_command: &str) -> String {
    let skipped = match skipped {
        0 => String::new(),
        n => format!("; {} {} not run", format_count(n, "stage"), was_or_were(n)),
    };
    format!("nerf-sr: {label} failed{skipped}; `{log_command}` prints the log")
}

/// Returns a command as text, for a POSIX shell.
pub(crate) fn command_text<'a>(words: impl IntoIterator<Item = &'a str>) -> String {
    words.into_iter().map(shell_quoted).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn singular_and_plural_are_correct() {
        assert_eq!(end_message(4, 5, true), "4 of 5 stages ran, 1 was cached");
        assert_eq!(end_message(1, 1, false), "1 of 1 stage ran, 0 were cached");
        assert_eq!(end_message(0, 5, true), "0 of 5 stages ran, 5 were cached");
        assert_eq!(end_message(0, 1, false), "nothing to run: the stage is cached");
        assert_eq!(end_message(0, 5, false), "nothing to run: all 5 stages are cached");
    }

    #[test]
    fn failures_name_the_command_of_the_log() {
        let log = command_text(["nerf-sr", "log", "prep", "-p", "x=a b"]);
        assert_eq!(log, "nerf-sr log prep -p 'x=a b'");
        for (skipped, between) in
            [(0, ""), (1, "; 1 stage was not run"), (2, "; 2 stages were not run")]
        {
            assert_eq!(
                failure_message("prep [x=a b]", skipped, &log),
                format!("nerf-sr: prep [x=a b] failed{between}; `{log}` prints the log")
            );
        }
    }
}
