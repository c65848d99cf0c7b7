//! The stage's binary; see the library.

fn main() -> std::process::ExitCode {
    stage::run_stage::<copy::Copy>(env!("CARGO_PKG_VERSION"), env!("STAGE_FINGERPRINT"))
}
