use std::path::Path;
use std::process::ExitCode;

use artifact::{Failure, print_line};
use starter::{Starter, StarterError};

/// Writes a pipeline for a folder of posed photographs, and says what it found.
pub(crate) fn init(folder: &Path, file: &Path) -> anyhow::Result<ExitCode> {
    let starter = Starter::new(folder, file).map_err(refused)?;
    print_line!("found: {}", starter.summary());
    starter.notes().iter().for_each(|note| print_line!("  {note}"));
    let written = starter.write().map_err(refused)?;
    let names: Vec<String> = written.iter().map(|file| file.display().to_string()).collect();
    print_line!("wrote: {}", names.join(", "));
    print_line!("`nerf-sr run` makes the views; `nerf-sr plan` shows what that takes");
    Ok(ExitCode::SUCCESS)
}

fn refused(error: StarterError) -> anyhow::Error {
    match error {
        StarterError::Dataset(_) | StarterError::NoCameras { .. } => {
            Failure::BadInput(error.to_string()).into()
        }
        StarterError::Io { .. } => error.into(),
        StarterError::Inside { .. } | StarterError::Name { .. } | StarterError::Exists { .. } => {
            Failure::Usage(error.to_string()).into()
        }
    }
}
