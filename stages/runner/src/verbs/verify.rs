use std::process::ExitCode;

use artifact::{counted, print_line};
use indicatif::{ProgressBar, ProgressStyle};
use store::Store;

use crate::waiting::enter_at_once;

/// Reads every artifact again.
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
    let mut damaged = 0;
    for (object, size) in objects.iter().zip(sizes) {
        if let Err(damage) = store.verify(object) {
            damaged += 1;
            bar.suspend(|| print_line!("{damage}"));
            if remove {
                // What is damage to this program may be whole to a newer one, which has the store
                // by now.
                let _entered = enter_at_once(store)?;
                store.remove_object(object)?;
                bar.suspend(|| print_line!("  removed; the next run makes it again"));
            }
        }
        bar.inc(size);
    }
    bar.finish_and_clear();
    print_line!("{}, {damaged} damaged", counted(objects.len(), "artifact"));
    Ok(if damaged == 0 { ExitCode::SUCCESS } else { ExitCode::from(3) })
}

/// Shows itself on a terminal alone.
fn bar(bytes: u64) -> ProgressBar {
    let style =
        ProgressStyle::with_template("reading [{bar:30}] {bytes} of {total_bytes}, {eta} left");
    ProgressBar::new(bytes)
        .with_style(style.expect("the template is constant").progress_chars("=> "))
}
