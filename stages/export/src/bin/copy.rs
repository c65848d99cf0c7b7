//! The binary of stage `copy`; see the library.

fn main() -> std::process::ExitCode {
    stage::run_stage::<export::CopyFiles>(env!("CARGO_PKG_VERSION"), env!("STAGE_FINGERPRINT"))
}
