//! `plan`, `why` and `status` print the states of a plan's nodes.

use artifact::{format_count, format_duration, format_size, hash_json, print_line};
use planning::{Request, State, short_hash};
use store::Record;

use super::print_json;
use crate::estimates::Estimates;
use crate::node_report::PlanReport;
use crate::session::{Session, nodes_of_stage};
use crate::state_text::{age_text, blocking_nodes, by_scene_text, sink_text, state_text};

/// Prints what `run` would do.
pub(crate) fn plan(session: &Session, request: &Request, json: bool) -> anyhow::Result<()> {
    let (plan, states) = session.plan_with_states(request)?;
    if json {
        return print_json(&PlanReport::new(session, &plan, &states, &[])?);
    }
    let estimates = Estimates::new(&plan, &states, &session.store);
    for (index, state) in states.iter().enumerate() {
        let node = &plan.nodes[index];
        let mut text = state_text(session, &plan, &states, index, None);
        if let Some(estimate) = estimates.get(index) {
            text += &format!("; about {}", estimate.text());
        }
        print_line!("{:<40} {text}", node.label());
        if let Some(line) = by_scene_text(session, node, state) {
            print_line!("    {line}");
        }
    }
    for sink in &plan.sinks {
        print_line!("{:<40} {}", sink.stage, sink_text(&plan, sink, &states));
    }
    if let Some(text) = estimates.total_text(stage::processors().count) {
        print_line!("{text}");
    }
    Ok(())
}

/// Explains why a stage is cached, would run, or waits. For a sink, explains the stages that it
/// shows.
pub(crate) fn why(
    session: &Session,
    stage: &str,
    request: &Request,
    json: bool,
) -> anyhow::Result<()> {
    let (plan, states) = session.plan_with_states(request)?;
    let records = session.store.records()?;
    if json {
        let report = PlanReport::new(session, &plan, &states, &records)?;
        return print_json(&report.for_stage(stage));
    }
    let explanation = |index: usize| {
        let text = state_text(session, &plan, &states, index, Some(&records));
        format!("{}: {text}", plan.nodes[index].label())
    };
    if let Some(sink) = plan.sinks.iter().find(|sink| sink.stage == stage) {
        print_line!("{stage}: {}", sink_text(&plan, sink, &states));
        for index in sink.nodes() {
            print_line!("  {}", explanation(index));
        }
        return Ok(());
    }
    for index in nodes_of_stage(&plan, stage)? {
        print_line!("{}", explanation(index));
        if let Some(line) = by_scene_text(session, &plan.nodes[index], &states[index]) {
            print_line!("    {line}");
        }
        for cause in blocking_nodes(&states, index) {
            print_line!("  {}", explanation(cause));
        }
    }
    Ok(())
}

/// Prints every stage with its artifact, age and running time.
pub(crate) fn status(session: &Session, request: &Request, json: bool) -> anyhow::Result<()> {
    let (plan, states) = session.plan_with_states(request)?;
    let (jobs, other_jobs) = session.jobs(&plan);
    if json {
        let mut report = PlanReport::new(session, &plan, &states, &[])?;
        for (index, job) in jobs {
            report.nodes[index].job = Some(job);
        }
        return print_json(&report);
    }
    for (index, state) in states.iter().enumerate() {
        let mut details: Vec<String> =
            jobs.get(&index).map(ToString::to_string).into_iter().collect();
        match state {
            State::Cached(record) => details.push(cached_detail(session, record)),
            State::WillRun { key_parts }
                if session.store.has_checkpoint(&hash_json(key_parts))? =>
            {
                details.push("has a checkpoint to resume from".to_owned());
            }
            _ => {}
        }
        let label = plan.nodes[index].label();
        print_line!("{label:<40} {:<9} {}", state.name(), details.join("; "));
    }
    if other_jobs > 0 {
        let jobs = format_count(other_jobs, "job");
        print_line!("also queued: {jobs}, for pages or for runs with other arguments");
    }
    Ok(())
}

/// Returns hash, size, running time and age of a cached artifact.
fn cached_detail(session: &Session, record: &Record) -> String {
    let size = session.store.manifest(&record.output).map_or(0, |manifest| manifest.size());
    format!(
        "{}  {:>9}  {:>9}  {}",
        short_hash(&record.output),
        format_size(size),
        format_duration(record.seconds),
        age_text(record.started_unix)
    )
}
