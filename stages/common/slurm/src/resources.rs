use std::num::NonZeroU32;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::amounts::{Memory, Period};

/// What a stage needs of a machine. It changes no result and is in no key; a GPU does change the
/// device.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Resources {
    /// Cores, and as many threads.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<NonZeroU32>,
    /// Memory: `512M`, `8G`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub mem: Option<Memory>,
    /// GPUs; with one or more the stage computes on `cuda:0`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gpus: Option<u32>,
    /// The longest that it may take: `30m`, `2h`, `1d12h`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub time: Option<Period>,
}

impl Resources {
    /// These, where another doesn't say otherwise.
    #[must_use]
    pub fn changed(&self, by: &Self) -> Self {
        Self {
            cpus: by.cpus.or(self.cpus),
            mem: by.mem.or(self.mem),
            gpus: by.gpus.or(self.gpus),
            time: by.time.or(self.time),
        }
    }

    /// Whether it computes on a GPU.
    pub fn has_gpu(&self) -> bool {
        self.gpus.unwrap_or(0) > 0
    }

    /// Whether nothing is said.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_says_what_it_wants_otherwise() {
        let read = |text: &str| serde_yaml::from_str::<Resources>(text).unwrap();
        let both =
            read("{cpus: 4, mem: 8G, gpus: 1}").changed(&read("{cpus: 8, gpus: 0, time: 2h}"));
        assert_eq!(both, read("{cpus: 8, mem: 8G, gpus: 0, time: 2h}"));
        assert!(!both.has_gpu() && read("gpus: 2").has_gpu() && !Resources::default().has_gpu());
        let text = serde_json::to_string(&both).unwrap();
        assert_eq!(text, r#"{"cpus":8,"mem":"8G","gpus":0,"time":"2h"}"#);
        assert_eq!(serde_json::from_str::<Resources>(&text).unwrap(), both);
    }

    #[test]
    fn what_is_no_resource_is_refused_in_one_line() {
        for (text, words) in [
            ("mem: 8", "mem: \"8\" is no amount of memory"),
            ("time: 90", "time: \"90\" is no time"),
            ("time: 1.5", "time: \"1.5\" is no time"),
            ("time: [2h]", "a number with its unit"),
            ("cpus: 0", "cpus: invalid value: integer `0`"),
            ("gpus: -1", "gpus: invalid type: integer `-1`"),
            ("cores: 4", "unknown field `cores`, expected one of `cpus`, `mem`, `gpus`, `time`"),
        ] {
            let problem = serde_yaml::from_str::<Resources>(text).unwrap_err().to_string();
            assert!(problem.contains(words) && !problem.contains('\n'), "{text}: {problem}");
        }
    }
}
