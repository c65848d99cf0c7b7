//! The command that helps after a failure: whole, so that it can be pasted.

use crate::counts::left_out;

/// What the user typed, less the verb and what only `run` takes.
pub(crate) struct Remedy {
    program: String,
    arguments: Vec<String>,
}

impl Remedy {
    /// `arguments` are targets, values and files as given.
    pub(crate) fn new(arguments: Vec<String>) -> Self {
        let program = std::env::args_os()
            .next()
            .map_or_else(|| "nerf-sr".to_owned(), |p| p.to_string_lossy().into_owned());
        Self { program, arguments }
    }

    /// The command that prints the log of a stage of this run.
    pub(crate) fn log(&self, stage: &str) -> String {
        let words = [self.program.as_str(), "log", stage]
            .into_iter()
            .chain(self.arguments.iter().map(String::as_str));
        words.map(quoted).collect::<Vec<_>>().join(" ")
    }

    /// What to say after a failure, with how many stages were left out because of it.
    pub(crate) fn after_failure(&self, label: &str, stage: &str, skipped: usize) -> String {
        let skipped = left_out(skipped).map(|text| format!("; {text}")).unwrap_or_default();
        format!("nerf-sr: {label} failed{skipped}; `{}` has all it said", self.log(stage))
    }
}

/// A word as a shell reads it.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_@%+=:,./-".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_quoted_where_a_shell_would_read_more_into_them() {
        for (word, shown) in [
            ("train-ss", "train-ss"),
            ("dataset=/data/lego,./x", "dataset=/data/lego,./x"),
            ("dataset=my scenes/Bäume", "'dataset=my scenes/Bäume'"),
            ("name=it's $(rm)", r"'name=it'\''s $(rm)'"),
            ("~/x", "'~/x'"),
            ("", "''"),
        ] {
            assert_eq!(quoted(word), shown);
        }
    }

    #[test]
    fn the_command_is_whole() {
        let remedy = Remedy {
            program: "nerf-sr".to_owned(),
            arguments: vec!["-p".to_owned(), "x=a b".to_owned()],
        };
        let said = [0, 1].map(|skipped| remedy.after_failure("prep [x=a b]", "prep", skipped));
        assert_eq!(
            said[0],
            "nerf-sr: prep [x=a b] failed; `nerf-sr log prep -p 'x=a b'` has all it said"
        );
        assert_eq!(
            said[1],
            "nerf-sr: prep [x=a b] failed; 1 stage was not run; `nerf-sr log prep -p 'x=a b'` has \
            all it said"
        );
    }
}
