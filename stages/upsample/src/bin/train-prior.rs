//! The binary of stage `train-prior`; see the library.

fn main() -> std::process::ExitCode {
    stage::run_stage::<upsample::TrainPrior>(env!("CARGO_PKG_VERSION"), env!("STAGE_FINGERPRINT"))
}
