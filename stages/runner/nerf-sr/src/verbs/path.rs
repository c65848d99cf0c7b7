use std::collections::BTreeSet;

use artifact::{FailureExt as _, bail_bad_input, bail_usage, print_line, relative_path};
use planning::{Request, State};

use crate::session::{Session, nodes_of_stage};

/// Prints the path of a stage's artifact, or of a folder or file in it, one line per point of a
/// sweep.
pub(crate) fn path(session: &Session, stage_path: &str, request: &Request) -> anyhow::Result<()> {
    let (stage, inner) = stage_path
        .split_once('/')
        .map_or((stage_path, None), |(stage, inner)| (stage, Some(inner)));
    if let Some(inner) = inner.filter(|inner| !inner.is_empty()) {
        relative_path(inner).usage(stage_path)?;
    }
    let mut request = request.clone();
    if request.targets.is_empty() {
        request.targets.push(stage.to_owned());
    }
    let planned = session.plan_with_states(&request)?;
    for index in nodes_of_stage(&planned.plan, stage)? {
        let State::Cached(record) = &planned.states[index] else {
            let label = planned.plan.nodes[index].label();
            bail_bad_input!("{label} has no artifact yet; run it first");
        };
        let mut path = session.store.object(&record.output);
        path.extend(inner);
        if !path.exists() {
            let manifest = session.store.manifest(&record.output)?;
            let known: BTreeSet<&str> = manifest
                .files
                .iter()
                .map(|file| file.path.split('/').next().unwrap_or_default())
                .collect();
            let known = artifact::known_names(inner.unwrap_or_default(), known);
            bail_usage!("{stage_path}: {stage} has no such folder or file; {known}");
        }
        print_line!("{}", path.display());
    }
    Ok(())
}
