/// What `--device` can't be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("--device {0}: no such device; cpu, cuda or cuda:N is expected")]
pub struct DeviceError(String);

/// Checks what `--device` was given: `cpu`, `cuda` or `cuda:N`. Whether there is such a GPU is for
/// who computes to say.
pub fn check_device(name: &str) -> Result<(), DeviceError> {
    if ["cpu", "cuda"].contains(&name) || name.strip_prefix("cuda:").is_some_and(is_number) {
        return Ok(());
    }
    Err(DeviceError(name.to_owned()))
}

fn is_number(index: &str) -> bool {
    !index.is_empty() && index.len() <= 4 && index.bytes().all(|b| b.is_ascii_digit())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cpu_and_numbered_gpus_alone() {
        for name in ["cpu", "cuda", "cuda:0", "cuda:12"] {
            assert!(check_device(name).is_ok(), "{name}");
        }
        for name in ["", "gpu", "CPU", "cuda:", "cuda:x", "cuda:-1", "cuda:99999", "cuda0", "cpu:0"]
        {
            assert!(check_device(name).is_err(), "{name}");
        }
    }
}
