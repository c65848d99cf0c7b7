use std::path::Path;

use artifact::{RunNode, RunRecord};
use maud::{Markup, html};

/// The command that the page is of.
pub(crate) fn commands(run: &RunRecord) -> Markup {
    html! {
        section id="commands" aria-labelledby="commands-heading" {
            h2 id="commands-heading" { "Commands" }
            @if let Some(line) = run_command(run) {
                p { "This run:" }
                (command(&line))
                p class="note" {
                    @if run.failed.is_empty() { "A second run finds everything in the cache. " }
                    "Each stage above has the command that runs it alone."
                }
            } @else {
                p { "The run's command line isn't recorded. Each stage above has the command that \
                    runs it alone." }
            }
        }
    }
}

/// A command to copy.
fn command(line: &str) -> Markup {
    html! { div class="command" { pre tabindex="0" { code { (line) } } } }
}

/// The command line of the run.
pub(crate) fn run_command(run: &RunRecord) -> Option<String> {
    let (program, words) = run.command.split_first()?;
    let words = words.iter().map(|word| quoted(word));
    Some([name_of(program.as_ref())].into_iter().chain(words).collect::<Vec<_>>().join(" "))
}

/// What runs a stage alone, with the same inputs and parameters; in bash.
pub(crate) fn stage_command(run: &RunRecord, node: &RunNode) -> Markup {
    if node.program.is_empty() {
        return html! {};
    }
    let parameters = serde_json::Value::Object(node.parameters.clone()).to_string();
    let mut line = format!("{} --params <(echo {})", node.program, quoted(&parameters));
    for (name, input) in &node.inputs {
        let folder = run.folder_of(input);
        line += &format!(" \\\n  --input {}", quoted(&format!("{name}={}", folder.display())));
    }
    line += &format!(" \\\n  --output {}", quoted(&format!("my-{}", node.stage)));
    command(&line)
}

/// A word as a shell reads it.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,:+@%".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

/// The last part of a path.
pub(crate) fn name_of(path: &Path) -> String {
    let name = path.file_name().unwrap_or(path.as_os_str());
    name.to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_can_be_pasted() {
        let words = ["/opt/bin/nerf-sr", "run", "-i", "dataset=my data/it's", "-p", "rays=1,2", ""];
        let command = words.map(str::to_owned).to_vec();
        let run = RunRecord { command, ..RunRecord::default() };
        let expected = r"nerf-sr run -i 'dataset=my data/it'\''s' -p rays=1,2 ''";
        assert_eq!(run_command(&run).unwrap(), expected);
        assert_eq!(run_command(&RunRecord::default()), None);
    }
}
