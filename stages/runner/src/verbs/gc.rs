use std::collections::BTreeSet;
use std::process::ExitCode;

use artifact::{hash_json, print_line};

use crate::plan::{Request, State};
use crate::session::Session;

/// Removes what nothing needs any more.
pub(crate) fn gc(session: &Session, what: &Request, dry_run: bool, keep_days: u64) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let states = session.states(&plan)?;
    let keys: BTreeSet<String> = states
        .iter()
        .filter_map(|state| match state {
            State::Cached(record) => Some(record.key()),
            State::WillRun { key_parts } => Some(hash_json(key_parts)),
            State::Waits { .. } => None,
        })
        .collect();
    let garbage = crate::gc::find(&session.store, &keys, keep_days)?;
    garbage.lines.iter().for_each(|line| print_line!("{line}"));
    if !dry_run {
        garbage.remove(&session.store)?;
    }
    print_line!("{:.1} MB {}", garbage.bytes as f64 / 1e6, if dry_run { "would go" } else { "freed" });
    Ok(ExitCode::SUCCESS)
}
