use std::collections::BTreeMap;
use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// The artifact a stage makes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// Its kind.
    pub kind: String,
    /// Folders of it that an input may name (`prep/train`), with their kinds.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub subtrees: BTreeMap<String, String>,
    /// A JSON file of it whose entry `resolved` has, by name, the values in use of parameters whose
    /// default depends on the inputs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resolved: Option<String>,
}

impl Output {
    /// An output without subtrees.
    pub fn kind(kind: &str) -> Self {
        Self { kind: kind.to_owned(), subtrees: BTreeMap::new(), resolved: None }
    }

    /// Adds a folder that an input may name.
    #[must_use]
    pub fn with_subtree(mut self, folder: &str, kind: &str) -> Self {
        self.subtrees.insert(folder.to_owned(), kind.to_owned());
        self
    }

    /// Names the file that has the values in use of parameters whose default depends on the inputs.
    #[must_use]
    pub fn with_resolved(mut self, file: &str) -> Self {
        self.resolved = Some(file.to_owned());
        self
    }

    /// The values in use that a finished artifact records, by the parameters' names.
    pub fn resolved(&self, artifact: &Path) -> Map<String, Value> {
        let bytes = self.resolved.as_ref().and_then(|file| std::fs::read(artifact.join(file)).ok());
        // An artifact of an older build has none.
        let file: Option<Value> = bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        file.and_then(|file| file.get("resolved")?.as_object().cloned()).unwrap_or_default()
    }
}
