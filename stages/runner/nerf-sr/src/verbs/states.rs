//! `plan`, `why` and `status` print the states of a plan's nodes.

use artifact::{format_count, format_duration, format_size, label, print_line};
use planning::{Request, short_hash};
use store::Record;

use super::print_json;
use crate::estimates::Datasets;
use crate::planned::{ArtifactReport, PlanReport, Planned, age_text};
use crate::session::{Session, nodes_of_stage};

/// Prints what `run` would do.
pub(crate) fn plan(session: &Session, request: &Request, json: bool) -> anyhow::Result<()> {
    let planned = session.plan_with_states(request)?;
    if json {
        return print_json(&PlanReport::new(&planned, &[])?);
    }
    let estimates = planned.estimates(&mut Datasets::default());
    for (index, node) in planned.plan.nodes.iter().enumerate() {
        let mut text = planned.state_text(index, None);
        if let Some(estimate) = estimates.nodes.get(&index) {
            text += &format!("; about {}", estimate.text());
        }
        print_line!("{:<40} {text}", node.label());
        if let Some(line) = planned.by_scene_text(index) {
            print_line!("    {line}");
        }
    }
    for sink in &planned.plan.sinks {
        print_line!("{:<40} {}", sink.stage, planned.sink_text(sink));
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
    let planned = session.plan_with_states(request)?;
    let records = session.store.records()?;
    if json {
        return print_json(&PlanReport::new(&planned, &records)?.for_stage(stage));
    }
    if let Some(sink) = planned.plan.sinks.iter().find(|sink| sink.stage == stage) {
        print_line!("{stage}: {}", planned.sink_text(sink));
        for index in sink.nodes() {
            print_line!("  {}", explanation(&planned, index, &records));
        }
        return Ok(());
    }
    for index in nodes_of_stage(&planned.plan, stage)? {
        print_line!("{}", explanation(&planned, index, &records));
        if let Some(line) = planned.by_scene_text(index) {
            print_line!("    {line}");
        }
        for cause in planned.blocking_nodes(index) {
            print_line!("  {}", explanation(&planned, cause, &records));
        }
    }
    Ok(())
}

/// Returns a node's label, its state and the reason.
fn explanation(planned: &Planned<'_>, index: usize, records: &[Record]) -> String {
    let text = planned.state_text(index, Some(records));
    format!("{}: {text}", planned.plan.nodes[index].label())
}

/// Prints every stage with its artifact, age and running time.
pub(crate) fn status(session: &Session, request: &Request, json: bool) -> anyhow::Result<()> {
    let planned = session.plan_with_states(request)?;
    let (jobs, other_jobs) = session.jobs(&planned.plan);
    let mut report = PlanReport::new(&planned, &[])?;
    for (index, job) in jobs {
        report.nodes[index].job = Some(job);
    }
    if json {
        return print_json(&report);
    }
    for node in &report.nodes {
        let mut details: Vec<String> = node.job.iter().map(ToString::to_string).collect();
        details.extend(node.artifact.as_ref().map(artifact_text));
        if node.has_checkpoint {
            details.push("has a checkpoint to resume from".to_owned());
        }
        let label = label(&node.stage, &node.point);
        print_line!("{label:<40} {:<9} {}", node.state, details.join("; "));
    }
    if other_jobs > 0 {
        let jobs = format_count(other_jobs, "job");
        print_line!("also queued: {jobs}, for pages or for runs with other arguments");
    }
    Ok(())
}

/// Returns hash, size, running time and age of an artifact.
fn artifact_text(artifact: &ArtifactReport) -> String {
    format!(
        "{}  {:>9}  {:>9}  {}",
        short_hash(&artifact.output),
        format_size(artifact.bytes),
        format_duration(artifact.seconds),
        age_text(artifact.started_unix)
    )
}
