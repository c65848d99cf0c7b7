//! Tests of panics in processes of their own.

use std::process::Command;

use crate::contract::Output;
use rayon::prelude::*;

use crate::run::run_stage_with;
use crate::{Context, Event, Stage, install_panic_hook};

/// No parameters, as the object that the schema requires.
#[derive(Default, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
struct Params {}

struct PanickingStage;
impl Stage for PanickingStage {
    type Params = Params;
    const NAME: &'static str = "greet";
    const SUMMARY: &'static str = "Panics.";
    fn output() -> Output {
        Output::kind("text")
    }
    fn run(context: &Context, _: &Params) -> anyhow::Result<()> {
        context.log_line("before");
        panic!("in a stage")
    }
}

/// Environment variable with the location at which [`a_process_that_panics`] panics.
const LOCATION: &str = "PANIC_WHERE";
/// Environment variable with the output folder of the stage that panics.
const OUTPUT: &str = "PANIC_OUTPUT";

#[test]
#[ignore = "a process of its own, which the tests below start"]
fn a_process_that_panics() {
    install_panic_hook("greet");
    match std::env::var(LOCATION).unwrap().as_str() {
        "main" => panic!("two\n   lines"),
        "thread" => {
            let (_sender, receiver) = std::sync::mpsc::channel::<()>();
            std::thread::spawn(|| panic!("a name"));
            // Blocks until the panic ends the process.
            receiver.recv().ok();
        }
        "rayon" => (0..64).into_par_iter().for_each(|i| assert!(i < 0, "all of them")),
        "printing" => println!("{}", std::fmt::from_fn(|_| panic!("while stdout is locked"))),
        "stage" => {
            let output = std::env::var(OUTPUT).unwrap();
            let arguments = ["greet", "--output", &output, "--progress", "json"];
            run_stage_with::<PanickingStage>("", "", arguments.map(Into::into));
        }
        "memory" => panic!("called f_mm: you tried to allocate 99532800 bytes. Error code 12"),
        location => unreachable!("{location}"),
    }
}

/// Runs [`a_process_that_panics`] in its own process.
fn run_panicking_process(location: &str, backtrace: &str) -> std::process::Output {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.env(OUTPUT, folder.path().join("output"));
    // With one thread, libtest would print the test's name in front of the stage's first line.
    command.args(["panic_tests::a_process_that_panics", "--exact", "--ignored", "--nocapture"]);
    command.arg("--test-threads=2");
    command
        .env(LOCATION, location)
        .env("RUST_BACKTRACE", backtrace)
        .env_remove("RUST_LIB_BACKTRACE")
        .output()
        .unwrap()
}

#[test]
fn a_panic_in_any_thread_is_one_line_and_exit_code_70() {
    for (location, code, message) in [
        ("main", 70, "greet: internal error: two lines ("),
        ("thread", 70, "greet: internal error: a name ("),
        ("rayon", 70, "greet: internal error: all of them ("),
        ("printing", 70, "greet: internal error: while stdout is locked ("),
        ("memory", 1, "greet: out of memory: 99.5 MB more were requested;"),
    ] {
        let output = run_panicking_process(location, "0");
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(
            (output.status.code(), stderr.lines().count()),
            (Some(code), 1),
            "{location}: {stderr}"
        );
        assert!(stderr.starts_with(message), "{location}: {stderr}");
        assert!(code == 1 || stderr.ends_with("); please report it\n"), "{location}: {stderr}");
    }
}

#[test]
fn a_panicking_stage_reports_to_its_runner() {
    let output = run_panicking_process("stage", "0");
    let (stdout, stderr) =
        (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert_eq!(output.status.code(), Some(70), "{stderr}");
    let message =
        stderr.strip_prefix("before\ngreet: ").unwrap_or_else(|| panic!("{stderr}")).trim_end();
    assert!(message.starts_with("internal error: in a stage ("), "{stderr}");
    // The test harness prints to stdout, too.
    let events: Vec<Event> =
        stdout.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    assert_eq!(events, [Event::Failed { message: message.to_owned() }], "{stdout}");
}

#[test]
fn a_requested_backtrace_precedes_the_message() {
    let output = run_panicking_process("main", "1");
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(stderr.lines().count() > 5, "{stderr}");
    assert!(
        stderr.lines().last().unwrap().starts_with("greet: internal error: two lines ("),
        "{stderr}"
    );
}
