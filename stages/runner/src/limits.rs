use artifact::counted;

/// More threads than that for each core only cost memory and time.
const MOST_THREADS_PER_CORE: usize = 4;

/// What is made of a number that an option asks for, and what is to be said where that is less.
pub(crate) fn capped(option: &str, asked: usize, cores: usize) -> (usize, Option<String>) {
    let most = cores.saturating_mul(MOST_THREADS_PER_CORE);
    let said = (asked > most).then(|| {
        let cores = counted(cores, "core");
        format!(
            "nerf-sr: {option} {asked} is more than {cores} can use: {most} it is; the results \
            are the same"
        )
    });
    (asked.min(most), said)
}

#[cfg(test)]
mod tests {
    use super::capped;

    #[test]
    fn only_what_no_machine_could_use_is_lowered() {
        assert_eq!(capped("--jobs", 8, 2), (8, None));
        let (threads, said) = capped("--threads", 1000, 2);
        assert_eq!(threads, 8);
        assert_eq!(
            said.unwrap(),
            "nerf-sr: --threads 1000 is more than 2 cores can use: 8 it is; the results are the \
            same"
        );
    }
}
