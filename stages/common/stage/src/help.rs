//! The end of a stage's `--help`: inputs and parameters, in groups, wrapped.

use contract::{Description, ParameterDoc, group_parameters};
use textwrap::{Options, fill};

/// Columns of the help.
const WIDTH: usize = 100;
/// Columns before a description: two of indent, a name and a space.
const NAME_WIDTH: usize = 24;

/// Inputs and parameters of a stage.
pub(crate) fn help_of(description: &Description) -> String {
    let mut text = String::new();
    if !description.inputs.is_empty() {
        text.push_str("Inputs, with the kinds of artifact that they take:\n");
        for (name, input) in &description.inputs {
            let note = if input.optional { ", optional" } else { "" };
            text.push_str(&entry(
                name,
                &format!("{} [{}{note}]", input.summary, input.kinds.join(" or ")),
            ));
        }
        text.push('\n');
    }
    let sections = description.documented();
    if sections.iter().all(|section| section.parameters.is_empty()) {
        return text + "It has no parameters.\n";
    }
    text.push_str(
        "Parameters: in pipeline.yaml under `parameters:`, or as -p NAME=VALUE of nerf-sr.\n",
    );
    text.push_str(&format!("All about them: docs/reference/{}.md\n", description.name));
    for section in &sections {
        if let Some(variant) = &section.variant {
            text.push_str(&format!("\nWith {variant}\n"));
        }
        for (group, parameters) in group_parameters(&section.parameters) {
            if group.is_empty() {
                text.push('\n');
            } else {
                text.push_str(&format!("\n{}:\n", capitalised(group)));
            }
            parameters.into_iter().for_each(|parameter| text.push_str(&parameter_entry(parameter)));
        }
    }
    text
}

fn parameter_entry(parameter: &ParameterDoc) -> String {
    entry(
        &parameter.name,
        &format!("{} [{}; default: {}]", parameter.text, parameter.allowed, parameter.default),
    )
}

fn entry(name: &str, text: &str) -> String {
    let first = format!("  {name:<width$}", width = NAME_WIDTH - 2);
    let further = " ".repeat(NAME_WIDTH);
    fill(text, Options::new(WIDTH).initial_indent(&first).subsequent_indent(&further)) + "\n"
}

/// A word with a capital letter.
fn capitalised(word: &str) -> String {
    let mut letters = word.chars();
    letters.next().map(|first| first.to_uppercase().chain(letters).collect()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use contract::{Input, Output};
    use serde_json::json;

    use super::*;

    #[test]
    fn help_is_grouped_and_wrapped() {
        let long = "What an LR pixel is compared with, said at such length that no line of a \
            terminal could ever hold all of it.";
        let description = Description {
            name: "x".to_owned(),
            version: String::new(),
            code: String::new(),
            summary: String::new(),
            parameters: json!({"properties": {
                "supervision": {"description": long, "enum": ["average", "kernel"],
                "default": null, "x-default": "by scene", "x-group": "loss"},
                "exposure": {"description": "Finds exposures.", "type": "boolean",
                "default": false, "x-group": "data"},
                "rays": {"description": "Rays.", "type": "integer", "minimum": 1, "default": 5},
                "rate": {"description": "Rate.", "type": ["number", "null"], "minimum": 0.0,
                "maximum": 0.5, "default": null}
            }}),
            inputs: [("scene".to_owned(), Input::optional(&["scene/train", "views"], "images"))]
                .into(),
            output: Output::kind("x"),
            environment: Vec::new(),
            sink: false,
            partial: false,
            from_checkpoint: false,
            rules: Vec::new(),
        };
        let expected = "\
Inputs, with the kinds of artifact that they take:
  scene                 images [scene/train or views, optional]

Parameters: in pipeline.yaml under `parameters:`, or as -p NAME=VALUE of nerf-sr.
All about them: docs/reference/x.md

  rate                  Rate. [a number from 0 to 0.5; default: none]
  rays                  Rays. [a whole number from 1; default: 5]

Data:
  exposure              Finds exposures. [true, false; default: false]

Loss:
  supervision           What an LR pixel is compared with, said at such length that no line of a
                        terminal could ever hold all of it. [average, kernel; default: by scene]
";
        assert_eq!(help_of(&description), expected);
    }
}
