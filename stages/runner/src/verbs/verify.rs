use std::process::ExitCode;

use artifact::Store;

/// Reads every artifact again.
pub(crate) fn verify(store: &Store, remove: bool) -> anyhow::Result<ExitCode> {
    let objects = store.objects()?;
    let mut damaged = 0;
    for object in &objects {
        if let Err(damage) = store.verify(object) {
            damaged += 1;
            println!("{damage}");
            if remove {
                store.remove_object(object)?;
                println!("  removed; the next run makes it again");
            }
        }
    }
    println!("{} artifacts, {damaged} damaged", objects.len());
    Ok(if damaged == 0 { ExitCode::SUCCESS } else { ExitCode::from(3) })
}
