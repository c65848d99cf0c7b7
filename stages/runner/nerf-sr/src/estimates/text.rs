//! Estimates as text, before and after a run.

use artifact::{Failure, format_count, format_duration, format_size};
use planning::Plan;
use stage::MEMORY_REMEDY;
use store::Record;

use super::{Estimate, Estimates};

impl Estimate {
    /// Returns time and memory as text.
    pub(crate) fn text(&self) -> String {
        cost_text(self.processor_seconds, self.memory)
    }
}

fn cost_text(processor_seconds: f64, memory: u64) -> String {
    let time = format_duration(processor_seconds);
    format!("{time} of processor time, {} of memory", format_size(memory))
}

impl Estimates {
    /// Returns the cost of all nodes as text; `None` if there are no estimates.
    pub(crate) fn total_text(&self, processors: usize) -> Option<String> {
        let memory = self.nodes.values().map(|estimate| estimate.memory).max()?;
        let seconds: f64 = self.nodes.values().map(|estimate| estimate.processor_seconds).sum();
        let without = match self.unknown {
            0 => String::new(),
            count => format!("; no estimate for {}", format_count(count, "other stage")),
        };
        Some(format!(
            "about {} of processor time: {} on {}; at most {} of memory for a stage{without}",
            format_duration(seconds),
            format_duration(seconds / processors as f64),
            format_count(processors, "processor"),
            format_size(memory)
        ))
    }
}

/// Returns the cost of a run before its start, with the time of each block; `None` if there are no
/// estimates.
pub(crate) fn run_text(plan: &Plan, estimates: &Estimates, processors: usize) -> Option<String> {
    let total = estimates.total_text(processors)?;
    let mut blocks: Vec<(&str, f64)> = Vec::new();
    for (index, estimate) in &estimates.nodes {
        let name = plan.nodes[*index].stage.as_str();
        match blocks.iter_mut().find(|(other, _)| *other == name) {
            Some((_, seconds)) => *seconds += estimate.processor_seconds,
            None => blocks.push((name, estimate.processor_seconds)),
        }
    }
    let blocks: Vec<String> = blocks
        .iter()
        .map(|(name, seconds)| format!("{name} {}", format_duration(*seconds)))
        .collect();
    Some(format!("{total}; processor time by stage: {}", blocks.join(", ")))
}

/// Returns the cost of a node's run, and the estimate.
pub(crate) fn comparison_text(estimate: &Estimate, record: &Record) -> Option<String> {
    let took = cost_text(record.processor_seconds?, record.peak_memory?);
    Some(format!("{took}; estimated {}", estimate.text()))
}

/// Returns the processor time of all nodes that ran, and the estimate; `None` if no node has both.
pub(crate) fn total_comparison_text<'a>(
    estimates: &Estimates,
    ran: impl Iterator<Item = (usize, &'a Record)>,
) -> Option<String> {
    let (mut took, mut estimated) = (0.0, 0.0);
    for (index, record) in ran {
        if let (Some(estimate), Some(seconds)) =
            (estimates.nodes.get(&index), record.processor_seconds)
        {
            took += seconds;
            estimated += estimate.processor_seconds;
        }
    }
    (estimated > 0.0).then(|| {
        format!(
            "{} of processor time, estimated {} ({:+.0} %)",
            format_duration(took),
            format_duration(estimated),
            100.0 * (took / estimated - 1.0)
        )
    })
}

/// Fails if a node needs more than the free memory.
pub(crate) fn check_memory(plan: &Plan, estimates: &Estimates, free: u64) -> Result<(), Failure> {
    let Some((index, estimate)) = estimates.nodes.iter().find(|(_, node)| node.min_memory > free)
    else {
        return Ok(());
    };
    Err(Failure::Usage(format!(
        "{} needs about {} of memory, and {} are free, so nothing was run; {MEMORY_REMEDY}",
        plan.nodes[*index].label(),
        format_size(estimate.min_memory),
        format_size(free)
    )))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use store::ModelCost;

    use super::*;

    fn estimate(processor_seconds: f64, memory: u64) -> Estimate {
        let model = ModelCost { processor_seconds, peak_memory: memory, scene: None };
        Estimate { processor_seconds, memory, min_memory: memory / 2, model }
    }

    fn estimates(unknown: usize) -> Estimates {
        let nodes =
            BTreeMap::from([(0, estimate(10.0, 2_000_000)), (2, estimate(30.0, 1_000_000))]);
        Estimates { nodes, unknown, scenes: Vec::new() }
    }

    #[test]
    fn a_total_has_the_largest_memory_and_the_sum_of_times() {
        let text = "about 40.0 s of processor time: 20.0 s on 2 processors; at most 2.0 MB of \
            memory for a stage";
        assert_eq!(estimates(0).total_text(2).unwrap(), text);
        let text = format!("{text}; no estimate for 3 other stages");
        assert_eq!(estimates(3).total_text(2).unwrap(), text);
        assert_eq!(Estimates::default().total_text(2), None);
    }

    #[test]
    fn a_run_is_compared_with_its_estimate() {
        let record = |seconds| Record {
            processor_seconds: Some(seconds),
            peak_memory: Some(3_000_000),
            ..Record::default()
        };
        assert_eq!(
            comparison_text(&estimate(10.0, 2_000_000), &record(12.0)).unwrap(),
            "12.0 s of processor time, 3.0 MB of memory; estimated 10.0 s of processor time, \
            2.0 MB of memory"
        );
        assert_eq!(comparison_text(&estimate(10.0, 1), &Record::default()), None);
        let (first, other) = (record(12.0), record(99.0));
        let runs = [(0, &first), (1, &other)].into_iter();
        assert_eq!(
            total_comparison_text(&estimates(0), runs).unwrap(),
            "12.0 s of processor time, estimated 10.0 s (+20 %)"
        );
        assert_eq!(total_comparison_text(&estimates(0), [(1, &other)].into_iter()), None);
    }
}
