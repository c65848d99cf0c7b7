use std::path::Path;
use std::process::ExitCode;

use anyhow::Context as _;

/// Writes man pages of the program and all its verbs into a folder.
pub(crate) fn man(program: clap::Command, folder: &Path) -> anyhow::Result<ExitCode> {
    std::fs::create_dir_all(folder)
        .and_then(|()| clap_mangen::generate_to(program, folder))
        .with_context(|| format!("cannot write man pages into {}", folder.display()))?;
    Ok(ExitCode::SUCCESS)
}
