use std::num::NonZeroU32;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::amounts::{Memory, Period};

/// Resources that a stage needs. Results and keys don't depend on them, except that a GPU changes
/// the device.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Resources {
    /// Number of cores, and of threads.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<NonZeroU32>,
    /// Memory: `512M`, `8G`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub mem: Option<Memory>,
    /// Number of GPUs; with one or more the stage computes on `cuda:0`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gpus: Option<u32>,
    /// Time limit: `30m`, `2h`, `1d12h`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub time: Option<Period>,
}

impl Resources {
    /// Returns these resources; a value that `other` has replaces this one.
    #[must_use]
    pub fn overridden_by(&self, other: &Self) -> Self {
        Self {
            cpus: other.cpus.or(self.cpus),
            mem: other.mem.or(self.mem),
            gpus: other.gpus.or(self.gpus),
            time: other.time.or(self.time),
        }
    }

    /// True if at least one GPU is required.
    pub fn has_gpu(&self) -> bool {
        self.gpus.unwrap_or(0) > 0
    }

    /// True if no resource is stated.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_overrides_single_resources() {
        let read = |text: &str| serde_yaml::from_str::<Resources>(text).unwrap();
        let merged = read("{cpus: 4, mem: 8G, gpus: 1}")
            .overridden_by(&read("{cpus: 8, gpus: 0, time: 2h}"));
        assert_eq!(merged, read("{cpus: 8, mem: 8G, gpus: 0, time: 2h}"));
        assert!(!merged.has_gpu() && read("gpus: 2").has_gpu() && !Resources::default().has_gpu());
        let text = serde_json::to_string(&merged).unwrap();
        assert_eq!(text, r#"{"cpus":8,"mem":"8G","gpus":0,"time":"2h"}"#);
        assert_eq!(serde_json::from_str::<Resources>(&text).unwrap(), merged);
    }

    #[test]
    fn invalid_resources_are_refused_in_one_line() {
        for (text, expected) in [
            ("mem: 8", "mem: invalid amount of memory \"8\""),
            ("time: 90", "time: invalid duration \"90\""),
            ("time: 1.5", "time: invalid duration \"1.5\""),
            ("time: [2h]", "expected a number with d, h, m or s, such as 2h"),
            ("cpus: 0", "cpus: invalid value: integer `0`"),
            ("gpus: -1", "gpus: invalid type: integer `-1`"),
            ("cores: 4", "unknown field `cores`, expected one of `cpus`, `mem`, `gpus`, `time`"),
        ] {
            let problem = serde_yaml::from_str::<Resources>(text).unwrap_err().to_string();
            assert!(problem.contains(expected) && !problem.contains('\n'), "{text}: {problem}");
        }
    }
}
