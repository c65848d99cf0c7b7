//! Folders like those in public reports on other programs: `prep` reads each folder, with notes on
//! its assumptions, or refuses the folder. Each subject is a module with a table of cases.

mod images;
mod kit;
mod lenses;
mod masks;
mod names;
mod nearby;
mod reduced;
mod splits;

use kit::Case;

/// Tables of cases, one per subject.
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
fn folders_of_users_are_read_or_refused() {
    let mut failures = Vec::new();
    for case in SUBJECTS.iter().flat_map(|cases| cases()) {
        failures.extend(case.failure().map(|failure| format!("{}: {failure}", case.name)));
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}
