use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::figure::Figure;

/// The file's name in an artifact of kind `metrics`.
pub const METRICS_FILE: &str = "metrics.json";

/// `metrics.json` of any stage. A stage of somebody's own may leave out any field, or write others.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AnyMetrics(Value);

/// Why a `metrics.json` can't be read.
#[derive(Debug, thiserror::Error)]
pub enum MetricsError {
    /// The file can't be read.
    #[error("{}: {source}", file.display())]
    Io {
        /// The file.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file isn't JSON.
    #[error("{}: {source}", file.display())]
    Json {
        /// The file.
        file: PathBuf,
        /// Why.
        source: serde_json::Error,
    },
}

impl AnyMetrics {
    /// Reads the file of an artifact.
    ///
    /// # Errors
    /// [`MetricsError`] with the file's path. JSON of any form is taken.
    pub fn read(folder: &Path) -> Result<Self, MetricsError> {
        let file = folder.join(METRICS_FILE);
        let bytes = match std::fs::read(&file) {
            Ok(bytes) => bytes,
            Err(source) => return Err(MetricsError::Io { file, source }),
        };
        match serde_json::from_slice(&bytes) {
            Ok(value) => Ok(Self(value)),
            Err(source) => Err(MetricsError::Json { file, source }),
        }
    }

    /// The figures; `None` where the file lists none, or one that isn't a [`Figure`].
    pub fn figures(&self) -> Option<Vec<Figure>> {
        serde_json::from_value(self.0["figures"].clone()).ok()
    }

    /// Names and titles of the pictures that metrics made, by name.
    pub fn picture_titles(&self) -> Vec<(&str, &str)> {
        let titles = self.0["picture_titles"].as_object().into_iter().flatten();
        titles.filter_map(|(name, title)| Some((name.as_str(), title.as_str()?))).collect()
    }

    /// Whether views have HR truth: without it `eval` scores them at LR alone.
    pub fn has_hr_truth(&self) -> bool {
        self.mean()["psnr"].is_number()
    }

    /// Means over the views; null where there are none.
    pub fn mean(&self) -> &Value {
        &self.0["mean"]
    }

    /// The views; empty where the file has no list of them.
    pub fn views(&self) -> &[Value] {
        self.0["views"].as_array().map(Vec::as_slice).unwrap_or_default()
    }

    /// How the figures were made, in words; null where the file doesn't say.
    pub fn conventions(&self) -> &Value {
        &self.0["conventions"]
    }

    /// As [`Metrics::least_gain`](crate::Metrics::least_gain); null where there is none.
    pub fn least_gain(&self) -> &Value {
        &self.0["least_gain"]
    }

    /// As [`Metrics::near_references`](crate::Metrics::near_references); null where there are none.
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

    /// A stage of somebody's own says what it likes.
    #[test]
    fn nothing_has_to_be_there() {
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
        let figures = |figures: Value| AnyMetrics::from(json!({"figures": figures})).figures();
        let found = figures(json!([
            {"path": "a/b", "label": "b", "digits": 1, "colour": "red"},
            {"path": "c", "label": "c", "digits": 3, "higher_is_better": false, "missing": "no c"},
        ]));
        let found = found.unwrap();
        assert_eq!((found[0].higher_is_better, found[1].higher_is_better), (None, Some(false)));
        assert_eq!(found[1].missing.as_deref(), Some("no c"));
        let scores = json!({"a": {"b": 2.34}, "c": "none"});
        assert_eq!(found[0].of(&scores).map(|value| found[0].text(value)), Some("2.3".to_owned()));
        assert_eq!(found[1].of(&scores), None);
        assert_eq!(figures(json!([{"path": "a"}])), None);
    }

    #[test]
    fn a_file_is_named_where_it_cannot_be_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(METRICS_FILE);
        let place = format!("{}: ", file.display());
        let problem = || AnyMetrics::read(folder.path()).unwrap_err().to_string();
        assert!(problem().starts_with(&place), "{}", problem());
        std::fs::write(&file, "{").unwrap();
        assert!(problem().starts_with(&place), "{}", problem());
        std::fs::write(&file, r#"{"mean": {"psnr": 30.5}}"#).unwrap();
        assert_eq!(AnyMetrics::read(folder.path()).unwrap().mean(), &json!({"psnr": 30.5}));
    }
}
