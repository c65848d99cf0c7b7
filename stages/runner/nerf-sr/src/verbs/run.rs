use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

use artifact::report_line;
use planning::stage_call::stop_on_signals;
use planning::{Describing, Plan, Request, State, stored_inputs};
use store::{RunFile, Store};

use crate::session::{Run, Session, check_not_in_input, command_line};
use crate::waiting::enter_store;

/// Runs the stages that the targets need, then the sinks, by `carry_out`.
pub(crate) fn run(
    session: &Session,
    request: &Request,
    out: &Path,
    carry_out: impl FnOnce(&Run<'_>) -> anyhow::Result<ExitCode>,
) -> anyhow::Result<ExitCode> {
    let stop = stop_on_signals()?;
    let plan = session.new_plan(request, Describing::OwnAndNeeded(&stop))?;
    check_not_in_input(&plan, "the folder of pages", out)?;
    plan.check_folders()?;
    let (file, states) = begin_run(&session.store, &plan, &stop)?;
    let store = &session.store;
    let run = Run { plan: &plan, states: &states, store, file: &file, out, stop: &stop };
    let result = carry_out(&run);
    // If the end can't be recorded, as on a full disk, the run's age is counted from its start.
    file.end().ok();
    result
}

/// Creates the run's file and writes the actions that the run needs, as far as known. Returns the
/// file and the states of the nodes; no states if an input can't be read.
pub(super) fn begin_run(
    store: &Store,
    plan: &Plan,
    stop: &AtomicBool,
) -> anyhow::Result<(RunFile, Vec<State>)> {
    let entered = enter_store(store, stop, &|text| report_line!("nerf-sr: {text}"))?;
    let file = store.begin_run(&entered, command_line())?;
    // An unreadable input folder is reported when its stage is due: other stages may not need it.
    let states = plan.states(store, Some(stop)).unwrap_or_default();
    for (index, node) in plan.nodes.iter().enumerate() {
        match states.get(index).and_then(State::key) {
            Some(key) => file.record_action(&entered, &node.stage, &key),
            None => file.record_waiting(&entered, node.partial_key()),
        }?;
    }
    for record in stored_inputs(&plan.nodes, store)? {
        file.record_action(&entered, &record.stage, &record.key())?;
    }
    Ok((file, states))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs;

    use planning::Pipeline;
    use serde_json::json;
    use store::{Record, Unfinished};

    use super::*;
    use crate::waiting::try_enter_store;

    /// Creates an artifact in a store.
    fn artifact(store: &Store) -> Record {
        let entered = try_enter_store(store).unwrap();
        let attempt = store.begin(&entered, &Unfinished::default(), &json!({})).unwrap();
        fs::create_dir(&attempt.output).unwrap();
        fs::write(attempt.output.join("x"), "1").unwrap();
        let checked = store.check(attempt, "x").unwrap();
        store.publish(&entered, checked, Record::default()).unwrap()
    }

    #[test]
    fn a_run_needs_the_artifacts_that_it_reads_as_folders() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let record = artifact(&store);
        let folder = store.object(&record.output);
        let text = format!(
            "default: [make]\nstages: {{make: {{inputs: {{data: {}}}}}}}",
            folder.display()
        );
        let pipeline = Pipeline::parse(text.as_bytes(), Path::new("pipeline.yaml")).unwrap();
        let description = serde_json::from_value(json!({"name": "make", "version": "",
            "code": "", "summary": "", "parameters": {}, "output": {"kind": "x"},
            "inputs": {"data": {"kinds": ["x"], "summary": ""}}}));
        let descriptions = BTreeMap::from([("make".to_owned(), description.unwrap())]);
        let request = Request { targets: vec!["make".to_owned()], ..Request::default() };
        let plan = Plan::from_descriptions(&pipeline, &descriptions, &request).unwrap();
        let (file, _) = begin_run(&store, &plan, &AtomicBool::new(false)).unwrap();
        let run = store.run_or_pin(file.id()).unwrap().unwrap();
        assert!(run.keys.contains(&record.key()) && run.keys.len() == 2);
    }
}
