//! How values are shown: figures of metrics as these say it, and what tables add.

use std::collections::BTreeMap;

use metrics::{AnyMetrics, Figure};

/// Figures by their names in rows: their paths with `.` between keys.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Figures(BTreeMap<String, Figure>);

/// Values that tables add: name, title, digits and whether more is better.
const ADDED: [(&str, &str, usize, bool); 8] = [
    ("least_gain", "least gain", 2, true),
    ("near_psnr", "near psnr", 2, true),
    ("gain", "gain", 2, true),
    ("rendered_psnr", "rendered psnr", 2, true),
    ("refined_psnr", "refined psnr", 2, true),
    ("samples_per_ray", "samples per ray", 1, false),
    ("rays_per_s", "rays/s", 0, true),
    ("views", "views", 0, true),
];

impl Figures {
    /// Takes those of a `metrics.json`; none where it says nothing of figures, or leaves out which
    /// way one of them is better.
    pub(crate) fn add(&mut self, metrics: &AnyMetrics) {
        let is_whole = |said: &Vec<Figure>| said.iter().all(|f| f.higher_is_better.is_some());
        let said = metrics.figures().filter(is_whole).unwrap_or_default();
        self.0.extend(said.into_iter().map(|figure| (figure.path.replace('/', "."), figure)));
    }

    /// Whether less of it is better.
    pub(crate) fn is_less_better(&self, name: &str) -> bool {
        match self.0.get(name) {
            Some(figure) => figure.higher_is_better == Some(false),
            None => !added(name).is_some_and(|(.., higher)| higher),
        }
    }

    /// A value as people read it.
    pub(crate) fn shown(&self, name: &str, value: f64) -> String {
        if let Some(figure) = self.0.get(name) {
            return figure.text(value);
        }
        match (name, added(name)) {
            ("rays_per_s", _) => format!("{:.0} k", value / 1e3),
            (_, Some((_, digits, _))) => format!("{value:.digits$}"),
            _ if is_time(name) && value >= 120.0 => format!("{:.1} min", value / 60.0),
            _ if is_time(name) => format!("{value:.1} s"),
            _ if value.fract() == 0.0 => format!("{value:.0}"),
            _ => format!("{value:.4}"),
        }
    }

    /// Column titles of values.
    pub(crate) fn titles(&self, names: &[&String]) -> Vec<String> {
        names.iter().map(|name| self.title(name)).collect()
    }

    pub(crate) fn title(&self, name: &str) -> String {
        if let Some(figure) = self.0.get(name) {
            // The best of a column is in bold: that shows the direction.
            return figure.label.replace(" ↑ dB", "").replace(" ↑", "").replace(" ↓", "");
        }
        match (name, added(name)) {
            ("train_s", _) => "training".to_owned(),
            ("render_s", _) => "rendering".to_owned(),
            ("refine_s", _) => "refining".to_owned(),
            (_, Some((title, ..))) => title.to_owned(),
            _ => name.replace('_', " "),
        }
    }
}

fn added(name: &str) -> Option<(&'static str, usize, bool)> {
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

    /// A metric that the table has never heard of is shown as it says.
    #[test]
    fn a_new_metric_says_how_it_is_shown() {
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
        assert_eq!(figures.titles(&[&"sharpness.mean".to_owned()]), ["sharpness"]);
        assert_eq!(figures.shown("sharpness.mean", 2.34), "2.3");
        assert!(!figures.is_less_better("sharpness.mean") && figures.is_less_better("blur"));
    }

    #[test]
    fn times_and_what_tables_add_have_their_own_form() {
        let figures = Figures::default();
        for (name, value, text) in [
            ("train_s", 119.94, "119.9 s"),
            ("train_s", 180.0, "3.0 min"),
            ("rays_per_s", 114_000.0, "114 k"),
            ("gain", 0.5, "0.50"),
            ("views", 25.0, "25"),
            ("something", 3.0, "3"),
            ("something", 0.12345, "0.1235"),
        ] {
            assert_eq!(figures.shown(name, value), text, "{name}");
        }
        assert!(figures.is_less_better("train_s") && !figures.is_less_better("gain"));
        assert_eq!(figures.title("rays_per_s"), "rays/s");
    }
}
