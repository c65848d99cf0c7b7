use std::collections::BTreeSet;

use artifact::{bail_bad_input, print_line};
use planning::{Change, PlanError, Request, State};

use super::print_json;
use crate::cli::plan_request;
use crate::lineage::{Lineage, StageDifference};
use crate::session::{Session, nodes_of_stage};

/// Maximum number of files of a stage that are listed; more are counted. Chosen by hand.
const MAX_LISTED_FILES: usize = 4;
/// Minimum length of a hash's prefix in characters; chosen by hand.
const MIN_HASH_CHARS: usize = 6;

/// Prints the differences between two results and the actions that they depend on.
pub(crate) fn diff(session: &Session, before: &str, now: &str, json: bool) -> anyhow::Result<()> {
    let (before, now) = (read_side(session, before)?, read_side(session, now)?);
    let differences = now.differences(&before, &session.store)?;
    if json {
        return print_json(&differences);
    }
    for line in differences.iter().flat_map(lines) {
        print_line!("{line}");
    }
    if differences.is_empty() {
        print_line!("no differences");
    }
    Ok(())
}

/// Returns one line per difference of a stage; many files share one line.
fn lines(difference: &StageDifference) -> Vec<String> {
    let stage = &difference.stage;
    let (files, mut listed): (Vec<&Change>, Vec<&Change>) =
        difference.changes.iter().partition(|change| change.name.starts_with("file "));
    let summary = (files.len() > MAX_LISTED_FILES).then(|| {
        let first = files[0].name.strip_prefix("file ").unwrap_or_default();
        format!("{stage}: {} files differ, such as {first}", files.len())
    });
    if summary.is_none() {
        listed.extend(files);
    }
    listed.iter().map(|change| format!("{stage}: {change}")).chain(summary).collect()
}

/// Reads one side of the comparison: a recorded run or pin, the beginning of an artifact's hash or
/// of a key, or a stage with its arguments.
fn read_side(session: &Session, text: &str) -> anyhow::Result<Lineage> {
    let store = &session.store;
    if let Some(run) = store.run_or_pin(text)? {
        return Lineage::read(store, run.keys);
    }
    if text.len() >= MIN_HASH_CHARS && text.bytes().all(|b| b.is_ascii_hexdigit()) {
        let mut records = store.records()?;
        records.retain(|r| r.output.starts_with(text) || r.key().starts_with(text));
        if let Some(record) = records.first() {
            if records.iter().any(|other| other.output != record.output) {
                return Err(usage(
                    text,
                    "several artifacts' hashes begin with this; give more characters",
                ));
            }
            return Lineage::read(store, BTreeSet::from([record.key()]));
        }
    }
    read_stage(session, text)
}

/// Reads the result of a stage with the arguments that follow its name: targets and options of the
/// plan.
fn read_stage(session: &Session, text: &str) -> anyhow::Result<Lineage> {
    let (stage, request) = stage_request(text)?;
    let planned = session.plan_with_states(&request)?;
    let nodes = nodes_of_stage(&planned.plan, &stage)?;
    let &[index] = nodes.as_slice() else {
        return Err(usage(text, "a sweep has several results; give one value for each parameter"));
    };
    let State::Cached(record) = &planned.states[index] else {
        bail_bad_input!("{text} has no artifact yet; run it first");
    };
    Lineage::read(&session.store, BTreeSet::from([record.key()]))
}

/// Parses a stage with the arguments of a plan; words are split as by a POSIX shell.
fn stage_request(text: &str) -> anyhow::Result<(String, Request)> {
    let words = shlex::split(text).ok_or_else(|| usage(text, "close the quote"))?;
    let mut words = words.into_iter();
    let Some(stage) = words.next() else {
        return Err(usage(text, "expected a stage, an artifact's hash, a run or a pin"));
    };
    let mut request = plan_request(words).map_err(|problem| {
        let remedy = "quote each result, such as \"eval -p kernel=box\"";
        usage(text, &format!("{problem}; {remedy}"))
    })?;
    if request.targets.is_empty() {
        request.targets.push(stage.clone());
    }
    Ok((stage, request))
}

fn usage(text: &str, problem: &str) -> anyhow::Error {
    PlanError::Usage(format!("{text:?}: {problem}")).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_split_as_by_a_shell() {
        let (stage, request) =
            stage_request(r"eval -p kernel=box  -i 'dataset=my scenes' -i a=\ b").unwrap();
        assert_eq!((stage.as_str(), request.parameters), ("eval", vec!["kernel=box".to_owned()]));
        assert_eq!(request.inputs, ["dataset=my scenes", "a= b"]);
        for (text, expected) in [
            ("", "expected a stage"),
            ("eval -i 'a=b", "close the quote"),
            ("eval -p", "a value is required for '--param"),
        ] {
            let message = stage_request(text).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }
}
