use artifact::{Failure, sized};
use sysinfo::{MemoryRefreshKind, System};

/// Words of allocators before the amount that they didn't get: of Rust, libtorch, CUDA and NumPy.
const MARKS: [&str; 4] =
    ["memory allocation of ", "tried to allocate ", "Tried to allocate ", "Unable to allocate "];
/// Words that name no amount: of C++, of libtorch, of the system for a call and for a library that
/// is loaded, of Python.
const MARKS_WITHOUT_AMOUNT: [&str; 5] = [
    "std::bad_alloc",
    "can't allocate memory",
    "Cannot allocate memory",
    "failed to map segment from shared object",
    "MemoryError",
];

/// What an allocator's last words mean, with the amount that was asked for, where they name it, and
/// what to do; nothing for other words.
///
/// ```
/// let said = stage::out_of_memory("memory allocation of 99532800 bytes failed").unwrap();
/// assert!(said.starts_with("out of memory: 99.5 MB more were asked for;"));
/// assert_eq!(stage::out_of_memory("lost memory of it"), None);
/// ```
pub fn out_of_memory(text: &str) -> Option<String> {
    let amount = MARKS.iter().find_map(|mark| amount(text.split_once(mark)?.1));
    let amount = amount.map(|amount| format!(": {amount} more were asked for"));
    if amount.is_none() && !MARKS_WITHOUT_AMOUNT.iter().any(|mark| text.contains(mark)) {
        return None;
    }
    Some(format!("out of memory{}; {MEMORY_REMEDY}", amount.unwrap_or_default()))
}

/// Memory of this machine in bytes, or of its container where that has less; none where the system
/// doesn't tell.
pub fn machine_memory() -> Option<u64> {
    let mut system = System::new().ok()?;
    system.refresh_memory_specifics(MemoryRefreshKind::nothing().with_ram());
    Some(system.cgroup_limits().map_or(system.total_memory(), |limits| limits.total_memory))
}

/// The variable that says how many bytes of memory a stage may take.
pub const MEMORY_VARIABLE: &str = "NERF_SR_MEMORY";

/// Bytes of memory that a stage may take: those that are free on this machine and in its container,
/// no more than [`MEMORY_VARIABLE`] says; none where neither is known.
pub fn available_memory() -> Result<Option<u64>, Failure> {
    let most = std::env::var(MEMORY_VARIABLE).ok().map(|text| in_bytes(&text)).transpose()?;
    Ok(free_memory().into_iter().chain(most).min())
}

fn in_bytes(text: &str) -> Result<u64, Failure> {
    text.parse().map_err(|_| {
        Failure::Usage(format!(
            "{MEMORY_VARIABLE}: {text:?} is no number of bytes; for 4 GB write 4000000000"
        ))
    })
}

fn free_memory() -> Option<u64> {
    let mut system = System::new().ok()?;
    system.refresh_memory_specifics(MemoryRefreshKind::nothing().with_ram());
    let container =
        system.cgroup_limits().map(|limits| limits.total_memory.saturating_sub(limits.rss));
    Some(container.map_or(system.available_memory(), |left| left.min(system.available_memory())))
}

/// Returns the free bytes that remain when some work has its `need`; `u64::MAX` if it isn't known
/// how many are free.
///
/// # Errors
/// [`Failure::Usage`] with both numbers and the remedy if fewer are free.
pub fn remaining_memory(
    work: &str,
    need: u64,
    free: Option<u64>,
    remedy: &str,
) -> Result<u64, Failure> {
    let Some(free) = free else { return Ok(u64::MAX) };
    free.checked_sub(need).ok_or_else(|| {
        let (need, free) = (sized(need), sized(free));
        Failure::Usage(format!("{work} needs {need} of memory, and {free} are free; {remedy}"))
    })
}

/// What helps where memory is short.
pub const MEMORY_REMEDY: &str = "end other programs, run one stage at a time (`nerf-sr run --jobs \
    1`), or give it fewer or smaller images";

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
        assert!(
            machine_memory().is_some_and(|bytes| (1 << 28..1 << 50).contains(&bytes)),
            "{:?}",
            machine_memory()
        );
    }

    #[test]
    fn some_of_it_is_free() {
        let free = free_memory().unwrap();
        assert!(free > 1 << 26 && free <= machine_memory().unwrap(), "{free}");
        assert_eq!(in_bytes("4000000000").unwrap(), 4_000_000_000);
        let said = in_bytes("4GB").unwrap_err().to_string();
        assert_eq!(
            said,
            "NERF_SR_MEMORY: \"4GB\" is no number of bytes; for 4 GB write 4000000000"
        );
    }

    #[test]
    fn work_that_needs_more_than_is_free_is_refused() {
        let remaining = |need, free| remaining_memory("a mesh", need, free, "make it smaller");
        assert_eq!(remaining(3, Some(10)).unwrap(), 7);
        assert_eq!(remaining(3, None).unwrap(), u64::MAX);
        let said = remaining(2_000_000, Some(1_000_000)).unwrap_err().to_string();
        assert_eq!(said, "a mesh needs 2.0 MB of memory, and 1.0 MB are free; make it smaller");
    }

    #[test]
    fn allocators_are_understood() {
        for (said, amount) in [
            ("memory allocation of 99532800 bytes failed", Some("99.5 MB")),
            (
                "DefaultCPUAllocator: can't allocate memory: you tried to allocate 4000000000 \
                bytes. Error code 12",
                Some("4.0 GB"),
            ),
            (
                "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity",
                Some("2.00 GiB"),
            ),
            (
                "numpy._core._exceptions._ArrayMemoryError: Unable to allocate 74.5 GiB for an \
                array",
                Some("74.5 GiB"),
            ),
            ("memory allocation of many bytes failed", None),
            ("memory allocation of ", None),
            ("r_0.png: No such file", None),
        ] {
            let found = out_of_memory(said);
            let expected = amount.map(|amount| {
                format!("out of memory: {amount} more were asked for; {MEMORY_REMEDY}")
            });
            assert_eq!(found, expected, "{said}");
        }
        for said in [
            "terminate called after throwing an instance of 'std::bad_alloc'",
            "  what():  std::bad_alloc",
            "train-refine: error while loading shared libraries: libtorch_cpu.so: failed to map \
            segment from shared object",
            "MemoryError",
            "cannot fork: Cannot allocate memory (os error 12)",
        ] {
            let expected = format!("out of memory; {MEMORY_REMEDY}");
            assert_eq!(out_of_memory(said), Some(expected), "{said}");
        }
    }
}
