//! Names in pipeline files as they were, and what they are called now: whoever writes an old one is
//! told the new one.

use artifact::known_names;

/// Targets and other blocks.
pub(crate) const BLOCKS: [(&str, &str); 18] = [
    ("enlarged", "sisr-fuse"),
    ("eval-enlarged", "eval-sisr"),
    ("eval-joined", "eval-finetuned"),
    ("eval-located", "eval-registered"),
    ("eval-referenced", "eval-reference"),
    ("joined", "hr-finetune"),
    ("joined-views", "finetuned-views"),
    ("locate", "register"),
    ("located", "registered"),
    ("located-views", "registered-views"),
    ("published", "paper-refine"),
    ("referenced", "reference-refine"),
    ("refine-enlarged", "refine-sisr"),
    ("refine-referenced", "refine-reference"),
    ("rehearsal-field", "downscaled-field"),
    ("rehearsal-views", "downscaled-views"),
    ("train-joined", "finetuned-field"),
    ("train-referenced", "train-reference"),
];

/// Folders of artifacts: the one that makes them, the old name, the new one.
pub(crate) const SUBTREES: [(&str, &str, &str); 1] = [("prep", "rehearsal", "downscaled")];

/// Keys of a block.
pub(crate) const WORDS: [(&str, &str); 1] = [("like", "extends")];

/// What to say after the name of a block that isn't there.
pub fn known_blocks<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    match BLOCKS.iter().find(|(old, _)| *old == name) {
        Some((_, new)) => format!("it is called {new} now"),
        None => known_names(name, known),
    }
}

/// What to say after the name of a folder that an artifact doesn't have.
pub(crate) fn known_subtrees<'a>(
    program: &str,
    name: &str,
    known: impl IntoIterator<Item = &'a str>,
) -> String {
    match SUBTREES.iter().find(|(of, old, _)| (*of, *old) == (program, name)) {
        Some((_, _, new)) => format!("it is called {new} now"),
        None => known_names(name, known),
    }
}
