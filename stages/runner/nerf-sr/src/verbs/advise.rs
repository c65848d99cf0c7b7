//! `advise` estimates the time of each quality.

use std::process::ExitCode;

use artifact::{format_count, format_duration, print_line};
use planning::{Quality, Request, State};

use crate::estimates::Estimates;
use crate::run_messages::command_text;
use crate::session::Session;
use crate::state_text::processors_text;

/// Processor time of a plan's stages.
struct Cost {
    quality: Quality,
    /// Processor seconds of all stages with an estimate.
    seconds: f64,
    /// Number of stages that would run without an estimate.
    unknown: usize,
}

/// Prints what the scenes are, what each quality costs, and the command of the best quality within
/// `minutes`; without `minutes`, of the default. `arguments` are those of the plan.
pub(crate) fn advise(
    session: &Session,
    request: &Request,
    minutes: Option<f64>,
    arguments: &[String],
) -> anyhow::Result<ExitCode> {
    let processors = stage::processors().count;
    let mut costs = Vec::new();
    for quality in Quality::ALL {
        costs.push(cost(session, request, quality)?);
    }
    print_line!("{:<10} {:>14}   on {}", "quality", "processor time", processors_text(processors));
    for cost in &costs {
        print_line!(
            "{:<10} {:>14}   {}",
            cost.quality.name(),
            format_duration(cost.seconds),
            format_duration(cost.seconds / processors as f64)
        );
    }
    let unknown = costs[0].unknown;
    if unknown > 0 {
        print_line!("without {}, whose time isn't known", format_count(unknown, "stage"));
    }
    let chosen = match minutes {
        None => Quality::default(),
        Some(minutes) => {
            let fits = |cost: &&Cost| cost.seconds / processors as f64 <= 60.0 * minutes;
            match costs.iter().rfind(fits) {
                Some(cost) => cost.quality,
                None => {
                    print_line!("no quality fits into {minutes} minutes; the fastest is draft");
                    Quality::Draft
                }
            }
        }
    };
    let mut words = vec!["run".to_owned()];
    words.extend(arguments.iter().cloned());
    words.extend(["-p".to_owned(), format!("quality={}", chosen.name())]);
    print_line!("{}", command_text(&words));
    Ok(ExitCode::SUCCESS)
}

/// Returns the cost of the stages that would run with a quality. Prints the scenes with the first
/// quality.
fn cost(session: &Session, request: &Request, quality: Quality) -> anyhow::Result<Cost> {
    let mut request = request.clone();
    request.parameters.push(format!("quality={}", quality.name()));
    let (plan, states) = session.plan_with_states(&request)?;
    let estimates = Estimates::new(&plan, &states, session.store.records()?, &session.store);
    if quality == Quality::ALL[0] {
        for scene in estimates.scenes() {
            print_line!("{}", scene.summary());
        }
    }
    let mut cost = Cost { quality, seconds: 0.0, unknown: 0 };
    for (index, state) in states.iter().enumerate() {
        if matches!(state, State::Cached(_)) {
            continue;
        }
        match estimates.processor_seconds(index) {
            Some(seconds) => cost.seconds += seconds,
            None => cost.unknown += 1,
        }
    }
    Ok(cost)
}
