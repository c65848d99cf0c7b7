//! Human-readable documentation of a stage's parameters (groups, allowed values and defaults), and
//! the end of its `--help`.

use serde_json::Value;
use textwrap::{Options, fill};

use crate::contract::describe::Description;
use crate::contract::parameters::DEFAULT_KEYWORD;
use crate::contract::tagged::Tag;
use crate::contract::values::Reader;

/// Groups of parameters in their order of display; parameters without a group come first.
pub const PARAMETER_GROUPS: [&str; 7] =
    ["data", "sampling", "loss", "optimiser", "field", "network", "output"];
/// Schema keyword for a parameter's group.
const GROUP_KEYWORD: &str = "x-group";

/// Documentation of a parameter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParameterDoc {
    /// Name of the parameter.
    pub name: String,
    /// Group, one of [`PARAMETER_GROUPS`]; empty without a group.
    pub group: String,
    /// Description of the parameter.
    pub text: String,
    /// Allowed values, as text.
    pub allowed: String,
    /// Value if the parameter is omitted.
    pub default: String,
    /// Allowed values of a choice, each with its description.
    pub choices: Vec<(String, String)>,
}

/// Section of the documentation: parameters common to all variants of a stage, or those of one
/// variant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParameterSection {
    /// Variant that the parameters belong to, such as `field: grid`; `None` for common ones.
    pub variant: Option<String>,
    /// Parameters, sorted by group, then by name.
    pub parameters: Vec<ParameterDoc>,
}

impl Description {
    /// Documents the stage's parameters: the common ones, then those of each variant.
    pub fn parameter_sections(&self) -> Vec<ParameterSection> {
        let schema = &self.parameters;
        // A schema with an invalid tag gets one section; `Description::check` refuses it.
        let Some(tag) = Tag::find(schema).ok().flatten() else {
            return vec![ParameterSection {
                variant: None,
                parameters: document(schema, |_| true),
            }];
        };
        let common = &schema["properties"];
        let schemas = tag.variant_schemas(schema);
        let parameters = document(&schemas[0], |name| common.get(name).is_some());
        let mut sections = vec![ParameterSection { variant: None, parameters }];
        for (index, variant) in tag.variants().enumerate() {
            let parameters = document(&schemas[index], |name| common.get(name).is_none());
            let variant = Some(format!("{}: {variant}", tag.name()));
            sections.push(ParameterSection { variant, parameters });
        }
        sections
    }
}

/// Documents those of a schema's parameters whose names satisfy a condition.
fn document(schema: &Value, condition: impl Fn(&str) -> bool) -> Vec<ParameterDoc> {
    let mut found = Vec::new();
    for (name, property) in
        schema.get("properties").and_then(Value::as_object).into_iter().flatten()
    {
        if condition(name) {
            found.push(ParameterDoc::new(schema, name, property));
        }
    }
    found.sort_by(|a, b| (a.group_rank(), &a.name).cmp(&(b.group_rank(), &b.name)));
    found
}

impl ParameterDoc {
    fn new(schema: &Value, name: &str, property: &Value) -> Self {
        let reader = Reader::new(schema);
        let mut choices = Vec::new();
        for (value, description) in reader.choices(property).into_iter().flatten() {
            choices.push((plain(value), description.replace('\n', " ")));
        }
        let default = match (property.get("default"), keyword_text(property, DEFAULT_KEYWORD)) {
            (None | Some(Value::Null), "") => "none".to_owned(),
            (None | Some(Value::Null), description) => description.to_owned(),
            (Some(default), _) => plain(default),
        };
        Self {
            name: name.to_owned(),
            group: keyword_text(property, GROUP_KEYWORD).to_owned(),
            text: keyword_text(property, "description").replace('\n', " "),
            allowed: allowed_text(property, reader.present(property), &choices),
            default,
            choices,
        }
    }

    /// Returns the position of the group in the order of display.
    fn group_rank(&self) -> usize {
        PARAMETER_GROUPS.iter().position(|group| *group == self.group).map_or(0, |index| index + 1)
    }
}

/// Returns the text of a schema's keyword; empty without the keyword.
fn keyword_text<'a>(property: &'a Value, keyword: &str) -> &'a str {
    property.get(keyword).and_then(Value::as_str).unwrap_or_default()
}

/// Formats a value as text, without quotes.
pub fn plain(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// Describes the values that a parameter may have.
fn allowed_text(property: &Value, present: &Value, choices: &[(String, String)]) -> String {
    if !choices.is_empty() {
        return choices.iter().map(|(value, _)| value.as_str()).collect::<Vec<_>>().join(", ");
    }
    if let Some(Value::Array(values)) = property.get("enum") {
        return values.iter().map(plain).collect::<Vec<_>>().join(", ");
    }
    let types: Vec<&str> = match present.get("type") {
        Some(Value::String(one)) => vec![one],
        Some(Value::Array(several)) => {
            several.iter().filter_map(Value::as_str).filter(|one| *one != "null").collect()
        }
        _ => Vec::new(),
    };
    let noun = match types[..] {
        ["boolean"] => return "true, false".to_owned(),
        ["integer"] => "a whole number",
        ["number"] => "a number",
        ["string"] => "text",
        ["array"] => "a list",
        _ => "JSON",
    };
    let [min, max] = ["minimum", "maximum"]
        .map(|keyword| property.get(keyword).or_else(|| present.get(keyword)).map(short_number));
    match (min, max) {
        (Some(min), Some(max)) => format!("{noun} from {min} to {max}"),
        (Some(min), None) => format!("{noun} from {min}"),
        (None, Some(max)) => format!("{noun} up to {max}"),
        (None, None) => noun.to_owned(),
    }
}

/// Formats a number without a redundant `.0`.
fn short_number(value: &Value) -> String {
    value.to_string().trim_end_matches(".0").to_owned()
}

/// Splits sorted parameters into groups: each group's name with its parameters.
pub fn group_parameters(parameters: &[ParameterDoc]) -> Vec<(&str, Vec<&ParameterDoc>)> {
    let mut groups: Vec<(&str, Vec<&ParameterDoc>)> = Vec::new();
    for parameter in parameters {
        match groups.last_mut() {
            Some((group, members)) if *group == parameter.group => members.push(parameter),
            _ => groups.push((&parameter.group, vec![parameter])),
        }
    }
    groups
}

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
    use crate::contract::describe::{Input, Output};
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
