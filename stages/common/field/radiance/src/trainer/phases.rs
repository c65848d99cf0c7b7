use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Phase of a training step. Phases follow each other, with a barrier between them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// Evaluation of cells' densities, at some steps.
    Occupancy,
    /// Forward and backward passes of the rays.
    Passes,
    /// Sums of the networks' gradients over all shards, and the search for numbers that aren't
    /// finite.
    Sums,
    /// Sums of the grid's gradients.
    GridGradients,
    /// Adam's step of grid and networks.
    Adam,
    /// Update of the averaged weights, at some steps.
    Average,
    /// Storage of densities and rendered colours for later steps.
    Records,
}

impl Phase {
    /// All phases in the order of a step.
    pub const ALL: [Self; 7] = [
        Self::Occupancy,
        Self::Passes,
        Self::Sums,
        Self::GridGradients,
        Self::Adam,
        Self::Average,
        Self::Records,
    ];
}

/// Time spent in a phase, summed over all steps of a training, or in rendering. All times are in
/// seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhaseTimes {
    /// Time from the phase's start to its end.
    pub elapsed: f64,
    /// Sum of the tasks' durations.
    pub in_tasks: f64,
    /// Sum of the duration of each step's longest task.
    pub in_longest_tasks: f64,
    /// Number of tasks.
    pub tasks: u64,
    /// Number of steps that have the phase.
    pub steps: u64,
}

/// Clock of one phase of one step.
#[derive(Debug)]
pub struct PhaseClock {
    start: Instant,
    in_tasks: AtomicU64,
    longest: AtomicU64,
    tasks: AtomicU64,
}

impl PhaseClock {
    /// Starts a phase.
    pub fn start() -> Self {
        Self {
            start: Instant::now(),
            in_tasks: AtomicU64::new(0),
            longest: AtomicU64::new(0),
            tasks: AtomicU64::new(0),
        }
    }

    /// Runs a task and records its time.
    pub fn task<T>(&self, run: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = run();
        let nanoseconds = start.elapsed().as_nanos() as u64;
        self.in_tasks.fetch_add(nanoseconds, Ordering::Relaxed);
        self.longest.fetch_max(nanoseconds, Ordering::Relaxed);
        self.tasks.fetch_add(1, Ordering::Relaxed);
        result
    }
}

impl PhaseTimes {
    /// Adds a step's phase, which ends now.
    pub(crate) fn add(&mut self, clock: &PhaseClock) {
        let seconds = |counter: &AtomicU64| counter.load(Ordering::Relaxed) as f64 / 1e9;
        self.elapsed += clock.start.elapsed().as_secs_f64();
        self.in_tasks += seconds(&clock.in_tasks);
        self.in_longest_tasks += seconds(&clock.longest);
        self.tasks += clock.tasks.load(Ordering::Relaxed);
        self.steps += 1;
    }
}
