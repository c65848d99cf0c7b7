//! `nerf-sr`: runs pipeline.yaml.

fn main() -> std::process::ExitCode {
    runner::main()
}
