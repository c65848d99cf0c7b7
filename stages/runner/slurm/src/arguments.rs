//! Arguments of `sbatch`.

use std::ffi::{OsStr, OsString};
use std::os::unix::ffi::{OsStrExt as _, OsStringExt as _};
use std::path::Path;

use crate::resources::Resources;
use crate::site::Site;

/// Maximum length of a job's name in characters, so that `squeue`'s table stays readable; chosen by
/// hand.
const MAX_NAME_CHARS: usize = 100;

/// One job to submit.
pub(crate) struct JobRequest<'a> {
    pub(crate) name: &'a str,
    pub(crate) resources: &'a Resources,
    pub(crate) site: &'a Site,
    /// Jobs that must succeed first.
    pub(crate) after: &'a [&'a str],
    /// Working directory.
    pub(crate) working_folder: &'a Path,
    pub(crate) log: &'a Path,
    pub(crate) script: &'a Path,
    /// Index of the task, passed to the script.
    pub(crate) number: usize,
}

impl JobRequest<'_> {
    /// Returns the arguments of `sbatch`. The site's own come last, so that they win.
    pub(crate) fn arguments(&self) -> Vec<OsString> {
        let Self { resources, site, .. } = self;
        let printable = self.name.chars().map(|c| if c.is_control() { ' ' } else { c });
        let name: String = printable.take(MAX_NAME_CHARS).collect();
        let mut arguments: Vec<OsString> =
            ["--parsable", "--nodes=1", "--ntasks=1", "--requeue", "--open-mode=append"]
                .map(OsString::from)
                .into();
        arguments.push(option("--job-name", name));
        arguments.push(option("--chdir", self.working_folder));
        arguments.push(option("--output", escape_patterns(self.log)));
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
        if !self.after.is_empty() {
            arguments.push(option("--dependency", format!("afterok:{}", self.after.join(":"))));
            arguments.push("--kill-on-invalid-dep=yes".into());
        }
        arguments.extend(site.arguments.iter().map(OsString::from));
        arguments.push(self.script.into());
        arguments.push(self.number.to_string().into());
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
    let mut escaped = Vec::new();
    for &byte in path.as_os_str().as_bytes() {
        escaped.push(byte);
        if byte == b'%' {
            escaped.push(byte);
        }
    }
    OsString::from_vec(escaped)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn joined_arguments(resources: &str, site: &str, after: &[&str]) -> String {
        let resources: Resources = serde_yaml::from_str(resources).unwrap();
        let site: Site = serde_yaml::from_str(site).unwrap();
        let job = JobRequest {
            name: "train-ss [supersample=2]",
            resources: &resources,
            site: &site,
            after,
            working_folder: Path::new("/work"),
            log: Path::new("/s/50%/7.log"),
            script: Path::new("/s/job.sh"),
            number: 7,
        };
        let arguments: Vec<String> =
            job.arguments().into_iter().map(|argument| argument.into_string().unwrap()).collect();
        arguments.join("|")
    }

    const COMMON: &str = "--parsable|--nodes=1|--ntasks=1|--requeue|--open-mode=append|\
        --job-name=train-ss [supersample=2]|--chdir=/work|--output=/s/50%%/7.log|\
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
                format!("{COMMON}{expected}|/s/job.sh|7")
            );
        }
    }
}
