//! Inputs and parameters at the end of a stage's `--help`.

use crate::contract::{Description, ParameterDoc, group_parameters};
use textwrap::{Options, fill};

/// Width of the help text in columns.
const WIDTH: usize = 100;
/// Width of the name column: an indent of two, a name and a space.
const NAME_WIDTH: usize = 24;

/// Renders the inputs and parameters of a stage.
pub fn render_help(description: &Description) -> String {
    let mut text = String::new();
    if !description.inputs.is_empty() {
        text.push_str("Inputs, with the accepted kinds of artifact:\n");
        for (name, input) in &description.inputs {
            let note = if input.optional { ", optional" } else { "" };
            text.push_str(&entry(
                name,
                &format!("{} [{}{note}]", input.summary, input.kinds.join(" or ")),
            ));
        }
        text.push('\n');
    }
    let sections = description.parameter_sections();
    if sections.iter().all(|section| section.parameters.is_empty()) {
        return text + "This stage has no parameters.\n";
    }
    text.push_str(&format!(
        "Parameters, set in pipeline.yaml under `parameters:` or by -p NAME=VALUE of nerf-sr\n\
        (details: docs/reference/{}.md):\n",
        description.name
    ));
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
            for ParameterDoc { name, text: meaning, allowed, default, .. } in parameters {
                let meaning = format!("{meaning} [{allowed}; default: {default}]");
                text.push_str(&entry(name, &meaning));
            }
        }
    }
    text
}

fn entry(name: &str, text: &str) -> String {
    let label = format!("  {name:<width$}", width = NAME_WIDTH - 2);
    let indent = " ".repeat(NAME_WIDTH);
    fill(text, Options::new(WIDTH).initial_indent(&label).subsequent_indent(&indent)) + "\n"
}

/// Capitalises the first letter.
fn capitalised(word: &str) -> String {
    let mut letters = word.chars();
    letters.next().map(|first| first.to_uppercase().chain(letters).collect()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use crate::contract::{Input, Output};
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
            libtorch: false,
            rules: Vec::new(),
        };
        let expected = "\
Inputs, with the accepted kinds of artifact:
  scene                 images [scene/train or views, optional]

Parameters, set in pipeline.yaml under `parameters:` or by -p NAME=VALUE of nerf-sr
(details: docs/reference/x.md):

  rate                  Rate. [a number from 0 to 0.5; default: none]
  rays                  Rays. [a whole number from 1; default: 5]

Data:
  exposure              Finds exposures. [true, false; default: false]

Loss:
  supervision           What an LR pixel is compared with, said at such length that no line of a
                        terminal could ever hold all of it. [average, kernel; default: by scene]
";
        assert_eq!(render_help(&description), expected);
    }
}
