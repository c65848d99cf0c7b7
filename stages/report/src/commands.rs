use std::path::Path;

use artifact::{RunNode, RunRecord, shell_quoted};
use maud::{Markup, html};

/// Section with the run's command line.
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
                p {
                    "The run's command line isn't recorded. Each stage above has the command that "
                    "runs it alone."
                }
            }
        }
    }
}

/// Box with a command to copy.
fn command(line: &str) -> Markup {
    html! { div class="command" { pre tabindex="0" { code { (line) } } } }
}

/// Returns the command line of the run, quoted for a shell; `None` if it isn't recorded.
pub(crate) fn run_command(run: &RunRecord) -> Option<String> {
    let (program, words) = run.command.split_first()?;
    let words = words.iter().map(|word| shell_quoted(word));
    Some([file_name(program.as_ref())].into_iter().chain(words).collect::<Vec<_>>().join(" "))
}

/// Box with the bash command that runs a stage alone, with equal inputs and parameters.
pub(crate) fn stage_command(run: &RunRecord, node: &RunNode) -> Markup {
    if node.program.is_empty() {
        return html! {};
    }
    let parameters = serde_json::Value::Object(node.parameters.clone()).to_string();
    let mut line = format!("{} --params <(echo {})", node.program, shell_quoted(&parameters));
    for (name, input) in &node.inputs {
        let folder = run.folder_of(input);
        line +=
            &format!(" \\\n  --input {}", shell_quoted(&format!("{name}={}", folder.display())));
    }
    line += &format!(" \\\n  --output {}", shell_quoted(&format!("my-{}", node.stage)));
    command(&line)
}

/// Returns the last component of a path.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_can_be_pasted() {
        let arguments =
            ["/opt/bin/nerf-sr", "run", "-i", "dataset=my data/it's", "-p", "rays=1,2", ""];
        let command = arguments.map(str::to_owned).to_vec();
        let run = RunRecord { command, ..RunRecord::default() };
        let expected = r"nerf-sr run -i 'dataset=my data/it'\''s' -p rays=1,2 ''";
        assert_eq!(run_command(&run).unwrap(), expected);
        assert_eq!(run_command(&RunRecord::default()), None);
    }
}
