use std::fs;

/// Environment variables with the number of a Slurm task's or job's processors. Slurm restricts
/// neither affinity nor quota unless its task plugins do.
const SLURM_VARIABLES: [&str; 2] = ["SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE"];

/// Number of processors that this process may use, which is the default number of threads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Processors {
    /// Number of processors, at least 1.
    pub count: usize,
    /// Limit that gives the number, as text: [`ALL_PROCESSORS`], the affinity, the quota, or an
    /// environment variable of Slurm.
    pub limit: &'static str,
}

/// Limit of a process that may use all processors of the machine.
pub const ALL_PROCESSORS: &str = "all processors of this machine";
/// Limit set by `taskset`, a cpuset or a batch system.
const AFFINITY: &str = "the CPU affinity of this process";
/// Limit set by a container; rounded down.
const QUOTA: &str = "the CPU quota of this container or cgroup";

/// Returns the number of processors that this process may use: the machine's, reduced to the CPU
/// affinity, to the CPU quota of the cgroup (versions 1 and 2), and to Slurm's allocation.
///
/// ```
/// let processors = stage::processors();
/// assert!(processors.count >= 1);
/// println!("{} threads: {}", processors.count, processors.limit);
/// ```
pub fn processors() -> Processors {
    let by_affinity_and_quota =
        std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let by_affinity = processors_by_affinity().unwrap_or(by_affinity_and_quota);
    let online = online_processors().unwrap_or(by_affinity);
    let slurm = SLURM_VARIABLES
        .iter()
        .find_map(|&name| Some((name, std::env::var(name).ok()?.parse().ok().filter(|&n| n > 0)?)));
    least_limit(online, by_affinity, by_affinity_and_quota, slurm)
}

/// Returns the least of several numbers of processors, with its limit: online ones, those of the
/// affinity, those of affinity and quota, and those of Slurm.
fn least_limit(
    online: usize,
    by_affinity: usize,
    by_affinity_and_quota: usize,
    slurm: Option<(&'static str, usize)>,
) -> Processors {
    let limit = match slurm {
        Some((limit, count)) if count < by_affinity_and_quota => {
            return Processors { count, limit };
        }
        _ if by_affinity_and_quota < by_affinity => QUOTA,
        _ if by_affinity_and_quota < online => AFFINITY,
        _ => ALL_PROCESSORS,
    };
    Processors { count: by_affinity_and_quota, limit }
}

/// Returns the number of processors in the CPU affinity of this process.
fn processors_by_affinity() -> Option<usize> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    count_listed(status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"))?)
}

/// Returns the number of the machine's processors.
fn online_processors() -> Option<usize> {
    count_listed(&fs::read_to_string("/sys/devices/system/cpu/online").ok()?)
}

/// Counts the numbers of a kernel's list, such as `0-3,8`; `None` if malformed.
fn count_listed(list: &str) -> Option<usize> {
    list.trim().split(',').try_fold(0_usize, |sum, range| {
        let (first, last) = range.split_once('-').unwrap_or((range, range));
        let (first, last): (usize, usize) = (first.parse().ok()?, last.parse().ok()?);
        sum.checked_add(last.checked_sub(first)?.checked_add(1)?)
    })
}

/// Starts rayon's global pool with the given number of threads, unless rayon was used before.
pub fn start_threads(count: usize) {
    rayon::ThreadPoolBuilder::new().num_threads(count).build_global().ok();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processors_in_kernel_lists_are_counted() {
        for (list, count) in [
            ("0\n", Some(1)),
            ("\t0-1\n", Some(2)),
            ("0-3,8,10-11", Some(7)),
            ("", None),
            ("3-1", None),
            ("0-x", None),
            ("0-18446744073709551615", None),
        ] {
            assert_eq!(count_listed(list), count, "{list:?}");
        }
    }

    #[test]
    fn the_least_limit_sets_the_number() {
        let (variable, slurm) = ("SLURM_CPUS_PER_TASK", |n| Some(("SLURM_CPUS_PER_TASK", n)));
        for (online, allowed, available, slurm, count, limit) in [
            (8, 8, 8, None, 8, ALL_PROCESSORS),
            (8, 4, 4, None, 4, AFFINITY),
            (8, 8, 2, None, 2, QUOTA),
            (8, 4, 2, None, 2, QUOTA),
            (8, 8, 8, slurm(3), 3, variable),
            (8, 2, 2, slurm(3), 2, AFFINITY),
            (8, 8, 8, slurm(16), 8, ALL_PROCESSORS),
        ] {
            assert_eq!(least_limit(online, allowed, available, slurm), Processors { count, limit });
        }
    }
}
