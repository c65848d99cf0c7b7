use std::io::Write as _;
use std::process::ExitCode;

/// Prints a shell's completions for the program.
pub(crate) fn completions(shell: clap_complete::Shell, program: &mut clap::Command) -> ExitCode {
    let mut script = Vec::new();
    clap_complete::generate(shell, program, "nerf-sr", &mut script);
    // Whoever asked for it may have gone.
    std::io::stdout().write_all(&script).ok();
    ExitCode::SUCCESS
}
