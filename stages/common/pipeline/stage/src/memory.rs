use artifact::{Failure, format_size};
use sysinfo::{MemoryRefreshKind, System};

/// Phrases of allocators before the requested amount: Rust, libtorch, CUDA and NumPy.
const PHRASES_WITH_AMOUNT: [&str; 4] =
    ["memory allocation of ", "tried to allocate ", "Tried to allocate ", "Unable to allocate "];
/// Phrases without an amount: C++, libtorch, the system (failed call, failed load of a library),
/// Python and CUDA.
const PHRASES_WITHOUT_AMOUNT: [&str; 7] = [
    "std::bad_alloc",
    "can't allocate memory",
    "Cannot allocate memory",
    "failed to map segment from shared object",
    "MemoryError",
    "CUDA error: out of memory",
    "CUBLAS_STATUS_ALLOC_FAILED",
];

/// Translates an allocator's message to one with the requested amount, if known, and a remedy;
/// `None` if the text is not about exhausted memory.
///
/// ```
/// let text = "memory allocation of 99532800 bytes failed";
/// let message = stage::out_of_memory_message(text).unwrap();
/// assert!(message.starts_with("out of memory: 99.5 MB more were requested;"));
/// assert_eq!(stage::out_of_memory_message("lost memory of it"), None);
/// ```
pub fn out_of_memory_message(text: &str) -> Option<String> {
    let amount = PHRASES_WITH_AMOUNT.iter().find_map(|p| leading_amount(text.split_once(p)?.1));
    match amount {
        Some(amount) => {
            Some(format!("out of memory: {amount} more were requested; {MEMORY_REMEDY}"))
        }
        None if PHRASES_WITHOUT_AMOUNT.iter().any(|phrase| text.contains(phrase)) => {
            Some(format!("out of memory; {MEMORY_REMEDY}"))
        }
        None => None,
    }
}

/// Returns the memory of this machine in bytes, or its container's limit if lower; `None` if
/// unknown.
pub fn machine_memory() -> Option<u64> {
    let system = measure_memory()?;
    Some(system.cgroup_limits().map_or(system.total_memory(), |limits| limits.total_memory))
}

/// Environment variable that limits a stage's memory, in bytes.
pub const MEMORY_VARIABLE: &str = "NERF_SR_MEMORY";

/// Returns the memory in bytes that a stage may use: the free memory of this machine and its
/// container, limited by [`MEMORY_VARIABLE`]; `None` if neither is known.
pub fn available_memory() -> Result<Option<u64>, Failure> {
    let limit = std::env::var(MEMORY_VARIABLE).ok().map(|text| parse_bytes(&text)).transpose()?;
    Ok(free_memory().into_iter().chain(limit).min())
}

fn parse_bytes(text: &str) -> Result<u64, Failure> {
    text.parse().map_err(|_| {
        Failure::Usage(format!(
            "{MEMORY_VARIABLE}: {text:?} is not a number of bytes; for 4 GB write 4000000000"
        ))
    })
}

fn free_memory() -> Option<u64> {
    let system = measure_memory()?;
    let free = system.available_memory();
    Some(
        system
            .cgroup_limits()
            .map_or(free, |limits| free.min(limits.total_memory.saturating_sub(limits.rss))),
    )
}

fn measure_memory() -> Option<System> {
    let mut system = System::new().ok()?;
    system.refresh_memory_specifics(MemoryRefreshKind::nothing().with_ram());
    Some(system)
}

/// Returns the free bytes that remain after `work` has taken `need`; `u64::MAX` if `free` is
/// unknown.
///
/// # Errors
/// [`Failure::Usage`] with both numbers and the remedy if less than `need` is free.
pub fn remaining_memory(
    work: &str,
    need: u64,
    free: Option<u64>,
    remedy: &str,
) -> Result<u64, Failure> {
    let Some(free) = free else { return Ok(u64::MAX) };
    free.checked_sub(need).ok_or_else(|| {
        let (need, free) = (format_size(need), format_size(free));
        Failure::Usage(format!("{work} needs {need} of memory, and {free} are free; {remedy}"))
    })
}

/// Remedy for exhausted memory.
pub const MEMORY_REMEDY: &str = "end other programs, run one stage at a time (`nerf-sr run --jobs \
    1`), or use fewer or smaller images";

/// Parses `99532800 bytes` or `2.00 GiB` at the beginning of a text.
fn leading_amount(text: &str) -> Option<String> {
    let mut words = text.split_whitespace();
    let (number, unit) = (words.next()?, words.next()?.trim_end_matches(['.', ',', ';']));
    match unit {
        "bytes" => Some(format_size(number.parse().ok()?)),
        "KiB" | "MiB" | "GiB" => number.parse::<f64>().ok().map(|_| format!("{number} {unit}")),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn machine_memory_is_plausible() {
        assert!(
            machine_memory().is_some_and(|bytes| (1 << 28..1 << 50).contains(&bytes)),
            "{:?}",
            machine_memory()
        );
    }

    #[test]
    fn some_memory_is_free() {
        let free = free_memory().unwrap();
        assert!(free > 1 << 26 && free <= machine_memory().unwrap(), "{free}");
        assert_eq!(parse_bytes("4000000000").unwrap(), 4_000_000_000);
        let message = parse_bytes("4GB").unwrap_err().to_string();
        assert_eq!(
            message,
            "NERF_SR_MEMORY: \"4GB\" is not a number of bytes; for 4 GB write 4000000000"
        );
    }

    #[test]
    fn work_that_needs_more_than_is_free_is_refused() {
        let remaining = |need, free| remaining_memory("a mesh", need, free, "make it smaller");
        assert_eq!(remaining(3, Some(10)).unwrap(), 7);
        assert_eq!(remaining(3, None).unwrap(), u64::MAX);
        let message = remaining(2_000_000, Some(1_000_000)).unwrap_err().to_string();
        assert_eq!(message, "a mesh needs 2.0 MB of memory, and 1.0 MB are free; make it smaller");
    }

    #[test]
    fn allocation_errors_are_recognised() {
        for (text, amount) in [
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
            let found = out_of_memory_message(text);
            let expected = amount.map(|amount| {
                format!("out of memory: {amount} more were requested; {MEMORY_REMEDY}")
            });
            assert_eq!(found, expected, "{text}");
        }
        for text in [
            "terminate called after throwing an instance of 'std::bad_alloc'",
            "  what():  std::bad_alloc",
            "train-refine: error while loading shared libraries: libtorch_cpu.so: failed to map \
            segment from shared object",
            "MemoryError",
            "cannot fork: Cannot allocate memory (os error 12)",
        ] {
            let expected = format!("out of memory; {MEMORY_REMEDY}");
            assert_eq!(out_of_memory_message(text), Some(expected), "{text}");
        }
    }
}
