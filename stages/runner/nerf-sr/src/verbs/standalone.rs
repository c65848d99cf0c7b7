//! Verbs that need no store: `init`, `describe`, `man` and `completions`.

use std::collections::BTreeSet;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, ExitCode};

use crate::starter::Starter;
use anyhow::Context as _;
use artifact::{bail_usage, format_count, print_line, print_lines};
use planning::{Describing, Pipeline, PlanError, Programs, executable, is_own, own_program};
use stage::render_help;
use store::Store;

/// Writes a pipeline for a folder of posed photographs, and prints what was found.
pub(crate) fn init(folder: &Path, file: &Path) -> anyhow::Result<()> {
    let starter = Starter::new(folder, file)?;
    print_line!("found: {}", starter.summary);
    print_line!("sizes: {}", starter.sizes);
    for note in &starter.notes {
        print_line!("  {note}");
    }
    let written = starter.write()?;
    let count = |folder: &str| {
        let inside =
            written.iter().filter(|file| file.parent().is_some_and(|p| p.ends_with(folder)));
        format_count(inside.count(), "file")
    };
    print_line!(
        "wrote: {}, pipelines/ ({}), experiments/ ({})",
        file.display(),
        count("pipelines"),
        count("experiments")
    );
    print_line!("`nerf-sr run` renders the views; `nerf-sr plan` shows the stages for this");
    Ok(())
}

/// Prints the help of a block's program, or of a program in the runner's folder. A program that
/// isn't the runner's own isn't started: its help is rendered from its cached description, which
/// `open_store` gives access to.
pub(crate) fn describe(
    pipeline: &Pipeline,
    stage: &str,
    open_store: impl FnOnce() -> anyhow::Result<Store>,
) -> anyhow::Result<ExitCode> {
    let found = planning::find_targets(pipeline, &[stage.to_owned()]);
    let has_block = matches!(&found, Ok((pipeline, _)) if pipeline.stages.contains_key(stage));
    if !has_block && let Some(program) = own_program(stage) {
        return print_help(&program);
    }
    let (pipeline, _) = found?;
    if !has_block {
        let known = artifact::known_names(stage, pipeline.stages.keys().map(String::as_str));
        bail_usage!("no stage {stage:?}; {known}");
    }
    let program = executable(&pipeline, stage);
    if is_own(&program) {
        return print_help(&program);
    }
    let needed = BTreeSet::from([stage.to_owned()]);
    let programs = Programs::find(&pipeline, &open_store()?, &needed, Describing::OwnOnly)?;
    let description = &programs.require(stage).map_err(PlanError::from)?.description;
    print_lines(&format!("{}\n\n{}", description.summary, render_help(description)));
    Ok(ExitCode::SUCCESS)
}

/// Prints the help of one of the runner's own programs.
fn print_help(program: &Path) -> anyhow::Result<ExitCode> {
    let status = Command::new(program)
        .arg("--help")
        .status()
        .with_context(|| format!("cannot start {}; run `make build`", program.display()))?;
    Ok(if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Writes man pages of the program and all its verbs into a folder.
pub(crate) fn man(program: clap::Command, folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)
        .and_then(|()| clap_mangen::generate_to(program, folder))
        .with_context(|| format!("cannot write man pages into {}", folder.display()))
}

/// Prints a shell's completions for the program.
pub(crate) fn completions(shell: clap_complete::Shell, program: &mut clap::Command) {
    let mut script = Vec::new();
    clap_complete::generate(shell, program, "nerf-sr", &mut script);
    // A reader that closed the pipe early is no error.
    std::io::stdout().write_all(&script).ok();
}
