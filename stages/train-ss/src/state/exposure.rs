use std::fmt;
use std::ops::Range;

use serde::{Deserialize, Serialize};

/// Factor by which a view's sums decay with every drawn pixel; chosen by hand.
const DECAY: f64 = 0.998;
/// Weight of the prior that gains are 1, in white pixels; chosen by hand.
const PRIOR: f64 = 1.0;
/// Training progress before which all gains are 1, because the field is still too rough. With a
/// much larger value, the field would already have explained exposures by floaters (design note
/// 026): about half of each difference would be found at 0.1, and none at 0.3.
const FIRST_PROGRESS: f64 = 0.02;
/// Ranges of steps in which gains are measured but not applied, each with a factor. Exposures count
/// as different if their spread is at least this factor times the field's relative error. Equal
/// exposures have a spread of up to 0.134 times this error in eight scenes (design note 026).
const MEASUREMENTS: [(Range<u64>, f64); 4] =
    [(128..192, 0.2), (192..256, 0.2), (256..384, 0.2), (384..512, 0.2)];
/// Additional measurement in a contraction, where the field explains large differences within 70
/// steps, by floaters in front of the cameras (design note 026).
const EARLY_MEASUREMENT: (Range<u64>, f64) = (24..36, 0.25);
/// Maximum training progress at the end of a measurement: starting over later would cost too much.
const MAX_MEASURED_PROGRESS: f64 = 0.25;

/// Sums of photographed · rendered and of rendered², for every view and channel, from which gains
/// follow by least squares.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct GainSums(Vec<[[f64; 2]; 3]>);

impl GainSums {
    fn new(views: usize) -> Self {
        Self(vec![[[0.0; 2]; 3]; views])
    }

    /// Adds a pixel of a view; earlier ones keep the fraction `decay` of their weight. NaN marks
    /// channels without information.
    fn add_pixel(&mut self, view: usize, photographed: [f32; 3], rendered: [f32; 3], decay: f64) {
        for (c, sums) in self.0[view].iter_mut().enumerate() {
            let [y, x] = [photographed[c], rendered[c]].map(f64::from);
            if y.is_finite() && x.is_finite() {
                *sums = [decay.mul_add(sums[0], y * x), decay.mul_add(sums[1], x * x)];
            }
        }
    }

    /// Returns the logarithms of the first `views` gains in a channel; their mean is 0.
    fn logarithms(&self, channel: usize, views: usize) -> Vec<f64> {
        let logarithms: Vec<f64> = (self.0.iter().take(views))
            .map(|sums| libm::log((sums[channel][0] + PRIOR) / (sums[channel][1] + PRIOR)))
            .collect();
        let mean = logarithms.iter().sum::<f64>() / logarithms.len().max(1) as f64;
        logarithms.into_iter().map(|logarithm| logarithm - mean).collect()
    }
}

/// Per-channel gain of each photograph relative to the field's render, by least squares over the
/// drawn pixels with exponential decay. The geometric mean of the gains is 1, since a gain that all
/// photographs share belongs to the field.
///
/// Gains apply to display-encoded colours: exposure scales linear light, and the sRGB encoding is
/// almost a power function.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Exposures {
    sums: GainSums,
    /// Gains, which follow from the sums; empty in a state read from a checkpoint.
    #[serde(skip)]
    gains: Vec<[f32; 3]>,
}

impl Exposures {
    pub(crate) fn new(views: usize) -> Self {
        Self { sums: GainSums::new(views), gains: vec![[1.0; 3]; views] }
    }

    /// Returns the gain of every view.
    pub(crate) fn gains(&self) -> &[[f32; 3]] {
        &self.gains
    }

    /// Adds a pixel of a view to the sums. NaN marks channels without information.
    pub(crate) fn add_pixel(&mut self, view: usize, photographed: [f32; 3], rendered: [f32; 3]) {
        self.sums.add_pixel(view, photographed, rendered, DECAY);
    }

    /// Recomputes the gains at a training progress in 0..1.
    pub(crate) fn update_gains(&mut self, progress: f64) {
        if progress < FIRST_PROGRESS {
            return;
        }
        for c in 0..3 {
            let logarithms = self.sums.logarithms(c, self.gains.len());
            for (gains, logarithm) in self.gains.iter_mut().zip(logarithms) {
                gains[c] = libm::exp(logarithm) as f32;
            }
        }
    }

    /// Returns the number of views.
    pub(crate) fn views(&self) -> usize {
        self.sums.0.len()
    }

    /// Restores the sums of a checkpoint.
    pub(crate) fn restore(&mut self, saved: Self) {
        self.sums = saved.sums;
    }
}

/// Measurement of the photographs' gains in the first steps of a training that applies none.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ExposureMeasurement {
    measurements: Vec<(Range<u64>, f64)>,
    /// Number of steps that have started.
    steps: u64,
    sums: GainSums,
    /// Sum of squared differences between photographed and rendered values.
    error: f64,
}

impl ExposureMeasurement {
    /// Creates a measurement of photographs in a contraction or in another space.
    pub(crate) fn new(views: usize, is_contraction: bool) -> Self {
        let early = is_contraction.then_some(EARLY_MEASUREMENT);
        let measurements = early.into_iter().chain(MEASUREMENTS).collect();
        Self { measurements, steps: 0, sums: GainSums::new(views), error: 0.0 }
    }

    /// Starts the next step.
    pub(crate) fn start_step(&mut self) {
        if self.measurements.iter().any(|(steps, _)| steps.start == self.steps) {
            (self.sums, self.error) = (GainSums::new(self.sums.0.len()), 0.0);
        }
        self.steps += 1;
    }

    /// True if the pixels of the current step count.
    pub(crate) fn is_measuring(&self) -> bool {
        let step = self.steps.saturating_sub(1);
        self.measurements.iter().any(|(steps, _)| steps.contains(&step))
    }

    /// Adds a pixel of a view if the current step counts. NaN marks channels without information.
    pub(crate) fn add_pixel(&mut self, view: usize, photographed: [f32; 3], rendered: [f32; 3]) {
        if self.is_measuring() {
            self.sums.add_pixel(view, photographed, rendered, 1.0);
            let errors = photographed.iter().zip(rendered).map(|(y, x)| f64::from(y - x));
            self.error += errors.filter(|e| e.is_finite()).map(|e| e * e).sum::<f64>();
        }
    }

    /// Returns the difference between the first `views` photographs after a step that ends a
    /// measurement, at a training progress in 0..1; `None` after any other step, or beyond
    /// [`MAX_MEASURED_PROGRESS`].
    pub(crate) fn difference(&self, progress: f64, views: usize) -> Option<ExposureDifference> {
        let ended = self.measurements.iter().find(|(steps, _)| steps.end == self.steps);
        let (_, factor) = ended.filter(|_| progress <= MAX_MEASURED_PROGRESS)?;
        let rendered: f64 = self.sums.0.as_flattened().iter().map(|sums| sums[1]).sum();
        let limit = factor * (self.error / (rendered + PRIOR)).sqrt();
        let logarithms = (0..3).flat_map(|c| self.sums.logarithms(c, views));
        let mean_square = logarithms.map(|l| l * l).sum::<f64>() / (3 * views).max(1) as f64;
        Some(ExposureDifference { steps: self.steps, spread: mean_square.sqrt(), limit })
    }

    /// Returns the number of views.
    pub(crate) fn views(&self) -> usize {
        self.sums.0.len()
    }
}

/// Result of a measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ExposureDifference {
    /// Number of steps until the end of the measurement.
    steps: u64,
    /// Root mean square of the logarithms of the photographs' gains.
    spread: f64,
    /// Minimum `spread` at which the exposures count as different.
    limit: f64,
}

impl ExposureDifference {
    /// True if this measurement was the last one.
    pub(crate) fn is_last(self) -> bool {
        MEASUREMENTS.last().is_some_and(|(steps, _)| steps.end == self.steps)
    }

    /// True if exposures are to be estimated.
    pub(crate) fn is_clear(self) -> bool {
        self.spread >= self.limit
    }
}

impl fmt::Display for ExposureDifference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { steps, spread, limit } = self;
        let [spread, limit] = [spread, limit].map(|of| 100.0 * of);
        let (order, decision) = if self.is_clear() {
            ("at least", "starting over and estimating exposures")
        } else {
            ("less than", "continuing without estimating exposures")
        };
        write!(
            f,
            "exposures of the photographs differ by {spread:.1} % after {steps} steps, {order} \
            {limit:.1} %: {decision}"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn json_round_trip<T: Serialize + serde::de::DeserializeOwned>(value: &T) -> T {
        serde_json::from_slice(&serde_json::to_vec(value).unwrap()).unwrap()
    }

    /// Gains are estimated up to a common factor, and restored from a checkpoint.
    #[test]
    fn gains_are_estimated() {
        let true_gains = [[0.5f32, 0.8, 1.0], [1.0, 1.0, 1.0], [2.0, 1.25, 1.0]];
        let mut exposures = Exposures::new(3);
        for i in 0..3000 {
            let rendered = [0.1 + 0.3 * (i % 7) as f32 / 7.0, 0.4, 0.2 + 0.2 * (i % 3) as f32];
            // The field itself may be a quarter too dark.
            let photographed = std::array::from_fn(|c| true_gains[i % 3][c] * rendered[c] / 0.75);
            exposures.add_pixel(i % 3, photographed, rendered);
            exposures.add_pixel(i % 3, [f32::NAN; 3], rendered);
        }
        exposures.update_gains(0.01);
        assert_eq!(exposures.gains(), [[1.0; 3]; 3]);
        exposures.update_gains(0.5);
        for (found, expected) in exposures.gains().iter().zip(true_gains) {
            assert!(
                found.iter().zip(expected).all(|(f, e)| (f / e - 1.0).abs() < 0.06),
                "{found:?} {expected:?}"
            );
        }
        let mut restored = Exposures::new(3);
        assert_eq!(exposures.views(), restored.views());
        restored.restore(json_round_trip(&exposures));
        restored.update_gains(0.5);
        assert_eq!(restored.gains(), exposures.gains());
    }

    /// Returns the differences measured between photographs with gains of e^±`spread`, by a field
    /// whose error is `error` times its colours.
    fn measure_differences(spread: f32, error: f32, progress: f64) -> Vec<ExposureDifference> {
        let mut measurement = ExposureMeasurement::new(5, true);
        let mut differences = Vec::new();
        for _ in 0..600 {
            measurement.start_step();
            for i in 0..70 {
                let (view, rendered) = (i % 5, [0.1 + 0.3 * (i % 7) as f32 / 7.0; 3]);
                // The fifth view is a reference of another exposure, which isn't counted.
                let gain = if view == 4 { 1.2 } else { (spread * [1.0, -1.0][view % 2]).exp() };
                let error = if i < 35 { 1.0 + error } else { 1.0 - error };
                measurement.add_pixel(view, rendered.map(|x| error * gain * x), rendered);
                measurement.add_pixel(view, [f32::NAN; 3], rendered);
            }
            differences.extend(measurement.difference(progress, 4));
        }
        differences
    }

    #[test]
    fn differences_are_measured() {
        for (spread, error, is_clear) in [
            (0.0, 0.05, [false; 5]),
            (0.02, 0.2, [false; 5]),
            (0.05, 0.2, [false, true, true, true, true]),
            (0.07, 0.2, [true; 5]),
            (0.06, 0.5, [false; 5]),
            (0.3, 0.5, [true; 5]),
        ] {
            let differences = measure_differences(spread, error, 0.1);
            let found: Vec<bool> = differences.iter().map(|d| d.is_clear()).collect();
            assert_eq!(found, is_clear, "{differences:?}");
            let errors = differences.iter().map(|d| (d.spread - f64::from(spread)).abs());
            assert!(
                errors.fold(0.0, f64::max) < 0.15 * f64::from(spread) + 1e-9,
                "{differences:?}"
            );
        }
        assert!(!ExposureMeasurement::new(5, false).measurements.contains(&EARLY_MEASUREMENT));
        let text = measure_differences(0.06, 0.2, 0.1)[3].to_string();
        assert!(text.contains("differ by 5.9 % after 384 steps, at least 4."), "{text}");
        assert_eq!(measure_differences(0.5, 0.1, 0.3), []);
    }

    /// A measurement resumed from a checkpoint has the same result.
    #[test]
    fn a_measurement_is_resumed() {
        let mut measurement = ExposureMeasurement::new(2, true);
        for step in 0..192 {
            measurement.start_step();
            assert_eq!(measurement.is_measuring(), (24..36).contains(&step) || step >= 128);
            measurement.add_pixel(0, [0.5; 3], [0.4; 3]);
            measurement.add_pixel(1, [0.4; 3], [0.5; 3]);
            if step == 150 {
                let restored = json_round_trip(&measurement);
                assert_eq!(restored, measurement);
                measurement = restored;
            }
            assert_eq!(measurement.difference(0.1, 2).is_some(), [35, 191].contains(&step));
        }
        let spread = measurement.difference(0.1, 2).unwrap().spread;
        assert!((spread - 1.25f64.ln()).abs() < 0.03, "{spread}");
    }
}
