use std::process::ExitCode;

use artifact::{hash_json, print_line, sized};

use crate::execute::seconds;
use crate::graph::state_word;
use crate::plan::{Request, State};
use crate::session::Session;
use crate::words::age;

/// Shows every stage with its artifact, age and time.
pub(crate) fn status(session: &Session, what: &Request) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let mut jobs = session.jobs(&plan).into_iter();
    for (node, state) in plan.nodes.iter().zip(session.states(&plan)?) {
        let job = jobs.next().flatten().map(|job| job.words());
        let detail = match &state {
            State::Cached(record) => {
                let size = session.store.manifest(&record.output).map_or(0, |m| m.size());
                format!("{}  {:>9}  {:>9}  {}", &record.output[..10], sized(size), seconds(record.seconds), age(record))
            }
            State::WillRun { key_parts } if session.store.partial(&hash_json(key_parts)).join("work").exists() => {
                "has a checkpoint to go on from".to_owned()
            }
            _ => String::new(),
        };
        let detail = job.into_iter().chain((!detail.is_empty()).then_some(detail)).collect::<Vec<_>>().join("; ");
        print_line!("{:<40} {:<9} {detail}", node.label(), state_word(&state));
    }
    Ok(ExitCode::SUCCESS)
}
