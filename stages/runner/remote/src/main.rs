//! `nerf-sr-remote`: shares a store between machines.

fn main() -> std::process::ExitCode {
    remote::main()
}
