//! Titles, digits and directions of values: as declared by metrics, and the table's own.

use std::collections::BTreeMap;

use metrics::{AnyMetrics, ScoreFormat};

/// Figures by their names in rows: paths with `.` between keys.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Figures(BTreeMap<String, ScoreFormat>);

/// Values that the table adds to those of metrics: name, title, digits, and whether higher values
/// are better; `None` if no value is better than another.
const ADDED: [(&str, &str, usize, Option<bool>); 12] = [
    ("least_gain", "least gain", 2, Some(true)),
    ("near_psnr", "near psnr", 2, Some(true)),
    ("gain", "gain", 2, Some(true)),
    ("rendered_psnr", "rendered psnr", 2, Some(true)),
    ("refined_psnr", "refined psnr", 2, Some(true)),
    ("samples_per_ray", "samples per ray", 1, Some(false)),
    ("rays_per_s", "rays/s", 0, Some(true)),
    ("views", "views", 0, None),
    ("near_views", "near views", 0, None),
    ("seconds_per_view", "seconds per view", 1, Some(false)),
    ("peak_mb", "peak memory, MB", 0, Some(false)),
    ("field_mb", "field, MB", 1, Some(false)),
];

impl Figures {
    /// Adds the figures declared in a `metrics.json`; none if one of them has no direction.
    pub(crate) fn add(&mut self, metrics: &AnyMetrics) {
        let Some(declared) = metrics.figures() else { return };
        if declared.iter().all(|figure| figure.higher_is_better.is_some()) {
            self.0.extend(declared.into_iter().map(|f| (f.path.replace('/', "."), f)));
        }
    }

    /// Returns whether lower values are better: as declared by a metric, otherwise as known by
    /// name.
    /// `None` if no value is known to be better than another.
    pub(crate) fn lower_is_better(&self, name: &str) -> Option<bool> {
        let is_higher_better = match (self.0.get(name), added(name)) {
            (Some(figure), _) => figure.higher_is_better,
            (None, Some((.., is_higher_better))) => is_higher_better,
            (None, None) if name.starts_with("psnr") || name.starts_with("ssim") => Some(true),
            (None, None) if name.starts_with("lpips") || is_time(name) => Some(false),
            (None, None) => None,
        };
        is_higher_better.map(|is_higher_better| !is_higher_better)
    }

    /// Formats a value with its digits and unit.
    pub(crate) fn format(&self, name: &str, value: f64) -> String {
        if let Some(figure) = self.0.get(name) {
            return figure.format_value(value);
        }
        match (name, added(name)) {
            ("rays_per_s", _) => format!("{:.0} k", value / 1e3),
            (_, Some((_, digits, _))) => format!("{value:.digits$}"),
            // Minutes from 120 s on; chosen by hand.
            _ if is_time(name) && value >= 120.0 => format!("{:.1} min", value / 60.0),
            _ if is_time(name) => format!("{value:.1} s"),
            _ if value.fract() == 0.0 => format!("{value:.0}"),
            _ => format!("{value:.4}"),
        }
    }

    /// Returns the column title of a value.
    pub(crate) fn title(&self, name: &str) -> String {
        if let Some(figure) = self.0.get(name) {
            // The best value of a column is bold, which shows the direction.
            return figure.label.replace(" ↑ dB", "").replace(" ↑", "").replace(" ↓", "");
        }
        match (name, added(name)) {
            ("train_s", _) => "training".to_owned(),
            ("train_cpu_s", _) => "training, processor".to_owned(),
            ("render_s", _) => "rendering".to_owned(),
            ("refine_s", _) => "refining".to_owned(),
            (_, Some((title, ..))) => title.to_owned(),
            _ => name.replace('_', " "),
        }
    }
}

fn added(name: &str) -> Option<(&'static str, usize, Option<bool>)> {
    let found = ADDED.iter().find(|(added, ..)| *added == name)?;
    Some((found.1, found.2, found.3))
}

fn is_time(name: &str) -> bool {
    name.ends_with("_s")
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// Figures of an unknown metric have the declared title, digits and direction.
    #[test]
    fn a_new_metric_declares_its_format() {
        let mut figures = Figures::default();
        figures.add(&AnyMetrics::from(json!({"figures": [
            {
                "path": "sharpness/mean",
                "label": "sharpness ↑",
                "digits": 1,
                "higher_is_better": true,
            },
            {"path": "blur", "label": "blur ↓", "digits": 3, "higher_is_better": false},
        ]})));
        assert_eq!(figures.title("sharpness.mean"), "sharpness");
        assert_eq!(figures.format("sharpness.mean", 2.34), "2.3");
        assert_eq!(figures.lower_is_better("sharpness.mean"), Some(false));
        assert_eq!(figures.lower_is_better("blur"), Some(true));
    }

    #[test]
    fn undeclared_figures_have_fixed_formats() {
        let figures = Figures::default();
        for (name, value, text) in [
            ("train_s", 119.94, "119.9 s"),
            ("train_s", 180.0, "3.0 min"),
            ("rays_per_s", 114_000.0, "114 k"),
            ("gain", 0.5, "0.50"),
            ("views", 25.0, "25"),
            ("seconds_per_view", 3.9962, "4.0"),
            ("something", 3.0, "3"),
            ("something", 0.12345, "0.1235"),
        ] {
            assert_eq!(figures.format(name, value), text, "{name}");
        }
        for (name, expected) in [
            ("train_s", Some(true)),
            ("gain", Some(false)),
            ("psnr", Some(false)),
            ("ssim_valid", Some(false)),
            ("lpips_vgg", Some(true)),
            ("views", None),
            ("something", None),
        ] {
            assert_eq!(figures.lower_is_better(name), expected, "{name}");
        }
        assert_eq!(figures.title("rays_per_s"), "rays/s");
    }
}
