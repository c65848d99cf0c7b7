//! Messages of a run: reasons of failures, logs, recommended commands, closed pipes.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::os::unix::fs::PermissionsExt as _;
use std::process::{Command, Stdio};

use common::{
    Finished, Project, bin, call_of, demo_train, is_running, last_checkpoint, signal,
    stage_command, verbs, wait_until,
};

/// Creates a project whose two stages run one shell script, `commands`; `$out` is the output.
fn script_project(commands: &str) -> Project {
    let project = Project::new(
        "default: [talk]\nstages:\n  talk: {run: ./talk}\n  other: \
        {extends: talk, parameters: {word: other}}\n",
    );
    let description = r#"{"name": "talk", "version": "1", "code": "1", "summary": "Talks.", "inputs": {},
      "parameters": {"type": "object", "properties": {"word": {"type": "string", "default": "hello"}}}, "output": {"kind": "text"}}"#;
    let script = format!(
        "#!/bin/sh\nif [ \"$1\" = describe ]; then cat <<'END'\n{description}\nEND\nexit; fi\n\
         while [ $# -gt 0 ]; do case $1 in --output) out=$2;; --params) params=$2;; --threads) \
         threads=$2;; esac; shift; done\n\
         {commands}\n"
    );
    project.program("talk", &script);
    project
}

/// Shell commands that write a stage's output.
const WRITE_OUTPUT: &str = "mkdir $out; echo text > $out/text";

/// Returns the write end of a pipe that has no reader.
fn closed_pipe() -> Stdio {
    Stdio::from(std::io::pipe().unwrap().1)
}

#[test]
fn a_failure_message_states_the_reason_not_just_the_last_line() {
    let note =
        "echo 'note: run with `RUST_BACKTRACE=1` environment variable to display a backtrace' >&2";
    let allocation =
        format!("echo 'memory allocation of 99532800 bytes failed' >&2; {note}; kill -ABRT $$");
    let panic = format!(
        "echo \"thread 'main' panicked at x.rs:1:2:\" >&2; echo 'no entry' >&2; {note}; exit 101"
    );
    for (commands, code, expected) in [
        ("echo 'talk: r_0.png: cut short' >&2; exit 3", 3, "talk: failed: r_0.png: cut short"),
        (
            "echo '{\"event\": \"failed\", \"message\": \"disk full\"}'; echo 'a warning' >&2; \
            exit 1",
            1,
            "talk: failed: disk full",
        ),
        (
            &allocation,
            1,
            "talk: failed: out of memory: 99.5 MB more were requested; end other programs, run \
            one stage at a time",
        ),
        (
            "echo \"terminate called after throwing an instance of 'std::bad_alloc'\" >&2; \
            echo '  what():  std::bad_alloc' >&2; kill -ABRT $$",
            1,
            "talk: failed: out of memory; end other programs, run one stage at a time",
        ),
        (
            "echo working >&2; kill -KILL $$",
            1,
            "talk: failed: ended by SIGKILL (last line: working); if memory ran out",
        ),
        ("kill -SEGV $$", 1, "talk: failed: crashed with SIGSEGV; please report it"),
        (&panic, 101, "talk: failed: no entry"),
        ("exit 7", 7, "talk: failed: exit code 7 without a message"),
    ] {
        let project = script_project(commands);
        let finished = project.run(&["run"]);
        assert_eq!(finished.code, code, "{commands}: {}", finished.stderr);
        assert!(
            finished.stderr.lines().any(|line| line.starts_with(expected)),
            "{commands}: {}",
            finished.stderr
        );
        // The log ends with the same reason.
        let log = project.ok(&["log", "talk"]);
        let reason = expected.strip_prefix("talk: failed: ").unwrap();
        assert!(
            log.lines().last().unwrap().contains(&format!("with exit code {code}: {reason}")),
            "{log}"
        );
    }
}

#[test]
fn our_stages_state_the_reason_of_a_failure_once() {
    let project = Project::tiny();
    demo_train(&project, 4);
    for file in ["artifact.json", "train/r_2.png"] {
        std::fs::remove_file(project.path("data").join(file)).unwrap();
    }
    let finished = project.run(&["run", "-i", "dataset=data"]);
    assert_eq!(finished.code, 3, "{}", finished.stderr);
    let reason =
        finished.stderr.lines().find_map(|line| line.strip_prefix("prep: failed: ")).unwrap();
    assert!(reason.contains("r_2.png") && !reason.starts_with("prep"), "{reason}");
    assert_eq!(finished.stderr.matches(reason).count(), 1, "{}", finished.stderr);
}

#[test]
fn a_log_contains_parameters_messages_and_result() {
    let project = script_project(&format!(
        "echo 'on stderr' >&2; echo 'on stdout'\n\
         i=0; while [ $i -lt 40 ]; do i=$((i + 1)); \
         echo '{{\"event\": \"progress\", \"label\": \"talking\", \"done\": '$i', \"total\": 40, \"note\": \"PSNR '$i'\"}}'; done\n\
         {WRITE_OUTPUT}; echo '40 words in all' > $out/summary.txt"
    ));
    project.ok(&["run", "-p", "word=bye"]);
    let log = project.ok(&["log", "talk", "-p", "word=bye"]);
    let lines: Vec<&str> = log.lines().collect();
    assert!(
        lines[0].starts_with("talk (")
            && lines[0].contains("/actions/")
            && lines[0].ends_with(".log):"),
        "{log}"
    );
    assert!(lines[1].starts_with("talk: started 2") && lines[1].ends_with(" UTC"), "{log}");
    assert!(lines[2].starts_with("program: ") && lines[2].contains("/talk 1, "), "{log}");
    for line in [
        "device: cpu",
        r#"parameters: {"word":"bye"}"#,
        "on stderr",
        "on stdout",
        "result: 40 words in all",
    ] {
        assert!(lines.contains(&line), "{line}\n{log}");
    }
    let progress: Vec<&&str> = lines.iter().filter(|line| line.starts_with("talking: ")).collect();
    assert_eq!((progress.len(), *progress[0]), (10, "talking: 10 % · PSNR 4"), "{log}");
    assert!(lines[lines.len() - 2].starts_with("done in "), "{log}");
}

#[test]
fn logs_of_our_stages_contain_parameters_inputs_and_result() {
    let project = Project::tiny();
    project.ok(&["run"]);
    let scene = project.output_of("prep", &[]).remove(0);
    let log = project.ok(&["log", "train-ss"]);
    let field = project.output_of("train-ss", &[]).remove(0);
    let summary = std::fs::read_to_string(project.object(&field).join("summary.txt")).unwrap();
    assert!(summary.contains(" rays in "), "{summary}");
    for text in [
        "train-ss: started 2",
        r#""rays":60000"#,
        &format!("input scene: {}", project.object(&scene).display()),
        &format!("result: {}", summary.trim()),
    ] {
        assert!(log.contains(text), "{text}\n{log}");
    }
    let demo = project.ok(&["log", "demo-scene"]);
    assert!(demo.contains(r#""size":48"#) && demo.contains("done in"), "{demo}");
}

#[test]
fn the_recommended_command_works_as_printed() {
    let project = script_project("echo 'it is the word' >&2; exit 1");
    std::fs::rename(project.path("pipeline.yaml"), project.path("my pipeline.yaml")).unwrap();
    let arguments = [
        "run",
        "-j",
        "1",
        "--keep-going",
        "--out",
        "pages",
        "other",
        "-p",
        "word=it's $(all)",
        "--pipeline",
        "my pipeline.yaml",
    ];
    let failed = project.run(&arguments);
    assert_eq!(failed.code, 1, "{}", failed.stderr);
    let last_line = failed.stderr.lines().last().unwrap();
    assert!(last_line.starts_with("nerf-sr: other failed; `"), "{last_line}");
    let command = last_line.split('`').nth(1).unwrap();
    assert!(
        command.ends_with(
            r"nerf-sr log other other -p 'word=it'\''s $(all)' --pipeline 'my pipeline.yaml'"
        ),
        "{command}"
    );
    let finished = Finished::of(
        Command::new("sh").args(["-c", command]).current_dir(project.path(".")).output().unwrap(),
    );
    assert!(
        finished.stdout.contains("it is the word")
            && !finished.stdout.contains("not run with these"),
        "{}",
        finished.stdout
    );
}

#[test]
fn log_finds_runs_with_other_parameters() {
    let project = script_project(&format!(
        "grep -q bad $params && {{ echo 'no good' >&2; exit 3; }}; cat $params >&2; {WRITE_OUTPUT}"
    ));
    // A stage that the default targets don't need, and one that ran with another parameter.
    project.ok(&["run", "other"]);
    project.run(&["log", "nobody"]).fails(2, &["no stage \"nobody\""]);
    assert_eq!(project.ok(&["log", "talk"]), "talk: has not run yet\n");
    project.ok(&["run", "-p", "word=bye"]);
    for (stage, word) in [("other", "\"other\""), ("talk", "\"bye\"")] {
        let log = project.ok(&["log", stage]);
        assert!(log.contains(word) && log.contains("no log for these arguments"), "{log}");
    }
    // A failed stage has no record, but has a log.
    project.run(&["run", "-p", "word=bad"]).fails(3, &["talk failed"]);
    assert!(project.ok(&["log", "talk", "-p", "word=bad"]).contains("no good"));
    project.ok(&["run", "other", "-p", "word=more"]);
    let log = project.ok(&["log", "talk"]);
    assert!(log.contains("no good") && log.contains("/partial/"), "{log}");
}

#[test]
fn a_closed_stdout_changes_nothing() {
    let project = Project::tiny();
    project.replace("default: [eval]", "default: [report]");
    let text = std::fs::read_to_string(project.path("pipeline.yaml")).unwrap();
    project.write("pipeline.yaml", &(text + "  report:\n    inputs: {run: eval}\n"));
    // `init` needs photographs, and writes a pipeline once.
    let verbs: Vec<String> = verbs().into_iter().filter(|verb| verb != "init").collect();
    // Stages run; all stages are cached; stderr is closed, too.
    for is_stderr_read in [true, true, false] {
        for verb in &verbs {
            let stderr = if is_stderr_read { Stdio::piped() } else { closed_pipe() };
            let mut command = project.command(&call_of(verb));
            let finished =
                Finished::of(command.stdout(closed_pipe()).stderr(stderr).output().unwrap());
            assert_eq!(
                finished.code, 0,
                "{verb}: {}\n(call_of in tests/common/mod.rs lists a verb's arguments)",
                finished.stderr
            );
            assert!(
                !finished.stderr.contains("panicked")
                    && !finished.stderr.contains("internal error"),
                "{verb}: {}",
                finished.stderr
            );
        }
    }
    assert!(project.path("out/report/index.html").exists());
    // A failure keeps its exit code.
    let failed = project
        .command(&["run", "-p", "kernal=box"])
        .stdout(closed_pipe())
        .stderr(closed_pipe())
        .status()
        .unwrap();
    assert_eq!(failed.code(), Some(2));
}

#[test]
fn a_stage_runs_with_closed_stdout_and_stderr() {
    let project = Project::tiny();
    demo_train(&project, 4);
    for (progress, arguments, code) in [
        ("plain", &["--input", "dataset=data", "--output", "alone"][..], 0),
        ("json", &["--input", "dataset=data", "--output", "run"], 0),
        ("plain", &["--input", "dataset=nowhere", "--output", "none"], 3),
        ("json", &["--input", "dataset=nowhere", "--output", "none"], 3),
        ("plain", &["describe"], 0),
        ("plain", &["--help"], 0),
    ] {
        let mut command = Command::new(bin("prep"));
        command
            .args(arguments)
            .current_dir(project.path("."))
            .stdout(closed_pipe())
            .stderr(closed_pipe());
        if arguments.len() > 2 {
            project.write("params.json", r#"{"lr_width": 24}"#);
            command.args(["--params", "params.json", "--progress", progress]);
        }
        assert_eq!(command.status().unwrap().code(), Some(code), "{progress} {arguments:?}");
    }
    assert!(
        project.path("alone/artifact.json").exists() && project.path("run/artifact.json").exists()
    );
}

#[test]
fn control_characters_from_a_stage_are_escaped() {
    let escape = "\\033]0;PWN\\007\\033[31mred";
    let project = script_project(&format!(
        "printf '{escape} one\\n' >&2; printf '{escape} two\\n' >&2\n\
         printf '%s\\n' '{{\"event\": \"progress\", \"label\": \"\\u001b[1ma\", \"done\": 1, \"total\": 1, \"note\": \"\\u001b[2mb\"}}'\n\
         printf ' 10%%\\r 20%%\\r\\n' >&2\n\
         printf '%s\\n' '{{\"event\": \"failed\", \"message\": \"\\u001b[31mfor\\nged\"}}'; exit 1"
    ));
    let run = project.run(&["run"]);
    assert_eq!(run.code, 1, "{}", run.stderr);
    assert!(
        run.stderr.contains(r"\u{1b}]0;PWN\u{7}\u{1b}[31mred one")
            && run.stderr.contains(r"failed: \u{1b}[31mfor\nged")
    );
    let log = project.ok(&["log", "talk"]);
    assert!(
        log.contains(r"\u{1b}[31mred two") && log.contains(r"\u{1b}[1ma: 100 % · \u{1b}[2mb"),
        "{log}"
    );
    // The log contains the last state of a redrawn progress bar.
    assert!(log.lines().any(|line| line == " 20%"), "{log}");
    for text in [run.stderr, run.stdout, log] {
        assert!(!text.contains(['\u{1b}', '\u{7}', '\r']), "{text:?}");
    }
}

#[test]
fn describe_prints_a_stages_help() {
    let project = Project::tiny();
    let help = project.ok(&["describe", "render-depth"]);
    assert!(
        help.contains("Usage: render-depth ")
            && help.contains("\nParameters, ")
            && help.contains("\nInputs, "),
        "{help}"
    );
    // A program without a block in the pipeline's files.
    let help = project.ok(&["describe", "table"]);
    assert!(help.contains("Usage: table "), "{help}");
    project.run(&["describe", "nobody"]).fails(2, &["no stage \"nobody\"", "known: demo-scene"]);
}

#[test]
fn more_threads_than_a_machine_can_use_are_not_started() {
    let project = script_project(&format!("echo \"threads=$threads\" >&2; {WRITE_OUTPUT}"));
    let run = project.run(&["run", "--threads", "100000", "--jobs", "100000"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let max_threads = 4 * stage::processors().count;
    for text in [
        "nerf-sr: --threads 100000 is more than",
        "nerf-sr: --jobs 100000 is more than",
        &format!("threads={max_threads}"),
    ] {
        assert!(run.stderr.lines().any(|line| line.contains(text)), "{text}: {}", run.stderr);
    }
    assert!(run.stdout.ends_with("1 of 1 stage ran, 0 were cached\n"), "{}", run.stdout);
    assert_eq!(project.ok(&["run"]), "nothing to run: the stage is cached\n");
}

const HUP: u32 = 1;
const TERM: u32 = 15;

/// Returns whether a set of signals in a process's `/proc` status contains a signal.
fn has_signal(process: &std::process::Child, set: &str, signal: u32) -> bool {
    let status =
        std::fs::read_to_string(format!("/proc/{}/status", process.id())).unwrap_or_default();
    let mask =
        status.lines().find_map(|line| line.strip_prefix(set)?.strip_prefix(":")).map(str::trim);
    mask.and_then(|mask| u64::from_str_radix(mask, 16).ok())
        .is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

#[test]
fn a_closed_terminal_leaves_a_checkpoint() {
    let project = Project::tiny();
    let train = demo_train(&project, 8);
    let params = r#"{"rays": 900000000, "n_levels": 4, "cells_per_pixel": 1.28, "log2_hashmap_size": 12, "hidden_dim": 16, "max_rays_per_step": 2048, "samples_per_step": 16384}"#;
    let (output, work) = (project.path("out"), project.path("work"));
    let stage = stage_command(
        "train-ss",
        params,
        &[("scene", &train)],
        &output,
        &["--work", work.to_str().unwrap()],
    );
    // Under nohup, which may run this test too, the stage must ignore SIGHUP.
    for disposition in ["--default-signal=HUP", "--ignore-signal=HUP"] {
        let mut command = Command::new("env");
        let child = command
            .arg(disposition)
            .arg(stage.get_program())
            .args(stage.get_args())
            .stderr(Stdio::piped())
            .spawn();
        let child = child.unwrap();
        wait_until(|| last_checkpoint(&work).is_some() && has_signal(&child, "SigCgt", TERM));
        let is_ignored = has_signal(&child, "SigIgn", HUP);
        assert_eq!(
            is_ignored,
            disposition.starts_with("--ignore"),
            "the stage must ignore SIGHUP under nohup only"
        );
        signal(&child, "-HUP");
        if is_ignored {
            signal(&child, "-TERM");
        }
        let finished = Finished::of(child.wait_with_output().unwrap());
        assert_eq!(finished.code, 130, "{}", finished.stderr);
        assert!(
            finished.stderr.ends_with("train-ss: interrupted; run again to resume\n"),
            "{}",
            finished.stderr
        );
    }
}

#[test]
fn a_stage_stopped_at_a_given_count_resumes_to_the_same_result() {
    let project = Project::tiny();
    let mut command = project.command(&["run"]);
    let stopped = Finished::of(command.env("NERF_SR_STOP_AFTER", "30000").output().unwrap());
    assert_eq!(stopped.code, 130, "{}", stopped.stderr);
    assert!(
        stopped.stderr.contains("train-ss: interrupted; run again to resume"),
        "{}",
        stopped.stderr
    );
    assert!(project.ok(&["status"]).contains("has a checkpoint to resume from"));
    let resumed = project.run(&["run"]);
    assert!(
        resumed.code == 0 && resumed.stderr.contains("train-ss: resuming from step"),
        "{}",
        resumed.stderr
    );
    let uninterrupted = Project::tiny();
    uninterrupted.ok(&["run"]);
    assert_eq!(project.output_of("train-ss", &[]), uninterrupted.output_of("train-ss", &[]));
}

/// Shell command that starts a background process, which keeps the stage's pipes open. The process
/// creates `slept` unless another process ends the sleep.
const START_BACKGROUND_PROCESS: &str = "(sleep 1000; touch slept) & echo $! > left";

/// Fails unless the runner ended a stage's background process without waiting for the sleep.
#[track_caller]
fn assert_background_process_is_ended(project: &Project) {
    let process = std::fs::read_to_string(project.path("left")).unwrap();
    wait_until(|| !is_running(process.trim()));
    assert!(!project.path("slept").exists(), "the background process ended by itself");
}

#[test]
fn the_runner_ends_processes_that_a_stage_leaves_running() {
    let project = script_project(&format!("{START_BACKGROUND_PROCESS}; touch started; wait"));
    let child = project.spawn(&["run"]);
    wait_until(|| project.path("started").exists());
    signal(&child, "-INT");
    let finished = Finished::of(child.wait_with_output().unwrap());
    assert_eq!(finished.code, 130, "{}", finished.stderr);
    assert_background_process_is_ended(&project);
    // A successful stage may leave a process running, too.
    let project = script_project(&format!("{START_BACKGROUND_PROCESS}; {WRITE_OUTPUT}"));
    project.ok(&["run"]);
    assert_background_process_is_ended(&project);
}

/// Runs the pipeline with a group's umask; fails unless the group can write all of the store.
fn run_with_group_umask(project: &Project, variables: &[(&str, &str)]) -> Finished {
    let mut command = Command::new("sh");
    command
        .args(["-c", "umask 002; exec \"$0\" run"])
        .arg(bin("nerf-sr"))
        .current_dir(project.path("."));
    let finished = Finished::of(
        command.env_remove("NERF_SR_STORE").envs(variables.iter().copied()).output().unwrap(),
    );
    for entry in walkdir::WalkDir::new(project.path(".nerf-sr")) {
        let entry = entry.unwrap();
        let mode = entry.metadata().unwrap().permissions().mode();
        assert_eq!(mode & 0o020, 0o020, "{}: {mode:o}", entry.path().display());
    }
    finished
}

#[test]
fn a_group_can_share_a_store() {
    let project = Project::tiny();
    // The fixture's files aren't writable for the group.
    std::fs::remove_dir_all(project.path(".nerf-sr")).unwrap();
    // A stopped run leaves checkpoints and parts; the next run finishes.
    let stopped = run_with_group_umask(&project, &[("NERF_SR_STOP_AFTER", "30000")]);
    assert_eq!(stopped.code, 130, "{}", stopped.stderr);
    let finished = run_with_group_umask(&project, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
}

#[test]
fn verify_names_files_and_folders_that_are_not_artifacts() {
    let project = script_project(WRITE_OUTPUT);
    project.ok(&["run"]);
    project.write(".nerf-sr/objects/notes.txt", "mine");
    project.write(".nerf-sr/objects/folder/notes.txt", "mine");
    let output = project.ok(&["verify", "--remove"]);
    assert!(
        output.contains("objects/notes.txt: not an artifact")
            && output.contains("objects/folder: not an artifact"),
        "{output}"
    );
    assert!(output.ends_with("1 artifact, 0 damaged\n"), "{output}");
    // A file instead of an artifact's folder is damage.
    let object = project.object(&project.output_of("talk", &[])[0]);
    std::fs::remove_dir_all(&object).unwrap();
    std::fs::write(&object, "").unwrap();
    assert_eq!(project.run(&["verify"]).code, 3);
    assert_eq!(project.run(&["verify", "--remove"]).code, 3);
    assert!(
        project.ok(&["verify"]).ends_with("0 artifacts, 0 damaged\n")
            && project.path(".nerf-sr/objects/notes.txt").exists()
    );
    assert!(project.ok(&["run"]).contains("1 of 1 stage ran"));
}
