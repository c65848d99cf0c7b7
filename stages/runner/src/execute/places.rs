//! Whether this machine has place for one more stage: places, cores and memory.

use std::collections::BTreeMap;

use artifact::sized;
use planning::nearest_record;
use serde_json::{Map, Value};
use store::Record;

/// What a stage is expected to take.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Need {
    /// Cores that it keeps busy.
    cores: usize,
    /// Memory in bytes.
    memory: u64,
}

/// A stage of which nothing is known.
const UNKNOWN_NEED: Need = Need { cores: 1, memory: 0 };

impl Need {
    /// What the nearest measured run of a stage took; one core and no memory where there is none.
    pub(crate) fn of(key_parts: &Map<String, Value>, stage: &str, records: &[Record]) -> Self {
        let measured =
            records.iter().filter(|record| record.peak_memory.is_some() && record.stage == stage);
        nearest_record(key_parts, measured).map_or(UNKNOWN_NEED, |record| Self {
            cores: record
                .processor_seconds
                .map_or(1, |busy| (busy / record.seconds.max(1e-3)).round() as usize)
                .max(1),
            memory: record.peak_memory.unwrap_or(0),
        })
    }

    fn memory_in_words(self) -> String {
        format!("it took {} of memory when it last ran", sized(self.memory))
    }
}

/// What a run may take of this machine.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Budget {
    /// Stages at once.
    pub(crate) stages: usize,
    /// Cores, and as many threads for every stage: stages side by side share the cores, and one
    /// that is left alone has them all.
    pub(crate) threads: usize,
    /// Memory in bytes.
    pub(crate) memory: u64,
}

/// Whether a stage has place.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Place {
    Free,
    /// When another has ended.
    Later,
    /// When another has ended, which has the memory: why, for people.
    LaterForMemory(String),
    /// It needs more than there is: why, for people.
    Never(String),
}

/// Stages that run, within a budget.
pub(crate) struct Places {
    budget: Budget,
    running: BTreeMap<usize, Need>,
}

impl Places {
    pub(crate) fn new(budget: Budget) -> Self {
        Self { budget, running: BTreeMap::new() }
    }

    pub(crate) fn is_idle(&self) -> bool {
        self.running.is_empty()
    }

    pub(crate) fn take(&mut self, index: usize, need: Need) {
        self.running.insert(index, need);
    }

    pub(crate) fn give_back(&mut self, index: usize) {
        self.running.remove(&index);
    }

    /// Whether a stage may start: while a core would be idle without it, and its memory is left.
    pub(crate) fn place(&self, need: Need) -> Place {
        let memory = self.budget.memory;
        if need.memory > memory {
            return Place::Never(format!(
                "{}, and there are {}; --memory says otherwise",
                need.memory_in_words(),
                sized(memory)
            ));
        }
        let cores: usize = self.running.values().map(|need| need.cores).sum();
        if self.running.len() >= self.budget.stages || cores >= self.budget.threads {
            return Place::Later;
        }
        let left = memory.saturating_sub(self.running.values().map(|need| need.memory).sum());
        if need.memory > left {
            return Place::LaterForMemory(format!(
                "{}, and {} of {} are left",
                need.memory_in_words(),
                sized(left),
                sized(memory)
            ));
        }
        Place::Free
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    const GB: u64 = 1_000_000_000;
    const BUDGET: Budget = Budget { stages: 3, threads: 4, memory: 8 * GB };

    fn need(cores: usize, gb: u64) -> Need {
        Need { cores, memory: gb * GB }
    }

    fn place_beside(running: &[Need], wanted: Need) -> Place {
        let mut places = Places::new(BUDGET);
        running.iter().enumerate().for_each(|(index, need)| places.take(index, *need));
        places.place(wanted)
    }

    fn said(place: Place) -> String {
        match place {
            Place::LaterForMemory(why) | Place::Never(why) => why,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_stage_starts_while_a_core_a_place_and_its_memory_are_left() {
        assert_eq!(place_beside(&[], need(64, 8)), Place::Free);
        assert_eq!(place_beside(&[need(3, 0)], need(4, 0)), Place::Free);
        assert_eq!(place_beside(&[need(4, 0)], need(1, 0)), Place::Later);
        assert_eq!(place_beside(&[UNKNOWN_NEED; 3], UNKNOWN_NEED), Place::Later);
        let later = said(place_beside(&[need(1, 5)], need(1, 4)));
        assert_eq!(
            later,
            "it took 4.0 GB of memory when it last ran, and 3.0 GB of 8.0 GB are left"
        );
        let never = said(place_beside(&[], need(1, 9)));
        assert_eq!(
            never,
            "it took 9.0 GB of memory when it last ran, and there are 8.0 GB; --memory says \
            otherwise"
        );
    }

    #[test]
    fn an_ended_stage_leaves_its_place() {
        let mut places = Places::new(BUDGET);
        places.take(7, need(4, 8));
        assert_eq!(places.place(UNKNOWN_NEED), Place::Later);
        places.give_back(7);
        assert!(places.is_idle() && places.place(need(1, 8)) == Place::Free);
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
    fn the_nearest_measured_run_tells() {
        let records = [
            record("train", parts(4, 0), Some(6)),
            record("train", parts(2, 0), Some(2)),
            record("train", parts(4, 1), None),
            record("eval", parts(4, 1), Some(1)),
        ];
        assert_eq!(Need::of(&parts(4, 1), "train", &records), need(2, 6));
        assert_eq!(Need::of(&parts(2, 1), "train", &records), need(2, 2));
        assert_eq!(Need::of(&parts(2, 1), "render", &records), UNKNOWN_NEED);
    }
}
