use pixels::{DepthMap, Palette, palette_colour};
use serde::Serialize;

/// Colour scale of error or depth maps, with numbers.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Scale {
    label: String,
    /// Colours from left to right, evenly spaced.
    colours: Vec<String>,
    /// Position from left (0) to right (1) and text of each number.
    ticks: Vec<(f64, String)>,
}

/// Number of a scale's colours; a browser's interpolation between two neighbours is
/// indistinguishable from the exact colours. Chosen by hand.
const COLOURS: usize = 24;
/// Minimum length of a scale, in intervals between ticks; chosen by hand.
const MIN_INTERVALS: f64 = 4.0;

impl Scale {
    /// Creates the scale of error maps; `range` is the error with the brightest colour, and `at_lr`
    /// states that errors are those of LR images.
    pub(crate) fn error(range: f64, at_lr: bool) -> Self {
        let subject = if at_lr { "Absolute error at LR" } else { "Absolute error" };
        let mut ticks = ticks(0.0, range);
        // Larger errors have the brightest colour, too. Because of rounding errors, a position
        // above 0.999 counts as the end.
        if let Some((_, text)) = ticks.last_mut().filter(|(position, _)| *position > 0.999) {
            text.insert_str(0, "≥ ");
        }
        Self {
            label: format!("{subject}, mean of R, G, B"),
            colours: (0..COLOURS)
                .map(|i| css(palette_colour(Palette::Error, i as f32 / (COLOURS - 1) as f32)))
                .collect(),
            ticks,
        }
    }

    /// Creates the scale of depth maps, from near to far.
    pub(crate) fn depth((near, far): (f32, f32)) -> Self {
        let depths: Vec<f32> =
            (0..COLOURS).map(|i| near + (far - near) * i as f32 / (COLOURS - 1) as f32).collect();
        let map = DepthMap { depth: &depths, opacity: &[1.0; COLOURS] };
        let drawn = map.draw(COLOURS, (near, far));
        Self {
            label: "Depth, scene units; white where nothing is".to_owned(),
            colours: drawn.data.chunks_exact(4).map(|p| css([p[0], p[1], p[2]])).collect(),
            ticks: ticks(f64::from(near), f64::from(far)),
        }
    }
}

fn css([r, g, b]: [u8; 3]) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Returns round numbers between `low` and `high`, with their positions.
fn ticks(low: f64, high: f64) -> Vec<(f64, String)> {
    let span = high - low;
    if !(span > 0.0 && span.is_finite()) {
        // `f32`, so that 2.13 isn't printed as 2.130000114.
        return vec![(0.0, format!("{}", low as f32))];
    }
    let power = 10f64.powf((span / MIN_INTERVALS).log10().floor());
    // A step of `power` is always short enough. Tolerances (0.01, 1e-9) are for rounding errors.
    let steps = [5.0, 2.0].map(|factor| factor * power);
    let step = steps.into_iter().find(|step| span / step >= MIN_INTERVALS - 0.01).unwrap_or(power);
    let digits = (-step.log10().floor()).max(0.0) as usize;
    let first = (low / step - 1e-9).ceil() as i64;
    let last = (high / step + 1e-9).floor() as i64;
    let ticks = (first..=last).map(|i| {
        let value = i as f64 * step;
        (((value - low) / span).clamp(0.0, 1.0), format!("{value:.digits$}"))
    });
    ticks.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(scale: &Scale) -> Vec<String> {
        scale.ticks.iter().map(|(_, text)| text.clone()).collect()
    }

    #[test]
    fn scales_have_round_numbers() {
        let error = Scale::error(0.25, false);
        assert_eq!(texts(&error), ["0.00", "0.05", "0.10", "0.15", "0.20", "≥ 0.25"]);
        assert_eq!((error.ticks[0].0, error.ticks[5].0), (0.0, 1.0));
        let depth = Scale::depth((2.13, 6.4));
        assert_eq!(texts(&depth), ["3", "4", "5", "6"]);
        assert!(depth.ticks.windows(2).all(|pair| pair[0].0 < pair[1].0));
        // A range with one depth, and an invalid range.
        assert_eq!(texts(&Scale::depth((2.13, 2.13))), ["2.13"]);
        assert_eq!(Scale::depth((3.0, f32::NAN)).ticks.len(), 1);
    }

    /// Scales have the colours of the maps: near is warm.
    #[test]
    fn colours_are_those_of_the_maps() {
        let (error, depth) = (Scale::error(0.25, false), Scale::depth((1.0, 9.0)));
        assert_eq!(error.colours[0], css(palette_colour(Palette::Error, 0.0)));
        assert_eq!(error.colours[COLOURS - 1], css(palette_colour(Palette::Error, 1.0)));
        let near = DepthMap { depth: &[1.0], opacity: &[1.0] }.draw(1, (1.0, 9.0)).data;
        assert_eq!(depth.colours[0], css([near[0], near[1], near[2]]));
        assert!(near[0] > near[2], "{near:?}");
    }
}
