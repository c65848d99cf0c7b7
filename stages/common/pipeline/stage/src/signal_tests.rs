//! Tests of signals to stages in processes of their own.

use std::io::{BufRead as _, BufReader, Read as _};
use std::process::{Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

use crate::contract::Output;
use rustix::process::{Pid, Signal, kill_process};

use crate::run::run_stage_with;
use crate::{Context, Stage, stop_signals};

/// No parameters, as the object that the schema requires.
#[derive(Default, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
struct Params {}

/// Stage that checks for signals often, or never.
struct WorkingStage;
impl Stage for WorkingStage {
    type Params = Params;
    const NAME: &'static str = "work";
    const SUMMARY: &'static str = "Works for an hour.";
    fn output() -> Output {
        Output::kind("text")
    }
    fn run(context: &Context, _: &Params) -> anyhow::Result<()> {
        std::fs::write(context.output_path("half")?, "half")?;
        context.log_line("working");
        let never_checks = std::env::var(NEVER_CHECKS).is_ok();
        for _ in 0..360_000 {
            std::thread::sleep(Duration::from_millis(10));
            if !never_checks {
                context.check_interrupt()?;
            }
        }
        Ok(())
    }
}

/// Environment variable that is set if the stage never checks for signals.
const NEVER_CHECKS: &str = "DEADLINE_IS_DEAF";
/// Environment variable with the output folder of the stage.
const OUTPUT: &str = "DEADLINE_OUTPUT";

#[test]
#[ignore = "a process of its own, which the test below starts"]
fn a_process_that_works() {
    let output = std::env::var(OUTPUT).unwrap();
    let arguments = ["work", "--output", &output, "--progress", "json"];
    let code = run_stage_with::<WorkingStage>("", "", arguments.map(Into::into));
    std::process::exit(if code == ExitCode::from(130) { 130 } else { 1 });
}

/// Sends a signal to a working stage. Returns the stage's exit code, stdout and stderr, and the
/// time from the signal to the stage's end.
fn signal_stage(signal: Signal, never_checks: bool) -> (Option<i32>, String, String, Duration) {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["signal_tests::a_process_that_works", "--exact", "--ignored", "--nocapture"]);
    command.env(OUTPUT, folder.path().join("output"));
    if never_checks {
        command.env(NEVER_CHECKS, "1");
    }
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut stderr = BufReader::new(child.stderr.take().unwrap());
    let mut text = String::new();
    stderr.read_line(&mut text).unwrap();
    kill_process(Pid::from_child(&child), signal).unwrap();
    let sent = Instant::now();
    stderr.read_to_string(&mut text).unwrap();
    let output = child.wait_with_output().unwrap();
    let took = sent.elapsed();
    assert_eq!(folder.path().read_dir().unwrap().count(), 0, "{text}");
    (output.status.code(), String::from_utf8(output.stdout).unwrap(), text, took)
}

/// A stage ends within two seconds, whether it checks for signals or not, with one message, one
/// event, and no output.
#[test]
fn a_signal_ends_any_stage_in_time() {
    // Under `nohup`, SIGHUP is ignored, and stages don't change that.
    let handled = stop_signals();
    let signals = [Signal::INT, Signal::TERM, Signal::HUP];
    for signal in signals.into_iter().filter(|signal| handled.contains(&signal.as_raw())) {
        for never_checks in [false, true] {
            let (code, stdout, stderr, took) = signal_stage(signal, never_checks);
            let message = "work: interrupted; run again to resume\n";
            assert_eq!(
                (code, stderr.as_str()),
                (Some(130), format!("working\n{message}").as_str())
            );
            assert_eq!(stdout.matches(r#""event":"failed""#).count(), 1, "{stdout}");
            assert!(
                took < Duration::from_secs(2),
                "{signal:?}, never checks: {never_checks}: {took:?}"
            );
            assert!(
                !never_checks || took > Duration::from_millis(900),
                "the stage had no time to end: {took:?}"
            );
        }
    }
}
