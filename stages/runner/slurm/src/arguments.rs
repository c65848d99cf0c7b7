//! Arguments of `sbatch`.

use std::ffi::{OsStr, OsString};
use std::os::unix::ffi::{OsStrExt as _, OsStringExt as _};
use std::path::Path;

use crate::site::Site;
use crate::submission::{Submission, Task};

/// Maximum length of a job's name in characters, so that `squeue`'s table stays readable; chosen by
/// hand.
const MAX_NAME_CHARS: usize = 100;

impl Submission {
    /// Returns the arguments of `sbatch` for a task's job. `after` are the IDs of jobs that must
    /// succeed first. The site's own arguments come last, so that they win.
    pub(crate) fn arguments(
        &self,
        number: usize,
        site: &Site,
        after: &[&str],
        working_folder: &Path,
    ) -> Vec<OsString> {
        let Task { label, resources, .. } = &self.tasks[number];
        let printable = label.chars().map(|c| if c.is_control() { ' ' } else { c });
        let name: String = printable.take(MAX_NAME_CHARS).collect();
        let mut arguments: Vec<OsString> =
            ["--parsable", "--nodes=1", "--ntasks=1", "--requeue", "--open-mode=append"]
                .map(OsString::from)
                .into();
        arguments.push(option("--job-name", name));
        arguments.push(option("--chdir", working_folder));
        arguments.push(option("--output", escape_patterns(&self.log_path(number))));
        arguments.push(option("--signal", format!("B:USR1@{}", site.notice.seconds)));
        let optional = [
            ("--cpus-per-task", resources.cpus.map(|n| n.to_string())),
            ("--mem", resources.mem.map(|memory| format!("{}M", memory.mib))),
            ("--gres", resources.gpus.filter(|&n| n > 0).map(|n| format!("gpu:{n}"))),
            ("--time", resources.time.map(|time| time.minutes().to_string())),
            ("--partition", site.partition.clone()),
            ("--account", site.account.clone()),
            ("--qos", site.qos.clone()),
        ];
        for (name, value) in optional {
            arguments.extend(value.map(|value| option(name, value)));
        }
        if !after.is_empty() {
            arguments.push(option("--dependency", format!("afterok:{}", after.join(":"))));
            arguments.push("--kill-on-invalid-dep=yes".into());
        }
        arguments.extend(site.arguments.iter().map(OsString::from));
        arguments.push(self.script_path().into());
        arguments.push(number.to_string().into());
        arguments
    }
}

/// Returns `NAME=VALUE`.
fn option(name: &str, value: impl AsRef<OsStr>) -> OsString {
    let mut argument = OsString::from(name);
    argument.push("=");
    argument.push(value);
    argument
}

/// Doubles each `%` of a log's path, which Slurm would read as a filename pattern.
fn escape_patterns(path: &Path) -> OsString {
    let parts: Vec<&[u8]> = path.as_os_str().as_bytes().split(|&byte| byte == b'%').collect();
    OsString::from_vec(parts.join(&b"%%"[..]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn joined_arguments(resources: &str, site: &str, after: &[&str]) -> String {
        let task = Task {
            label: "train-ss [supersample=2]".to_owned(),
            resources: serde_yaml::from_str(resources).unwrap(),
            ..Task::default()
        };
        let site: Site = serde_yaml::from_str(site).unwrap();
        let submission = Submission::new(Path::new("/s/50%"), "a", vec![Task::default(), task]);
        let arguments: Vec<String> = submission
            .arguments(1, &site, after, Path::new("/work"))
            .into_iter()
            .map(|argument| argument.into_string().unwrap())
            .collect();
        arguments.join("|")
    }

    const COMMON: &str = "--parsable|--nodes=1|--ntasks=1|--requeue|--open-mode=append|\
        --job-name=train-ss [supersample=2]|--chdir=/work|--output=/s/50%%/slurm/a/1.log|\
        --signal=B:USR1@90";

    #[test]
    fn each_request_is_an_argument() {
        for (resources, site, after, expected) in [
            ("{}", "{}", &[][..], ""),
            (
                "{cpus: 4, mem: 8G, gpus: 1, time: 2h}",
                "{}",
                &[],
                "|--cpus-per-task=4|--mem=8192M|--gres=gpu:1|--time=120",
            ),
            ("{gpus: 0, time: 61s}", "{}", &[], "|--time=2"),
            ("{}", "{partition: a, account: b, qos: c}", &[], "|--partition=a|--account=b|--qos=c"),
            ("{}", "{}", &["5", "6"], "|--dependency=afterok:5:6|--kill-on-invalid-dep=yes"),
            (
                "{time: 1h}",
                "{arguments: [--exclusive, --time=5]}",
                &["5"],
                "|--time=60|--dependency=afterok:5|--kill-on-invalid-dep=yes|--exclusive|--time=5",
            ),
        ] {
            assert_eq!(
                joined_arguments(resources, site, after),
                format!("{COMMON}{expected}|/s/50%/slurm/a/job.sh|1")
            );
        }
    }
}
