use sysinfo::{MemoryRefreshKind, System};

use crate::amounts::sized;

/// How allocators name what they didn't get: that of Rust, of libtorch, of CUDA, and of NumPy.
const MARKS: [&str; 4] = ["memory allocation of ", "tried to allocate ", "Tried to allocate ", "Unable to allocate "];

/// What an allocator's last words mean, with the amount that was asked for and what to do; nothing for other words.
///
/// ```
/// let said = artifact::out_of_memory("memory allocation of 99532800 bytes failed").unwrap();
/// assert!(said.starts_with("out of memory: 99.5 MB more were asked for;"));
/// assert_eq!(artifact::out_of_memory("lost memory of it"), None);
/// ```
pub fn out_of_memory(text: &str) -> Option<String> {
    let amount = MARKS.iter().find_map(|mark| amount(text.split_once(mark)?.1))?;
    Some(format!("out of memory: {amount} more were asked for; {MEMORY_REMEDY}"))
}

/// Memory of this machine in bytes, or of its container where that has less; none where the system doesn't tell.
pub fn machine_memory() -> Option<u64> {
    let mut system = System::new().ok()?;
    system.refresh_memory_specifics(MemoryRefreshKind::nothing().with_ram());
    Some(system.cgroup_limits().map_or(system.total_memory(), |limits| limits.total_memory))
}

/// What helps where memory is short.
pub const MEMORY_REMEDY: &str =
    "end other programs, run one stage at a time (`nerf-sr run --jobs 1`), or give it fewer or smaller images";

/// `99532800 bytes` or `2.00 GiB` at the beginning of a text.
fn amount(text: &str) -> Option<String> {
    let mut words = text.split_whitespace();
    let (number, unit) = (words.next()?, words.next()?.trim_end_matches(['.', ',', ';']));
    match unit {
        "bytes" => Some(sized(number.parse().ok()?)),
        "KiB" | "MiB" | "GiB" => number.parse::<f64>().ok().map(|_| format!("{number} {unit}")),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_has_some_memory() {
        assert!(machine_memory().is_some_and(|bytes| (1 << 28..1 << 50).contains(&bytes)), "{:?}", machine_memory());
    }

    #[test]
    fn allocators_are_understood() {
        for (said, amount) in [
            ("memory allocation of 99532800 bytes failed", Some("99.5 MB")),
            ("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4000000000 bytes. Error code 12", Some("4.0 GB")),
            ("CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity", Some("2.00 GiB")),
            ("numpy._core._exceptions._ArrayMemoryError: Unable to allocate 74.5 GiB for an array", Some("74.5 GiB")),
            ("memory allocation of many bytes failed", None),
            ("memory allocation of ", None),
            ("r_0.png: No such file", None),
        ] {
            let found = out_of_memory(said);
            let expected = amount.map(|amount| format!("out of memory: {amount} more were asked for; {MEMORY_REMEDY}"));
            assert_eq!(found, expected, "{said}");
        }
    }
}
