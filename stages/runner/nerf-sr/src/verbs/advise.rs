//! `advise` estimates time and memory of each quality.

use artifact::{format_count, format_duration, format_size, print_line};
use planning::{Plan, Quality, Request};
use slurm::Memory;

use crate::estimates::{Datasets, Estimate};
use crate::run_messages::command_text;
use crate::session::Session;

/// Target that refines views, in a project's pipelines/.
const REFINING_TARGET: &str = "refined";

// Limits within which a quality is chosen. Doc comments are the options' help.
#[derive(Clone, Copy, Debug, clap::Args)]
pub(crate) struct Limits {
    /// Time that the run may take; the best quality within it is chosen [without a limit:
    /// balanced]
    #[arg(long, value_name = "N")]
    minutes: Option<f64>,
    /// Memory limit of the run, such as 8G; the best quality whose largest stage fits is chosen
    #[arg(long, value_name = "AMOUNT")]
    memory: Option<Memory>,
}

/// Processor time and memory of some stages.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Cost {
    /// Processor seconds of all stages.
    seconds: f64,
    /// Largest memory of a stage in bytes.
    memory: u64,
}

/// Costs of a quality.
#[derive(Debug)]
struct QualityCosts {
    quality: Quality,
    /// Costs by column of [`COLUMNS`].
    parts: [Cost; COLUMNS.len()],
    /// Cost of all stages of the plan that have an estimate, including those in no column.
    total: Cost,
    /// Memory below which a stage of the plan fails.
    min_memory: u64,
    /// Number of stages that would run and have no estimate.
    unknown: usize,
    /// True if the total excludes refining, because the plan doesn't refine.
    excludes_refining: bool,
}

/// Columns of the table, and the programs whose cost is in each.
const COLUMNS: [(&str, &[&str]); 4] = [
    ("training", &["train-ss"]),
    ("rendering", &["render-depth"]),
    ("scoring", &["eval"]),
    ("refining", &["train-refine", "refine"]),
];
/// Index of refining among the columns.
const REFINING: usize = COLUMNS.len() - 1;

impl Cost {
    /// Returns the cost of some stages.
    fn of<'a>(estimates: impl Iterator<Item = &'a Estimate>) -> Self {
        let mut cost = Self::default();
        for estimate in estimates {
            cost.seconds += estimate.processor_seconds;
            cost.memory = cost.memory.max(estimate.memory);
        }
        cost
    }

    /// Returns the time on some processors, and the memory.
    fn text(self, processors: usize) -> String {
        if self == Self::default() {
            return "–".to_owned();
        }
        let time = format_duration(self.seconds / processors as f64);
        format!("{time}, {}", format_size(self.memory))
    }
}

/// Prints what the scenes are, what each quality costs, and the command of the best quality within
/// the limits; without limits, of the default. `arguments` are those of the plan.
pub(crate) fn advise(
    session: &Session,
    request: &Request,
    limits: Limits,
    arguments: &[String],
) -> anyhow::Result<()> {
    let processors = stage::processors().count;
    let mut datasets = Datasets::default();
    let mut all = Vec::new();
    for quality in Quality::ALL {
        all.push(costs(session, request, quality, &mut datasets)?);
    }
    print_table(&all, processors);
    let chosen = choose(&all, limits, processors);
    let quality = format!("quality={}", chosen.quality.name());
    let memory = limits.memory.filter(|memory| chosen.min_memory <= memory.bytes());
    let memory = memory.map(|memory| memory.to_string());
    let mut words = vec!["nerf-sr", "run"];
    words.extend(arguments.iter().map(String::as_str));
    words.extend(["-p", &quality]);
    words.extend(memory.iter().flat_map(|memory| ["--memory", memory]));
    print_line!("{}", command_text(words));
    Ok(())
}

fn print_table(all: &[QualityCosts], processors: usize) {
    let columns = COLUMNS.map(|(name, _)| format!("{name:<20}"));
    let on = format_count(processors, "processor");
    print_line!("{:<9} {} in all, on {on}", "quality", columns.join(" "));
    for costs in all {
        let parts = costs.parts.map(|part| format!("{:<20}", part.text(processors)));
        let (name, total) = (costs.quality.name(), costs.total.text(processors));
        print_line!("{name:<9} {} {total}", parts.join(" "));
    }
    if all.iter().any(|costs| costs.excludes_refining) {
        print_line!(
            "column \"in all\" excludes refining, which `nerf-sr run {REFINING_TARGET}` adds"
        );
    }
    let unknown = all[0].unknown;
    if unknown > 0 {
        print_line!("without {}, whose cost isn't known", format_count(unknown, "stage"));
    }
}

/// Chooses the best quality within the limits, or the fastest; without limits the default.
fn choose(all: &[QualityCosts], limits: Limits, processors: usize) -> &QualityCosts {
    let Limits { minutes, memory } = limits;
    let fastest = &all[0];
    if minutes.is_none() && memory.is_none() {
        return all.iter().find(|costs| costs.quality == Quality::default()).unwrap_or(fastest);
    }
    let fits_time = |costs: &QualityCosts| {
        minutes.is_none_or(|minutes| costs.total.seconds / processors as f64 <= 60.0 * minutes)
    };
    let fits_memory =
        |costs: &QualityCosts| memory.is_none_or(|memory| costs.min_memory <= memory.bytes());
    if let Some(costs) = all.iter().rfind(|costs| fits_time(costs) && fits_memory(costs)) {
        return costs;
    }
    let name = fastest.quality.name();
    if let Some(minutes) = minutes.filter(|_| !fits_time(fastest)) {
        print_line!("no quality fits into {minutes} minutes; the fastest is {name}");
    }
    if let Some(memory) = memory.filter(|_| !fits_memory(fastest)) {
        let need = format_size(fastest.min_memory);
        print_line!("no quality fits into {memory} of memory; {name} needs {need}");
    }
    fastest
}

/// Returns the costs of the stages that would run with a quality. For the first quality, also
/// prints the scenes.
fn costs(
    session: &Session,
    request: &Request,
    quality: Quality,
    datasets: &mut Datasets,
) -> anyhow::Result<QualityCosts> {
    let mut request = request.clone();
    request.parameters.push(format!("quality={}", quality.name()));
    let planned = session.plan_with_states(&request)?;
    let estimates = planned.estimates(datasets);
    if quality == Quality::ALL[0] {
        for scene in &estimates.scenes {
            print_line!("{scene}");
        }
    }
    let program = |index: &usize| planned.plan.nodes[*index].program.description.name.as_str();
    let mut parts = COLUMNS.map(|(_, names)| {
        let of_column = estimates.nodes.iter().filter(|(index, _)| names.contains(&program(index)));
        Cost::of(of_column.map(|(_, estimate)| estimate))
    });
    let mut excludes_refining = false;
    if parts[REFINING] == Cost::default()
        && let Some(refining) = refining_cost(session, &request, &planned.plan, datasets)
    {
        parts[REFINING] = refining;
        excludes_refining = true;
    }
    let all = || estimates.nodes.values();
    Ok(QualityCosts {
        quality,
        parts,
        total: Cost::of(all()),
        min_memory: all().map(|estimate| estimate.min_memory).max().unwrap_or(0),
        unknown: estimates.unknown,
        excludes_refining,
    })
}

/// Returns the additional cost of refining the views of a plan; `None` if the request names
/// targets, or if the target that refines can't be planned, as in a pipeline without it.
fn refining_cost(
    session: &Session,
    request: &Request,
    plan: &Plan,
    datasets: &mut Datasets,
) -> Option<Cost> {
    if !request.targets.is_empty() {
        return None;
    }
    let targets = vec![REFINING_TARGET.to_owned()];
    let request = Request { targets, ..request.clone() };
    let refined = session.plan_with_states(&request).ok()?;
    let estimates = refined.estimates(datasets);
    let is_new = |index: &usize| {
        let new = &refined.plan.nodes[*index];
        !plan.nodes.iter().any(|node| (&node.stage, &node.point) == (&new.stage, &new.point))
    };
    let added = estimates.nodes.iter().filter(|(index, _)| is_new(index));
    Some(Cost::of(added.map(|(_, estimate)| estimate)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn costs() -> Vec<QualityCosts> {
        let factors = Quality::ALL.into_iter().zip([1u32, 3, 10, 30]);
        factors
            .map(|(quality, factor)| QualityCosts {
                quality,
                parts: [Cost::default(); COLUMNS.len()],
                total: Cost { seconds: 60.0 * f64::from(factor), memory: 200_000_000 },
                min_memory: 100_000_000 * u64::from(factor),
                unknown: 0,
                excludes_refining: false,
            })
            .collect()
    }

    /// Two processors halve the duration of a quality.
    #[test]
    fn the_best_quality_within_the_limits_is_chosen() {
        for (minutes, memory, expected) in [
            (None, None, Quality::Balanced),
            (Some(100.0), None, Quality::Best),
            (Some(5.0), None, Quality::Balanced),
            (Some(0.1), None, Quality::Draft),
            (None, Some("1G"), Quality::Balanced),
            (None, Some("300M"), Quality::Fast),
            (None, Some("1M"), Quality::Draft),
            (Some(0.6), Some("1G"), Quality::Draft),
        ] {
            let memory = memory.map(|amount| amount.parse().unwrap());
            let costs = costs();
            let chosen = choose(&costs, Limits { minutes, memory }, 2).quality;
            assert_eq!(chosen, expected, "{minutes:?}, {memory:?}");
        }
    }

    #[test]
    fn stages_that_do_not_run_have_no_cost() {
        assert_eq!(Cost::default().text(2), "–");
        assert_eq!(Cost { seconds: 30.0, memory: 5_000_000 }.text(2), "15.0 s, 5.0 MB");
    }
}
