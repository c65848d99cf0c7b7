use std::process::ExitCode;

use artifact::{Failure, print_line};
use planning::{PlanError, Request, State};

use crate::session::{Session, of_stage};

/// Prints the folder of a stage's artifact, or a folder or file inside it; a line for each point of
/// a sweep.
pub(crate) fn path(session: &Session, wanted: &str, what: &Request) -> anyhow::Result<ExitCode> {
    let (stage, inside) =
        wanted.split_once('/').map_or((wanted, None), |(stage, inside)| (stage, Some(inside)));
    let targets =
        if what.targets.is_empty() { vec![stage.to_owned()] } else { what.targets.clone() };
    let plan = session.plan(&Request { targets, ..what.clone() })?;
    let states = session.states(&plan)?;
    for index in of_stage(&plan, stage)? {
        let State::Cached(record) = &states[index] else {
            return Err(Failure::BadInput(format!(
                "{} isn't made yet; run it first",
                plan.nodes[index].label()
            ))
            .into());
        };
        let folder = session.store.object(&record.output);
        let path = inside.map_or_else(|| folder.clone(), |inside| folder.join(inside));
        if !path.exists() {
            let manifest = session.store.manifest(&record.output)?;
            let known =
                manifest.files.iter().map(|file| file.path.split('/').next().unwrap_or_default());
            let known = artifact::known_names(
                inside.unwrap_or_default(),
                known.collect::<std::collections::BTreeSet<_>>(),
            );
            return Err(PlanError::Usage(format!(
                "{wanted}: {stage} has no such folder or file; {known}"
            ))
            .into());
        }
        print_line!("{}", path.display());
    }
    Ok(ExitCode::SUCCESS)
}
