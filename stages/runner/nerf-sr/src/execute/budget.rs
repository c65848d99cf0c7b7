//! Admission of stages: a stage starts if a slot, a core and its memory are free (docs/design/036).

use std::collections::BTreeMap;
use std::num::NonZeroUsize;

use artifact::{format_count, format_size, report_line};
use planning::nearest_record;
use serde_json::{Map, Value};
use stage::{ALL_PROCESSORS, Processors, machine_memory, processors};
use store::Record;

/// Maximum number of threads, and of stages, per core. A larger number would only cost memory and
/// time; chosen by hand.
const MAX_PER_CORE: usize = 4;
/// Maximum number of stages at once without `--jobs`; chosen by hand.
const DEFAULT_MAX_STAGES: usize = 4;

/// Cores and memory that a stage is expected to use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Demand {
    /// Number of busy cores.
    cores: usize,
    /// Peak memory in bytes.
    memory: u64,
}

/// Demand of a stage without a measured run (docs/design/036).
const DEFAULT_DEMAND: Demand = Demand { cores: 1, memory: 0 };

impl Demand {
    /// Estimates a stage's demand from its measured run with the nearest key.
    pub(crate) fn estimate(parts: &Map<String, Value>, stage: &str, records: &[Record]) -> Self {
        let measured =
            records.iter().filter(|record| record.peak_memory.is_some() && record.stage == stage);
        let Some(record) = nearest_record(parts, measured) else { return DEFAULT_DEMAND };
        // Short stages may have measured 0 seconds; the minimum was chosen by hand.
        let seconds = record.seconds.max(1e-3);
        let cores = record.processor_seconds.map_or(1, |busy| (busy / seconds).round() as usize);
        Self { cores: cores.max(1), memory: record.peak_memory.unwrap_or(0) }
    }
}

/// Limits of the stages that run at the same time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Budget {
    /// Maximum number of stages.
    pub(crate) stages: usize,
    /// Cores of all stages together; also each stage's number of threads. The operating system
    /// divides the cores among the stages, and a stage that runs alone uses all cores.
    pub(crate) cores: usize,
    /// Memory in bytes.
    pub(crate) memory: u64,
    /// Limit that makes `cores` less than the machine's number of processors, such as a cgroup;
    /// `None` if there is no such limit, or with `--threads`.
    pub(crate) limit: Option<&'static str>,
}

impl Budget {
    /// Creates the budget for `--jobs`, `--threads` and `--memory` in bytes.
    pub(crate) fn new(
        jobs: Option<NonZeroUsize>,
        threads: Option<NonZeroUsize>,
        memory: Option<u64>,
    ) -> Self {
        let Processors { count: cores, limit } = processors();
        let stages = jobs.map_or(cores.min(DEFAULT_MAX_STAGES), NonZeroUsize::get);
        Self {
            stages: capped("--jobs", stages, cores),
            cores: capped("--threads", threads.map_or(cores, NonZeroUsize::get), cores),
            memory: memory.or_else(machine_memory).unwrap_or(u64::MAX),
            limit: Some(limit).filter(|&limit| threads.is_none() && limit != ALL_PROCESSORS),
        }
    }

    /// Returns the line that names a limit below the machine's number of processors.
    pub(crate) fn limit_line(&self) -> Option<String> {
        let limit = self.limit?;
        Some(format!("nerf-sr: {}: {limit}", format_count(self.cores, "thread")))
    }

    /// Decides whether a stage may start next to the running ones: a slot, a core and its memory
    /// must be free. One free core is enough for a stage of several threads.
    pub(crate) fn admission(&self, running: &BTreeMap<usize, Demand>, demand: Demand) -> Admission {
        let problem = format!(
            "needs {} of memory, as in its most similar earlier run, but",
            format_size(demand.memory)
        );
        let memory_limit = format_size(self.memory);
        if demand.memory > self.memory {
            return Admission::TooLarge(format!(
                "{problem} the limit is {memory_limit}; change the limit with --memory"
            ));
        }
        let busy: usize = running.values().map(|demand| demand.cores).sum();
        if running.len() >= self.stages || busy >= self.cores {
            return Admission::Wait;
        }
        let used: u64 = running.values().map(|demand| demand.memory).sum();
        let free = self.memory.saturating_sub(used);
        if demand.memory <= free {
            return Admission::Start;
        }
        let free = format_size(free);
        Admission::WaitForMemory(format!("{problem} {free} of {memory_limit} are free"))
    }
}

/// Caps the number given by an option, and reports this.
fn capped(option: &str, given: usize, cores: usize) -> usize {
    let max = cores.saturating_mul(MAX_PER_CORE);
    if given > max {
        report_line!(
            "nerf-sr: {option} {given} is more than {} can use; using {max}, with the same results",
            format_count(cores, "core")
        );
    }
    given.min(max)
}

/// Decision whether a stage may start.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Admission {
    Start,
    /// The stage waits until another one ends.
    Wait,
    /// The stage waits until another one frees memory; the reason is human-readable.
    WaitForMemory(String),
    /// The stage needs more memory than the budget; the reason is human-readable.
    TooLarge(String),
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    const GB: u64 = 1_000_000_000;
    const BUDGET: Budget = Budget { stages: 3, cores: 4, memory: 8 * GB, limit: None };

    fn demand(cores: usize, gb: u64) -> Demand {
        Demand { cores, memory: gb * GB }
    }

    fn admission_while_running(running: &[Demand], demand: Demand) -> Admission {
        BUDGET.admission(&running.iter().copied().enumerate().collect(), demand)
    }

    #[test]
    fn only_excessive_numbers_are_capped() {
        assert_eq!([8, 1000].map(|threads| capped("--threads", threads, 2)), [8, 8]);
        assert_eq!(capped("--jobs", 3, 2), 3);
    }

    #[test]
    fn a_stage_starts_while_a_core_a_slot_and_its_memory_are_free() {
        assert_eq!(admission_while_running(&[], demand(64, 8)), Admission::Start);
        assert_eq!(admission_while_running(&[demand(3, 0)], demand(4, 0)), Admission::Start);
        assert_eq!(admission_while_running(&[demand(4, 0)], demand(1, 0)), Admission::Wait);
        assert_eq!(admission_while_running(&[DEFAULT_DEMAND; 3], DEFAULT_DEMAND), Admission::Wait);
        let wait = "needs 4.0 GB of memory, as in its most similar earlier run, but 3.0 GB of \
            8.0 GB are free";
        assert_eq!(
            admission_while_running(&[demand(1, 5)], demand(1, 4)),
            Admission::WaitForMemory(wait.to_owned())
        );
        let too_large = "needs 9.0 GB of memory, as in its most similar earlier run, but the limit \
            is 8.0 GB; change the limit with --memory";
        assert_eq!(
            admission_while_running(&[], demand(1, 9)),
            Admission::TooLarge(too_large.to_owned())
        );
    }

    fn parts(scale: u64, seed: u64) -> Map<String, Value> {
        json!({"scale": scale, "seed": seed}).as_object().unwrap().clone()
    }

    fn record(stage: &str, key_parts: Map<String, Value>, gb: Option<u64>) -> Record {
        Record {
            stage: stage.to_owned(),
            key_parts,
            seconds: 10.0,
            peak_memory: gb.map(|gb| gb * GB),
            processor_seconds: gb.map(|_| 17.0),
            ..Record::default()
        }
    }

    #[test]
    fn the_nearest_measured_run_gives_the_estimate() {
        let records = [
            record("train", parts(4, 0), Some(6)),
            record("train", parts(2, 0), Some(2)),
            record("train", parts(4, 1), None),
            record("eval", parts(4, 1), Some(1)),
        ];
        assert_eq!(Demand::estimate(&parts(4, 1), "train", &records), demand(2, 6));
        assert_eq!(Demand::estimate(&parts(2, 1), "train", &records), demand(2, 2));
        assert_eq!(Demand::estimate(&parts(2, 1), "render", &records), DEFAULT_DEMAND);
    }
}
