use std::fmt::Display;
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

use artifact::{Damage, format_count, print_line};
use indicatif::{ProgressBar, ProgressStyle};
use store::{Entered, Store, StoreError};

use crate::publish::exists;
use crate::waiting::enter_store;

/// Reads all artifacts and records, and compares their contents with their hashes.
pub(crate) fn verify(store: &Store, remove: bool) -> anyhow::Result<ExitCode> {
    for path in store.foreign_entries()? {
        print_line!("{}: not an artifact, ignored; move it elsewhere", path.display());
    }
    let mut objects = Vec::new();
    for object in store.objects()? {
        let bytes = store.manifest(&object).map_or(0, |manifest| manifest.size());
        objects.push((object, bytes));
    }
    let bar = new_progress_bar(objects.iter().map(|(_, bytes)| bytes).sum());
    let mut verification = Verification { store, remove, bar: &bar, tally: Tally::default() };
    for (object, bytes) in &objects {
        verification.check_object(object)?;
        bar.inc(*bytes);
    }
    for key in store.action_keys()? {
        verification.check_record(&key)?;
    }
    bar.finish_and_clear();
    Ok(verification.tally.print())
}

/// A verification in progress.
struct Verification<'a> {
    store: &'a Store,
    /// True if damaged artifacts and records are removed.
    remove: bool,
    bar: &'a ProgressBar,
    tally: Tally,
}

/// Numbers of artifacts and records by result.
#[derive(Default)]
struct Tally {
    artifacts: usize,
    damaged_artifacts: usize,
    damaged_records: usize,
    unreadable: usize,
}

impl Verification<'_> {
    /// Hashes an object again. Garbage collection may delete the object meanwhile, so a problem
    /// counts only if the object still exists after entering the store.
    fn check_object(&mut self, identity: &str) -> anyhow::Result<()> {
        let mut result = self.store.verify(identity);
        // Garbage collection waits as long as this exists.
        let entered = if result.is_err() { Some(self.enter()?) } else { None };
        if entered.is_some() {
            if matches!(exists(&self.store.object(identity)), Ok(false)) {
                return Ok(());
            }
            result = self.store.verify(identity);
        }
        self.tally.artifacts += 1;
        let Err(problem) = result else { return Ok(()) };
        self.print(&problem);
        if matches!(problem, Damage::Unreadable { .. }) {
            self.tally.unreadable += 1;
            return Ok(());
        }
        self.tally.damaged_artifacts += 1;
        if self.remove {
            self.store.remove_object(identity)?;
            self.print(&REMOVED_NOTE);
        }
        Ok(())
    }

    /// Reads the record of a key. A run may rewrite the record meanwhile, so a problem counts only
    /// if it remains after entering the store.
    fn check_record(&mut self, key: &str) -> anyhow::Result<()> {
        if self.store.undamaged_record(key).is_ok() {
            return Ok(());
        }
        let _entered = self.enter()?;
        let Err(problem) = self.store.undamaged_record(key) else { return Ok(()) };
        self.print(&problem);
        if !matches!(problem, StoreError::Content { .. }) {
            self.tally.unreadable += 1;
            return Ok(());
        }
        self.tally.damaged_records += 1;
        if self.remove {
            self.store.remove_record(key)?;
            self.print(&REMOVED_NOTE);
        }
        Ok(())
    }

    /// Enters the store. This fails if a newer version of nerf-sr has upgraded the store meanwhile:
    /// content that looks damaged to this version may then be intact. A signal ends the process.
    fn enter(&self) -> anyhow::Result<Entered> {
        enter_store(self.store, &AtomicBool::new(false), &|text| self.print(&text))
    }

    fn print(&self, line: &dyn Display) {
        self.bar.suspend(|| print_line!("{line}"));
    }
}

impl Tally {
    /// Prints the numbers. The exit code is 3, that of `Failure::BadInput`, if anything is damaged
    /// or unreadable.
    fn print(&self) -> ExitCode {
        let Self { artifacts, damaged_artifacts, damaged_records, unreadable } = *self;
        let mut line =
            format!("{}, {damaged_artifacts} damaged", format_count(artifacts, "artifact"));
        if damaged_records > 0 {
            line += &format!(", {} damaged", format_count(damaged_records, "record"));
        }
        if unreadable > 0 {
            line += &format!(", {unreadable} unreadable");
        }
        print_line!("{line}");
        let is_sound = damaged_artifacts + damaged_records + unreadable == 0;
        if is_sound { ExitCode::SUCCESS } else { ExitCode::from(3) }
    }
}

const REMOVED_NOTE: &str = "  removed; the next run creates it again";

/// Creates a progress bar, which is visible only on a terminal.
fn new_progress_bar(bytes: u64) -> ProgressBar {
    let style =
        ProgressStyle::with_template("reading [{bar:30}] {bytes} of {total_bytes}, {eta} left");
    ProgressBar::new(bytes)
        .with_style(style.expect("the template is constant").progress_chars("=> "))
}
