//! The stage's binary; see the library.

fn main() -> std::process::ExitCode {
    artifact::run_stage::<viewer::Viewer>(env!("CARGO_PKG_VERSION"), env!("STAGE_FINGERPRINT"))
}
