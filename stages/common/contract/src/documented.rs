//! A stage's parameters as people read them: in groups, each with what it allows and its default.

use serde_json::Value;

use crate::describe::Description;
use crate::parameters::DEFAULT_KEYWORD;
use crate::tagged::Tag;
use crate::values::Reader;

/// Groups of parameters, in the order in which they are shown; a parameter without a group stands
/// before all.
pub const GROUPS: [&str; 7] =
    ["data", "sampling", "loss", "optimiser", "field", "network", "output"];
/// Keyword of a parameter's schema: its group.
const GROUP_KEYWORD: &str = "x-group";

/// A parameter as people read it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParameterText {
    /// Its name.
    pub name: String,
    /// Its group, one of [`GROUPS`], or nothing.
    pub group: String,
    /// Its meaning.
    pub text: String,
    /// The values it may have, in words.
    pub allowed: String,
    /// The value it has when it is left out.
    pub default: String,
    /// The words it may be, each with its meaning.
    pub choices: Vec<(String, String)>,
}

/// Parameters that stand together: all of a stage, or those that a variant has besides.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParameterSection {
    /// The choice that they belong to, such as `field: grid`; nothing for those that are always
    /// there.
    pub variant: Option<String>,
    /// The parameters, by group, then by name.
    pub parameters: Vec<ParameterText>,
}

impl Description {
    /// The stage's parameters as people read them.
    pub fn documented(&self) -> Vec<ParameterSection> {
        let schema = &self.parameters;
        // A description is checked before it is used: two tags are an error there.
        let Some(tag) = Tag::find(schema).ok().flatten() else {
            return vec![ParameterSection::new(None, schema, &|_| true)];
        };
        let forms = tag.forms(schema);
        let is_common = |name: &str| schema["properties"].get(name).is_some();
        let mut sections = vec![ParameterSection::new(None, &forms[0], &is_common)];
        for (variant, form) in tag.variants().zip(&forms) {
            let choice = format!("{}: {variant}", tag.name());
            sections.push(ParameterSection::new(Some(choice), form, &|name| !is_common(name)));
        }
        sections
    }
}

impl ParameterSection {
    /// Those of a schema's parameters whose names are wanted.
    fn new(variant: Option<String>, schema: &Value, is_wanted: &dyn Fn(&str) -> bool) -> Self {
        Self { variant, parameters: parameters(schema, is_wanted) }
    }
}

fn parameters(schema: &Value, is_wanted: &dyn Fn(&str) -> bool) -> Vec<ParameterText> {
    let properties = schema.get("properties").and_then(Value::as_object).into_iter().flatten();
    let wanted = properties.filter(|(name, _)| is_wanted(name));
    let mut found: Vec<ParameterText> =
        wanted.map(|(name, property)| parameter(schema, name, property)).collect();
    found.sort_by(|a, b| (place(a), &a.name).cmp(&(place(b), &b.name)));
    found
}

/// Where a parameter's group stands among all groups.
fn place(text: &ParameterText) -> usize {
    GROUPS.iter().position(|group| *group == text.group).map_or(0, |at| at + 1)
}

fn parameter(schema: &Value, name: &str, property: &Value) -> ParameterText {
    let text_of = |keyword: &str| property.get(keyword).and_then(Value::as_str).unwrap_or_default();
    let reader = Reader::new(schema);
    let choices: Vec<(String, String)> =
        reader.choices(property).into_iter().flatten().map(choice).collect();
    let default = match property.get("default") {
        None | Some(Value::Null) if !text_of(DEFAULT_KEYWORD).is_empty() => {
            text_of(DEFAULT_KEYWORD).to_owned()
        }
        None | Some(Value::Null) => "none".to_owned(),
        Some(default) => plain(default),
    };
    ParameterText {
        name: name.to_owned(),
        group: text_of(GROUP_KEYWORD).to_owned(),
        text: text_of("description").replace('\n', " "),
        allowed: allowed(property, reader.present(property), &choices),
        default,
        choices,
    }
}

fn choice((word, meaning): (&Value, &str)) -> (String, String) {
    (plain(word), meaning.replace('\n', " "))
}

/// A value as text, without quotes.
pub fn plain(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// The values that a parameter may have, in words.
fn allowed(property: &Value, present: &Value, choices: &[(String, String)]) -> String {
    if !choices.is_empty() {
        return choices.iter().map(|(word, _)| word.as_str()).collect::<Vec<_>>().join(", ");
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
    let bound =
        |keyword: &str| property.get(keyword).or_else(|| present.get(keyword)).map(short_number);
    match (bound("minimum"), bound("maximum")) {
        (Some(least), Some(most)) => format!("{noun} from {least} to {most}"),
        (Some(least), None) => format!("{noun} from {least}"),
        (None, Some(most)) => format!("{noun} up to {most}"),
        (None, None) => noun.to_owned(),
    }
}

/// A number without the point that it doesn't need.
fn short_number(value: &Value) -> String {
    value.to_string().trim_end_matches(".0").to_owned()
}

/// Parameters by group: the groups' names in order, each with its parameters.
pub fn by_group(parameters: &[ParameterText]) -> Vec<(&str, Vec<&ParameterText>)> {
    let mut groups: Vec<(&str, Vec<&ParameterText>)> = Vec::new();
    for parameter in parameters {
        match groups.last_mut() {
            Some((group, members)) if *group == parameter.group => members.push(parameter),
            _ => groups.push((&parameter.group, vec![parameter])),
        }
    }
    groups
}
