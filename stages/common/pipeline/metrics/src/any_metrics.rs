use std::io;
use std::path::Path;

use serde_json::Value;

use crate::score_format::ScoreFormat;

/// Name of the file in an artifact of kind `metrics`.
pub const METRICS_FILE: &str = "metrics.json";

/// `metrics.json` of any stage. A user's own stage may omit any field, or write others.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AnyMetrics(Value);

impl AnyMetrics {
    /// Reads the file of an artifact; accepts JSON of any form. Errors name the file.
    pub fn read(folder: &Path) -> io::Result<Self> {
        let file = folder.join(METRICS_FILE);
        let named = |e: io::Error| io::Error::new(e.kind(), format!("{}: {e}", file.display()));
        let bytes = std::fs::read(&file).map_err(named)?;
        serde_json::from_slice(&bytes).map(Self).map_err(|e| named(e.into()))
    }

    /// Returns the formats of the scores to display; `None` if the list is missing or contains
    /// anything but a [`ScoreFormat`].
    pub fn figures(&self) -> Option<Vec<ScoreFormat>> {
        serde_json::from_value(self.0["figures"].clone()).ok()
    }

    /// Returns the names and titles of the metrics' pictures, sorted by name.
    pub fn picture_titles(&self) -> Vec<(&str, &str)> {
        let titles = self.0["picture_titles"].as_object().into_iter().flatten();
        titles.filter_map(|(name, title)| Some((name.as_str(), title.as_str()?))).collect()
    }

    /// Returns whether the views have HR ground truth; without it `eval` scores them at LR only.
    pub fn has_hr_truth(&self) -> bool {
        self.mean()["psnr"].is_number()
    }

    /// Returns the means over the views; null if missing.
    pub fn mean(&self) -> &Value {
        &self.0["mean"]
    }

    /// Returns the views; empty if the list is missing.
    pub fn views(&self) -> &[Value] {
        self.0["views"].as_array().map(Vec::as_slice).unwrap_or_default()
    }

    /// Returns the metrics' definitions as text; null if missing.
    pub fn conventions(&self) -> &Value {
        &self.0["conventions"]
    }

    /// Returns [`Metrics::least_gain`](crate::Metrics::least_gain); null if missing.
    pub fn least_gain(&self) -> &Value {
        &self.0["least_gain"]
    }

    /// Returns [`Metrics::near_references`](crate::Metrics::near_references); null if missing.
    pub fn near_references(&self) -> &Value {
        &self.0["near_references"]
    }
}

impl From<Value> for AnyMetrics {
    fn from(value: Value) -> Self {
        Self(value)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// A user's own stage may write any JSON.
    #[test]
    fn all_fields_are_optional() {
        for value in [json!({"mean": {"mse": 0.25}, "views": {}, "more": 1}), json!([]), json!(3)] {
            let metrics = AnyMetrics::from(value.clone());
            assert_eq!(metrics.mean(), &value["mean"], "{value}");
            assert_eq!((metrics.figures(), metrics.views().len()), (None, 0), "{value}");
            assert!(metrics.picture_titles().is_empty() && !metrics.has_hr_truth(), "{value}");
            assert!(metrics.conventions().is_null() && metrics.least_gain().is_null(), "{value}");
            assert!(metrics.near_references()["psnr"].is_null(), "{value}");
        }
    }

    #[test]
    fn figures_may_have_more_fields_and_no_direction() {
        let read_figures = |figures: Value| AnyMetrics::from(json!({"figures": figures})).figures();
        let found = read_figures(json!([
            {"path": "a/b", "label": "b", "digits": 1, "colour": "red"},
            {"path": "c", "label": "c", "digits": 3, "higher_is_better": false, "missing": "no c"},
        ]));
        let found = found.unwrap();
        assert_eq!((found[0].higher_is_better, found[1].higher_is_better), (None, Some(false)));
        assert_eq!(found[1].missing.as_deref(), Some("no c"));
        let scores = json!({"a": {"b": 2.34}, "c": "none"});
        assert_eq!(
            found[0].value_in(&scores).map(|value| found[0].format_value(value)),
            Some("2.3".to_owned())
        );
        assert_eq!(found[1].value_in(&scores), None);
        assert_eq!(read_figures(json!([{"path": "a"}])), None);
    }

    #[test]
    fn an_unreadable_file_is_named_in_the_error() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(METRICS_FILE);
        let prefix = format!("{}: ", file.display());
        let problem = || AnyMetrics::read(folder.path()).unwrap_err().to_string();
        assert!(problem().starts_with(&prefix), "{}", problem());
        std::fs::write(&file, "{").unwrap();
        assert!(problem().starts_with(&prefix), "{}", problem());
        std::fs::write(&file, r#"{"mean": {"psnr": 30.5}}"#).unwrap();
        assert_eq!(AnyMetrics::read(folder.path()).unwrap().mean(), &json!({"psnr": 30.5}));
    }
}
