use std::process::ExitCode;

use artifact::{hash_json, print_line, print_lines, sized};

use crate::execute::seconds;
use crate::node_report::PlanReport;
use crate::plan::{Request, State};
use crate::session::Session;
use crate::words::age;

/// Shows every stage with its artifact, age and time.
pub(crate) fn status(session: &Session, what: &Request, json: bool) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let states = session.states(&plan)?;
    if json {
        print_lines(&serde_json::to_string_pretty(&PlanReport::new(session, &plan, &states, &[]))?);
        return Ok(ExitCode::SUCCESS);
    }
    for (node, state) in plan.nodes.iter().zip(states) {
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
        print_line!("{:<40} {:<9} {detail}", node.label(), state.word());
    }
    Ok(ExitCode::SUCCESS)
}
