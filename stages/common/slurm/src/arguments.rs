//! What `sbatch` is told.

use std::ffi::OsString;
use std::path::Path;

use crate::resources::Resources;
use crate::site::Site;

/// Longer names make the queue's table unreadable.
const LONGEST_NAME: usize = 100;

/// One job, as it is asked for.
pub(crate) struct Order<'a> {
    pub(crate) name: &'a str,
    pub(crate) resources: &'a Resources,
    pub(crate) site: &'a Site,
    /// Jobs that must have ended well.
    pub(crate) after: &'a [&'a str],
    /// Where it runs.
    pub(crate) folder: &'a Path,
    pub(crate) log: &'a Path,
    pub(crate) script: &'a Path,
    pub(crate) number: usize,
}

impl Order<'_> {
    pub(crate) fn arguments(&self) -> Vec<OsString> {
        let Self { resources, site, .. } = self;
        let name: String = self
            .name
            .chars()
            .map(|c| if c.is_control() { ' ' } else { c })
            .take(LONGEST_NAME)
            .collect();
        let mut words: Vec<OsString> =
            ["--parsable", "--nodes=1", "--ntasks=1", "--requeue", "--open-mode=append"]
                .map(OsString::from)
                .into();
        words.push(pair("--job-name", name));
        words.push(pair("--chdir", self.folder));
        words.push(pair("--output", verbatim(self.log)));
        words.push(pair("--signal", format!("B:USR1@{}", site.notice.seconds)));
        let numbers = [
            ("--cpus-per-task", resources.cpus.map(|n| n.to_string())),
            ("--mem", resources.mem.map(|memory| format!("{}M", memory.mib))),
            ("--gres", resources.gpus.filter(|&n| n > 0).map(|n| format!("gpu:{n}"))),
            ("--time", resources.time.map(|time| time.minutes().to_string())),
        ];
        let places =
            [("--partition", &site.partition), ("--account", &site.account), ("--qos", &site.qos)];
        let given = numbers.into_iter().chain(places.map(|(name, value)| (name, value.clone())));
        words.extend(given.filter_map(|(name, value)| Some(pair(name, value?))));
        if !self.after.is_empty() {
            words.push(pair("--dependency", format!("afterok:{}", self.after.join(":"))));
            words.push("--kill-on-invalid-dep=yes".into());
        }
        // The site's own come last, so that they win.
        words.extend(site.arguments.iter().map(OsString::from));
        words.push(self.script.into());
        words.push(self.number.to_string().into());
        words
    }
}

fn pair(name: &str, value: impl AsRef<std::ffi::OsStr>) -> OsString {
    let mut word = OsString::from(name);
    word.push("=");
    word.push(value);
    word
}

/// A log's path in which Slurm replaces nothing: `%` begins a pattern.
fn verbatim(path: &Path) -> OsString {
    use std::os::unix::ffi::{OsStrExt as _, OsStringExt as _};
    let bytes = path.as_os_str().as_bytes().iter();
    OsString::from_vec(
        bytes.flat_map(|&b| if b == b'%' { vec![b'%', b'%'] } else { vec![b] }).collect(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(resources: &str, site: &str, after: &[&str]) -> String {
        let resources: Resources = serde_yaml::from_str(resources).unwrap();
        let site: Site = serde_yaml::from_str(site).unwrap();
        let order = Order {
            name: "train-ss [supersample=2]",
            resources: &resources,
            site: &site,
            after,
            folder: Path::new("/work"),
            log: Path::new("/s/50%/7.log"),
            script: Path::new("/s/job.sh"),
            number: 7,
        };
        let words: Vec<String> =
            order.arguments().into_iter().map(|word| word.into_string().unwrap()).collect();
        words.join("|")
    }

    const BEFORE: &str = "--parsable|--nodes=1|--ntasks=1|--requeue|--open-mode=append|\
        --job-name=train-ss [supersample=2]|--chdir=/work|--output=/s/50%%/7.log|\
        --signal=B:USR1@90";

    #[test]
    fn each_wish_is_an_argument() {
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
            assert_eq!(words(resources, site, after), format!("{BEFORE}{expected}|/s/job.sh|7"));
        }
    }
}
