use std::fmt::Display;
use std::io;
use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

use artifact::{Damage, counted, print_line};
use indicatif::{ProgressBar, ProgressStyle};
use store::{Entered, Store, StoreError};

use crate::waiting::enter;

/// Reads every artifact and every record again.
pub(crate) fn verify(store: &Store, remove: bool) -> anyhow::Result<ExitCode> {
    for path in store.foreign_entries()? {
        print_line!("{}: not an artifact; it is left alone, move it elsewhere", path.display());
    }
    let objects = store.objects()?;
    let sizes: Vec<u64> = objects
        .iter()
        .map(|object| store.manifest(object).map_or(0, |manifest| manifest.size()))
        .collect();
    let bar = bar(sizes.iter().sum());
    let mut verifying = Verifying { store, remove, bar: &bar, tally: Tally::default() };
    for (object, size) in objects.iter().zip(sizes) {
        verifying.object(object)?;
        bar.inc(size);
    }
    for key in store.action_files()? {
        verifying.record(&key)?;
    }
    bar.finish_and_clear();
    Ok(verifying.tally.tell())
}

/// A verification in progress.
struct Verifying<'a> {
    store: &'a Store,
    /// True if damaged artifacts and records are to be removed.
    remove: bool,
    bar: &'a ProgressBar,
    tally: Tally,
}

/// Numbers of artifacts and records, by what was found.
#[derive(Default)]
struct Tally {
    artifacts: usize,
    damaged: usize,
    damaged_records: usize,
    unreadable: usize,
}

impl Verifying<'_> {
    /// Re-hashes an object. Garbage collection may take the object meanwhile, so a problem counts
    /// only if it is there while garbage collection is kept away.
    fn object(&mut self, identity: &str) -> anyhow::Result<()> {
        let store = self.store;
        if store.verify(identity).is_ok() {
            self.tally.artifacts += 1;
            return Ok(());
        }
        let _entered = self.enter()?;
        if is_gone(&store.object(identity)) {
            return Ok(());
        }
        self.tally.artifacts += 1;
        match store.verify(identity) {
            Ok(()) => {}
            Err(problem @ Damage::Unreadable { .. }) => {
                self.tally.unreadable += 1;
                self.say(&problem);
            }
            Err(damage) => {
                self.tally.damaged += 1;
                self.say(&damage);
                if self.remove {
                    store.remove_object(identity)?;
                    self.say(&REMOVED);
                }
            }
        }
        Ok(())
    }

    /// Reads the record of a key.
    fn record(&mut self, key: &str) -> anyhow::Result<()> {
        let Err(problem) = self.store.undamaged_record(key) else { return Ok(()) };
        self.say(&problem);
        if !matches!(problem, StoreError::Content { .. }) {
            self.tally.unreadable += 1;
            return Ok(());
        }
        self.tally.damaged_records += 1;
        if self.remove {
            let _entered = self.enter()?;
            self.store.remove_record(key)?;
            self.say(&REMOVED);
        }
        Ok(())
    }

    /// Enters the store. What is damage to this program may be whole to a newer one, which has the
    /// store by now: then this fails.
    fn enter(&self) -> anyhow::Result<Entered> {
        Ok(enter(self.store, &AtomicBool::new(false), &|text| self.say(&text))?)
    }

    fn say(&self, words: &dyn Display) {
        self.bar.suspend(|| print_line!("{words}"));
    }
}

impl Tally {
    /// Prints the numbers; exit code 3 if anything is damaged or can't be read.
    fn tell(&self) -> ExitCode {
        let Self { artifacts, damaged, damaged_records, unreadable } = *self;
        let mut line = format!("{}, {damaged} damaged", counted(artifacts, "artifact"));
        if damaged_records > 0 {
            line += &format!(", {} damaged", counted(damaged_records, "record"));
        }
        if unreadable > 0 {
            line += &format!(", {unreadable} unreadable");
        }
        print_line!("{line}");
        if damaged + damaged_records + unreadable == 0 {
            ExitCode::SUCCESS
        } else {
            ExitCode::from(3)
        }
    }
}

const REMOVED: &str = "  removed; the next run makes it again";

fn is_gone(path: &Path) -> bool {
    path.symlink_metadata().is_err_and(|error| error.kind() == io::ErrorKind::NotFound)
}

/// Shows itself on a terminal alone.
fn bar(bytes: u64) -> ProgressBar {
    let style =
        ProgressStyle::with_template("reading [{bar:30}] {bytes} of {total_bytes}, {eta} left");
    ProgressBar::new(bytes)
        .with_style(style.expect("the template is constant").progress_chars("=> "))
}
