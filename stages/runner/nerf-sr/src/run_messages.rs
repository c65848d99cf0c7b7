//! Messages at the end of a run.

use artifact::format_count;

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

/// Message after a stage's failure, with the complete command that prints the stage's log.
pub(crate) struct FailureHint {
    program: String,
    /// The user's arguments, without the verb and without options that only `run` has.
    arguments: Vec<String>,
}

impl FailureHint {
    /// Creates a hint. `arguments` follow the stage's name in the command `nerf-sr log STAGE …`.
    pub(crate) fn new(arguments: Vec<String>) -> Self {
        let program = std::env::args_os()
            .next()
            .map_or_else(|| "nerf-sr".to_owned(), |p| p.to_string_lossy().into_owned());
        Self { program, arguments }
    }

    /// Returns the command that prints a stage's log.
    fn log_command(&self, stage: &str) -> String {
        let mut words = vec![shell_quoted(&self.program), "log".to_owned(), shell_quoted(stage)];
        words.extend(self.arguments.iter().map(|word| shell_quoted(word)));
        words.join(" ")
    }

    /// Returns the message after a stage's failure. `skipped` is the number of stages that were not
    /// run because of the failure.
    pub(crate) fn message(&self, label: &str, stage: &str, skipped: usize) -> String {
        let skipped = match skipped {
            0 => String::new(),
            n => format!("; {} {} not run", format_count(n, "stage"), was_or_were(n)),
        };
        format!("nerf-sr: {label} failed{skipped}; `{}` prints the log", self.log_command(stage))
    }
}

/// Returns a command of this program as text, for a POSIX shell.
pub(crate) fn command_text(arguments: &[String]) -> String {
    let words = arguments.iter().map(|word| shell_quoted(word));
    [&["nerf-sr".to_owned()], &words.collect::<Vec<_>>()[..]].concat().join(" ")
}

/// Quotes a word for a POSIX shell where necessary.
fn shell_quoted(word: &str) -> String {
    let is_plain = word.chars().all(|c| c.is_ascii_alphanumeric() || "_@%+=:,./-".contains(c));
    if is_plain && !word.is_empty() {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
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
    fn arguments_are_quoted_for_a_shell() {
        for (argument, quoted) in [
            ("train-ss", "train-ss"),
            ("dataset=/data/lego,./x", "dataset=/data/lego,./x"),
            ("dataset=my scenes/Bäume", "'dataset=my scenes/Bäume'"),
            ("name=it's $(rm)", r"'name=it'\''s $(rm)'"),
            ("~/x", "'~/x'"),
            ("", "''"),
        ] {
            assert_eq!(shell_quoted(argument), quoted);
        }
    }

    #[test]
    fn failures_name_the_command_of_the_log() {
        let hint = FailureHint {
            program: "nerf-sr".to_owned(),
            arguments: vec!["-p".to_owned(), "x=a b".to_owned()],
        };
        let log = "`nerf-sr log prep -p 'x=a b'` prints the log";
        for (skipped, between) in
            [(0, ""), (1, "; 1 stage was not run"), (2, "; 2 stages were not run")]
        {
            assert_eq!(
                hint.message("prep [x=a b]", "prep", skipped),
                format!("nerf-sr: prep [x=a b] failed{between}; {log}")
            );
        }
    }
}
