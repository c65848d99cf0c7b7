use std::process::ExitCode;

use artifact::{Failure, print_line};
use planning::{Change, PlanError, Request, State};

use super::print::print_json;
use crate::lineage::{Lineage, StageDifference};
use crate::session::{Session, of_stage};

/// More files than these are counted, not listed.
const MOST_FILES: usize = 4;
/// The fewest letters by which a hash is known.
const LEAST_HASH_LETTERS: usize = 6;

/// Tells what differs between two results and all that they were made of.
pub(crate) fn diff(
    session: &Session,
    before: &str,
    now: &str,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let (before, now) = (side(session, before)?, side(session, now)?);
    let differences = now.differences(&before, &session.store)?;
    if json {
        return print_json(&differences);
    }
    differences.iter().flat_map(lines).for_each(|line| print_line!("{line}"));
    if differences.is_empty() {
        print_line!("nothing differs");
    }
    Ok(ExitCode::SUCCESS)
}

/// A stage's differences, a line each; many files have one line together.
fn lines(difference: &StageDifference) -> Vec<String> {
    let (files, others): (Vec<&Change>, Vec<&Change>) =
        difference.changes.iter().partition(|change| change.name.starts_with("file "));
    let mut lines: Vec<String> =
        others.iter().map(|change| format!("{}: {change}", difference.stage)).collect();
    if files.len() > MOST_FILES {
        let first = files[0].name.trim_start_matches("file ");
        lines.push(format!("{}: {} files differ, such as {first}", difference.stage, files.len()));
    } else {
        lines.extend(files.iter().map(|change| format!("{}: {change}", difference.stage)));
    }
    lines
}

/// A side of the comparison: a recorded run or pin, the beginning of an artifact's hash or of a
/// key, or a stage with `-p` and `-i`.
fn side(session: &Session, text: &str) -> anyhow::Result<Lineage> {
    let store = &session.store;
    if let Some(run) = store.run_or_pin(text)? {
        return Lineage::of(store, run.keys);
    }
    let is_hash = text.len() >= LEAST_HASH_LETTERS && text.bytes().all(|b| b.is_ascii_hexdigit());
    if is_hash {
        let records = store.records()?;
        let mut found = records
            .iter()
            .filter(|record| record.output.starts_with(text) || record.key().starts_with(text));
        if let Some(record) = found.next() {
            if found.any(|other| other.output != record.output) {
                return Err(PlanError::Usage(format!(
                    "{text}: more than one artifact begins so; give more of it"
                ))
                .into());
            }
            return Lineage::of(store, [record.key()]);
        }
    }
    stage(session, text)
}

/// The result of a stage with the parameters and inputs that follow it.
fn stage(session: &Session, text: &str) -> anyhow::Result<Lineage> {
    let usage = |problem: String| PlanError::Usage(format!("{text:?}: {problem}"));
    let mut words = text.split_whitespace().map(str::to_owned);
    let stage = words
        .next()
        .ok_or_else(|| usage("expected a stage, an artifact's hash, or a run".to_owned()))?;
    let mut what = Request { targets: vec![stage.clone()], ..Request::default() };
    while let Some(word) = words.next() {
        let list = match word.as_str() {
            "-p" => &mut what.parameters,
            "-i" => &mut what.inputs,
            _ => {
                return Err(usage(format!(
                    "{word} is neither -p nor -i; quote each side as one word of the shell"
                ))
                .into());
            }
        };
        list.push(words.next().ok_or_else(|| usage(format!("{word} needs NAME=VALUE")))?);
    }
    let plan = session.plan(&what)?;
    let states = session.states(&plan)?;
    match of_stage(&plan, &stage)?[..] {
        [index] => match &states[index] {
            State::Cached(record) => Lineage::of(&session.store, [record.key()]),
            _ => Err(Failure::BadInput(format!("{text} isn't made yet; run it first")).into()),
        },
        _ => {
            Err(usage("a sweep has several results; give one value for each parameter".to_owned())
                .into())
        }
    }
}
