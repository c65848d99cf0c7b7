//! Folders as people have them, after public reports on other programs: what `prep` reads, assumes
//! and refuses. A subject is a module with a table of its cases.

mod images;
mod kit;
mod lenses;
mod masks;
mod names;
mod nearby;
mod reduced;
mod splits;

use kit::Case;

/// Tables of cases, one a subject.
const SUBJECTS: &[fn() -> Vec<Case>] = &[
    names::cases,
    reduced::cases,
    splits::cases,
    masks::cases,
    lenses::cases,
    images::cases,
    nearby::cases,
];

#[test]
fn folders_as_people_have_them() {
    let mut failures = Vec::new();
    for case in SUBJECTS.iter().flat_map(|cases| cases()) {
        failures.extend(case.failure().map(|failure| format!("{}: {failure}", case.name)));
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}
