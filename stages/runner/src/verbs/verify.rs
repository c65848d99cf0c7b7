use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context as _;
use artifact::{Store, counted, print_line};
use indicatif::{ProgressBar, ProgressStyle};

use crate::waiting::enter_at_once;

/// Reads every artifact again.
pub(crate) fn verify(store: &Store, remove: bool) -> anyhow::Result<ExitCode> {
    let (objects, foreign) = list(&store.root().join("objects"))?;
    for path in &foreign {
        print_line!("{}: not an artifact; it is left alone, move it elsewhere", path.display());
    }
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

/// Names of artifacts, and what else lies beside them, both sorted.
fn list(folder: &Path) -> anyhow::Result<(Vec<String>, Vec<PathBuf>)> {
    let (mut objects, mut foreign) = (Vec::new(), Vec::new());
    for entry in std::fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let entry = entry.with_context(|| folder.display().to_string())?;
        match entry.file_name().into_string() {
            Ok(name) if is_hash(&name) => objects.push(name),
            _ => foreign.push(entry.path()),
        }
    }
    objects.sort_unstable();
    foreign.sort_unstable();
    Ok((objects, foreign))
}

fn is_hash(name: &str) -> bool {
    name.len() == 64 && name.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}
