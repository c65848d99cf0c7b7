use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::SlurmError;
use crate::amounts::Period;
use crate::resources::Resources;

/// Settings of a cluster, such as partition and account. They belong to no pipeline and enter no
/// key.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Site {
    /// `sbatch --partition`.
    pub partition: Option<String>,
    /// `sbatch --account`.
    pub account: Option<String>,
    /// `sbatch --qos`.
    pub qos: Option<String>,
    /// Additional arguments of `sbatch`.
    pub arguments: Vec<String>,
    /// Lines of the job's script before the stage, such as `module load cuda`.
    pub setup: Vec<String>,
    /// Maximum number of a store's jobs in the queue.
    pub max_submit: usize,
    /// Time between Slurm's signal and the end of a job, in which the stage writes a checkpoint.
    pub notice: Period,
}

impl Default for Site {
    fn default() -> Self {
        Self {
            partition: None,
            account: None,
            qos: None,
            arguments: Vec::new(),
            setup: Vec::new(),
            // Both chosen by hand.
            max_submit: 1000,
            notice: Period { seconds: 90 },
        }
    }
}

/// Maximum notice in seconds: the limit of `sbatch --signal`.
const MAX_NOTICE_SECONDS: u64 = 65_535;

impl Site {
    /// Reads a site file. Without one, reads `~/.config/nerf-sr/slurm.yaml` if that file exists.
    pub fn find(file: Option<&Path>) -> Result<Self, SlurmError> {
        let default = std::env::var_os("HOME")
            .map(|home| PathBuf::from(home).join(".config/nerf-sr/slurm.yaml"))
            .filter(|file| file.exists());
        file.or(default.as_deref()).map_or_else(|| Ok(Self::default()), Self::read)
    }

    /// Returns why jobs with these resources could never make progress; `None` if they can.
    pub fn problem_with(&self, resources: &Resources) -> Option<String> {
        let time = resources.time.filter(|time| time.seconds <= self.notice.seconds)?;
        Some(format!(
            "resources: time: {time} must be longer than `notice` of the site file, {}",
            self.notice
        ))
    }

    fn read(path: &Path) -> Result<Self, SlurmError> {
        let text = std::fs::read_to_string(path).map_err(|e| SlurmError::file(path, e))?;
        // A file of comments alone would be YAML's null, which is not a mapping.
        if text.lines().all(|line| line.trim().is_empty() || line.trim_start().starts_with('#')) {
            return Ok(Self::default());
        }
        let site: Self = serde_yaml::from_str(&text).map_err(|e| SlurmError::file(path, e))?;
        if site.notice.seconds > MAX_NOTICE_SECONDS {
            let problem = format!("notice: {} is too long; Slurm's maximum is 18h", site.notice);
            return Err(SlurmError::file(path, problem));
        }
        Ok(site)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write_and_find(file: &Path, text: &str) -> Result<Site, SlurmError> {
        std::fs::write(file, text).unwrap();
        Site::find(Some(file))
    }

    #[test]
    fn site_files_are_read_or_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("slurm.yaml");
        assert_eq!(write_and_find(&file, "# nothing yet\n").unwrap(), Site::default());
        let site = write_and_find(
            &file,
            "partition: gpu\nsetup: [module load cuda]\narguments: \
                [--exclusive]\nmax_submit: 5\nnotice: 5m\n",
        )
        .unwrap();
        assert_eq!(
            (site.partition.as_deref(), site.max_submit, site.notice.seconds),
            (Some("gpu"), 5, 300)
        );
        let problem = |time: &str| {
            site.problem_with(&serde_yaml::from_str(&format!("time: {time}")).unwrap())
        };
        assert!(
            problem("6m").is_none()
                && problem("5m").unwrap().contains("`notice` of the site file, 5m")
        );
        for (text, expected) in [
            ("partitions: gpu", "unknown field `partitions`"),
            ("notice: 90", "notice: invalid duration \"90\""),
            ("notice: 1d", "maximum is 18h"),
            ("setup: module load cuda", "setup: invalid type"),
        ] {
            let problem = write_and_find(&file, text).unwrap_err().to_string();
            assert!(problem.contains(expected) && problem.contains("slurm.yaml"), "{problem}");
        }
        assert!(
            Site::find(Some(&folder.path().join("none")))
                .unwrap_err()
                .to_string()
                .contains("No such file")
        );
    }
}
