//! Counts of stages, as people say them.

use artifact::counted;

/// After a run: how many of all stages ran.
pub(crate) fn ran(ran: usize, all: usize) -> String {
    let cached = all - ran;
    format!("{ran} of {} ran, {cached} {} cached", counted(all, "stage"), were(cached))
}

/// After a run that had nothing to do.
pub(crate) fn all_cached(all: usize) -> String {
    match all {
        1 => "nothing to run: the stage is cached".to_owned(),
        all => format!("nothing to run: all {all} stages are cached"),
    }
}

/// After a failure: how many stages were left out because of it; nothing for none.
pub(crate) fn left_out(count: usize) -> Option<String> {
    (count > 0).then(|| format!("{} {} not run", counted(count, "stage"), were(count)))
}

fn were(count: usize) -> &'static str {
    if count == 1 { "was" } else { "were" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_not_many() {
        assert_eq!(ran(4, 5), "4 of 5 stages ran, 1 was cached");
        assert_eq!(ran(1, 1), "1 of 1 stage ran, 0 were cached");
        assert_eq!(all_cached(1), "nothing to run: the stage is cached");
        assert_eq!(all_cached(5), "nothing to run: all 5 stages are cached");
        assert_eq!(
            [0, 1, 2].map(left_out),
            [None, Some("1 stage was not run".into()), Some("2 stages were not run".into())]
        );
    }
}
