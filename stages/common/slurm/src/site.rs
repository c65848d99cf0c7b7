use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::amounts::Period;
use crate::error::SlurmError;
use crate::resources::Resources;

/// What a cluster wants that is no pipeline's affair: it stands outside of it, and outside every
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
    /// Further arguments of `sbatch`.
    pub arguments: Vec<String>,
    /// Lines of the job's script that come before the stage, such as `module load cuda`.
    pub setup: Vec<String>,
    /// Most jobs of a store that are in the queue at once.
    pub max_submit: usize,
    /// So long before its time is up a job is told, so that its stage leaves a checkpoint.
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
            max_submit: 1000,
            notice: Period { seconds: 90 },
        }
    }
}

/// Slurm takes no longer notice.
const LONGEST_NOTICE: u64 = 65_535;

impl Site {
    /// The site of a file; without one that of `~/.config/nerf-sr/slurm.yaml`, where that is.
    pub fn find(file: Option<&Path>) -> Result<Self, SlurmError> {
        if let Some(file) = file {
            return Self::read(file);
        }
        let usual = std::env::var_os("HOME")
            .map(|home| PathBuf::from(home).join(".config/nerf-sr/slurm.yaml"));
        usual
            .filter(|file| file.exists())
            .map_or_else(|| Ok(Self::default()), |file| Self::read(&file))
    }

    /// Why a job with these resources could never get anywhere.
    pub fn problem(&self, resources: &Resources) -> Option<String> {
        let time = resources.time.filter(|time| time.seconds <= self.notice.seconds)?;
        Some(format!(
            "resources: time: {time} is no longer than the site's notice of {}; give it more",
            self.notice
        ))
    }

    fn read(path: &Path) -> Result<Self, SlurmError> {
        let text = std::fs::read_to_string(path).map_err(|e| SlurmError::file(path, e))?;
        if text.lines().all(|line| line.trim().is_empty() || line.trim_start().starts_with('#')) {
            return Ok(Self::default());
        }
        let site: Self = serde_yaml::from_str(&text).map_err(|e| SlurmError::file(path, e))?;
        if site.notice.seconds > LONGEST_NOTICE {
            return Err(SlurmError::file(
                path,
                format!("notice: {} is too long; Slurm takes at most 18h", site.notice),
            ));
        }
        Ok(site)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn site_of(file: &Path, text: &str) -> Result<Site, SlurmError> {
        std::fs::write(file, text).unwrap();
        Site::find(Some(file))
    }

    #[test]
    fn a_site_is_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("slurm.yaml");
        assert_eq!(site_of(&file, "# nothing yet\n").unwrap(), Site::default());
        let site = site_of(
            &file,
            "partition: gpu\nsetup: [module load cuda]\narguments: \
                [--exclusive]\nmax_submit: 5\nnotice: 5m\n",
        )
        .unwrap();
        assert_eq!(
            (site.partition.as_deref(), site.max_submit, site.notice.seconds),
            (Some("gpu"), 5, 300)
        );
        let problem =
            |time: &str| site.problem(&serde_yaml::from_str(&format!("time: {time}")).unwrap());
        assert!(
            problem("6m").is_none() && problem("5m").unwrap().contains("the site's notice of 5m")
        );
        for (text, words) in [
            ("partitions: gpu", "unknown field `partitions`"),
            ("notice: 90", "notice: \"90\" is no time"),
            ("notice: 1d", "at most 18h"),
            ("setup: module load cuda", "setup: invalid type"),
        ] {
            let problem = site_of(&file, text).unwrap_err().to_string();
            assert!(problem.contains(words) && problem.contains("slurm.yaml"), "{problem}");
        }
        assert!(
            Site::find(Some(&folder.path().join("none")))
                .unwrap_err()
                .to_string()
                .contains("No such file")
        );
    }
}
