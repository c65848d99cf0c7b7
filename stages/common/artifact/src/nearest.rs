/// Names longer than this are no slips of the pen.
const LONGEST_NAME: usize = 64;

/// The known name that an unknown one is a misspelling of: at most one letter in three wrong, left
/// out, added or swapped with the next.
pub fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    if name.len() > LONGEST_NAME {
        return None;
    }
    let lower = name.to_lowercase();
    let distances = known
        .into_iter()
        .map(|candidate| (strsim::osa_distance(&lower, &candidate.to_lowercase()), candidate));
    let closest = distances.min()?;
    let letters = name.chars().count().max(closest.1.chars().count());
    (closest.0 <= (letters / 3).max(1) && letters > 1).then_some(closest.1)
}

/// What to say after an unknown name: the one that may be meant, and all that are known.
pub fn known_names<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    let mut known: Vec<&str> = known.into_iter().collect();
    known.sort_unstable();
    if known.is_empty() {
        return "there are none".to_owned();
    }
    let meant = nearest(name, known.iter().copied())
        .map(|name| format!("did you mean {name}? "))
        .unwrap_or_default();
    format!("{meant}known: {}", known.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slips_are_recognised_and_other_words_are_not() {
        let known = ["eval", "prep", "report", "render-depth", "train-ss"];
        for (name, expected) in [
            ("evla", Some("eval")),
            ("Eval", Some("eval")),
            ("reprot", Some("report")),
            ("render_deph", Some("render-depth")),
            ("trainss", Some("train-ss")),
            ("perp", Some("prep")),
            ("video", None),
            ("nowhere", None),
            ("", None),
            ("x", None),
        ] {
            assert_eq!(nearest(name, known), expected, "{name}");
        }
        assert_eq!(nearest(&"e".repeat(100_000), known), None);
        assert_eq!(nearest("lr", ["hr"]), Some("hr"));
    }

    #[test]
    fn what_is_known_is_listed() {
        assert_eq!(known_names("evla", ["prep", "eval"]), "did you mean eval? known: eval, prep");
        assert_eq!(known_names("nothing", ["prep", "eval"]), "known: eval, prep");
        assert_eq!(known_names("a", []), "there are none");
    }
}
