//! Every difference that `why` and `diff` report, in human-readable output.

#![allow(missing_docs, reason = "a test")]
mod common;

use artifact::hash_json;
use common::Project;
use serde_json::{Value, json};

/// Shell stage that writes text files, by-scene defaults and metrics. The environment variable
/// `MIX_MODE` is part of the key.
const PROGRAM: &str = r#"#!/bin/sh
if [ "$1" = describe ]; then
    text='{"kinds": ["text"], "summary": "a text", "optional": true}'
    number='{"type": "number", "default": 1}'
    echo '{"name": "'${NAME:-mix}'", "version": "1", "code": "'$(cksum < "$0" | cut -c1-4)'", "summary": "Mixes.",
      "inputs": {"a": '$text', "b": '$text'}, "environment": ["MIX_MODE"],
      "parameters": {"type": "object", "properties": {"count": '$number', "word": {"type": "string", "default": "one"},
        "flag": {"type": "boolean", "default": false}, "steps": {"type": ["number", "null"], "default": null, "x-default": "by scene"}}},
      "output": {"kind": "text", "resolved": "facts.json"}}'
    exit
fi
texts=
while [ $# -gt 0 ]; do
    case $1 in
        --output) out=$2 ;;
        --params) params=$2 ;;
        --input) texts="$texts$(cat "${2#*=}"/*.txt)" ;;
    esac
    shift
done
count=$(grep -o '"count": *[0-9]*' "$params" | tr -dc 0-9)
mkdir "$out"
for number in $(seq $count); do echo "$texts $(cat "$params") $MIX_MODE" > "$out/$number.txt"; done
echo '{"resolved": {"steps": '$((256 * count))'}}' > "$out/facts.json"
echo '{"mean": {"psnr": 3'$count'.25, "near": {"ssim": 0.5}}}' > "$out/metrics.json"
"#;

const PIPELINE: &str = "default: [second]
stages:
  first: {run: ./mix, inputs: {a: ./source}}
  second: {run: ./mix, inputs: {a: first}}
";

fn project() -> Project {
    let project = Project::new(PIPELINE);
    project.program("mix", PROGRAM);
    project.write("source/in.txt", "text\n");
    project
}

/// Returns a command's output lines, with hashes and times replaced by fixed text.
fn output_lines(project: &Project, arguments: &[&str]) -> Vec<String> {
    project.ok(arguments).lines().map(mask_line).collect()
}

fn mask_hash(word: &str) -> String {
    let is_hash = |word: &str| word.len() == 10 && word.bytes().all(|b| b.is_ascii_hexdigit());
    if is_hash(word.trim_end_matches(';')) {
        word.replace(|c: char| c.is_ascii_hexdigit(), "#")
    } else {
        word.to_owned()
    }
}

fn mask_line(line: &str) -> String {
    let line = line.split(' ').map(mask_hash).collect::<Vec<_>>().join(" ");
    match line.split_once("cached (") {
        Some((before, _)) => format!("{before}cached (…)"),
        None => line,
    }
}

/// Changes one part of the key in a stage's records, so that the next run doesn't find these
/// records.
fn change_key(project: &Project, stage: &str, part: &str, value: &Value) {
    let actions = std::fs::read_dir(project.path(".nerf-sr/actions"))
        .unwrap()
        .map(|entry| entry.unwrap().path());
    for path in actions.filter(|path| path.extension().is_some_and(|end| end == "json")) {
        let mut record: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        if record["stage"] == stage {
            record["key_parts"][part].clone_from(value);
            std::fs::remove_file(&path).unwrap();
            let name = format!("{}.json", hash_json(&record["key_parts"]));
            std::fs::write(path.with_file_name(name), record.to_string()).unwrap();
        }
    }
}

#[test]
fn why_reports_each_difference() {
    let project = project();
    // A run of another block caches the program's description.
    project.write("pipeline.yaml", &format!("{PIPELINE}  other: {{run: ./mix}}\n"));
    project.ok(&["run", "other", "--store", "empty"]);
    assert_eq!(
        output_lines(&project, &["why", "first", "--store", "empty"])[0],
        "first: will run: no earlier run of this stage"
    );
    project.write("pipeline.yaml", PIPELINE);
    project.ok(&["run", "first"]);
    assert_eq!(
        output_lines(&project, &["why", "second"]),
        ["second: will run: no earlier run of this stage", "    by scene: steps"]
    );
    project.ok(&["run"]);
    let why = |arguments: &[&str]| output_lines(&project, &[&["why", "first"], arguments].concat());
    assert_eq!(why(&[]), ["first: cached (…)", "    by scene: steps=256"]);
    let parameters = [
        ("count=2", "count: 1 → 2"),
        ("word=two words", "word: \"one\" → \"two words\""),
        ("flag=true", "flag: false → true"),
    ];
    for (setting, change) in parameters {
        let lines = why(&["-p", &format!("first.{setting}")]);
        assert_eq!(
            lines,
            [&format!("first: will run: parameter {change}"), "    by scene: steps"],
            "{setting}"
        );
    }
    assert_eq!(why(&["-p", "first.steps=9"]), ["first: will run: parameter steps: null → 9"]);
    let both = why(&["-p", "first.count=2", "-p", "first.flag=true"]);
    assert_eq!(both[0], "first: will run: parameter count: 1 → 2; parameter flag: false → true");
    assert_eq!(why(&["--device", "cuda:0"])[0], "first: will run: device: \"cpu\" → \"cuda\"");
    let mode = project.command(&["why", "first"]).env("MIX_MODE", "new").output().unwrap();
    let mode = String::from_utf8(mode.stdout).unwrap();
    assert_eq!(
        mode.lines().next().unwrap(),
        "first: will run: environment MIX_MODE: null → \"new\""
    );
    // Inputs: changed content, an added input, a removed input.
    project.write("source/in.txt", "other\n");
    assert_eq!(why(&[])[0], "first: will run: input a: ########## → ##########");
    let second = output_lines(&project, &["why", "second"]);
    let expected = [
        "second: waits for first; stays cached if results don't change",
        "    by scene: steps",
        "  first: will run: input a: ########## → ##########",
    ];
    assert_eq!(second, expected);
    project.write("source/in.txt", "text\n");
    project
        .write("pipeline.yaml", &PIPELINE.replace("{a: ./source}", "{a: ./source, b: ./source}"));
    assert_eq!(why(&[])[0], "first: will run: input b: absent → ##########");
    project.write("pipeline.yaml", &PIPELINE.replace(", inputs: {a: ./source}", ""));
    assert_eq!(why(&[])[0], "first: will run: input a: ########## → absent");
    project.write("pipeline.yaml", PIPELINE);
    // A stored artifact with a missing file.
    std::fs::remove_file(project.artifact("first", &[]).join("1.txt")).unwrap();
    assert_eq!(why(&[])[0], "first: will run: its artifact ########## is missing or incomplete");
    project.ok(&["run"]);
    // Records with another key version, or of another program under the block's name.
    change_key(&project, "first", "key version", &json!(1));
    assert_eq!(why(&[])[0], "first: will run: key version: 1 → 2");
    project.ok(&["run"]);
    change_key(&project, "first", "stage", &json!("blend"));
    assert_eq!(why(&[])[0], "first: will run: stage: \"blend\" → \"mix\"");
    project.ok(&["run"]);
    // A run of another block caches the new program's description.
    project.program("mix", &format!("{PROGRAM}# changed\n"));
    project.write("pipeline.yaml", &format!("{PIPELINE}  third: {{run: ./mix}}\n"));
    project.ok(&["run", "third"]);
    let code = why(&[]).remove(0);
    assert!(
        code.starts_with("first: will run: code: \"")
            && code.contains("\" → \"")
            && !code.contains(';'),
        "{code}"
    );
}

#[test]
fn diff_reports_each_difference() {
    let project = project();
    project.ok(&["run", "-p", "first.count=1,2,6"]);
    let diff = |before: &str, now: &str| output_lines(&project, &["diff", before, now]);
    let two = [
        "first: metric mean.psnr: 31.25 → 32.25 (+1.0000)",
        "first: parameter count: 1 → 2",
        "first: resolved steps: 256 → 512",
        "first: file 1.txt: ########## → ##########",
        "first: file 2.txt: absent → ##########",
    ];
    assert_eq!(diff("first", "first -p first.count=2"), two);
    // More than four changed files are counted instead of listed.
    let six = diff("first", "first -p first.count=6");
    assert_eq!(six[3..], ["first: 6 files differ, such as 1.txt"]);
    // `diff` omits an input's hash, which follows from the stage that created the input.
    let both_stages = [&two[..], &["second: file 1.txt: ########## → ##########"]].concat();
    assert_eq!(diff("second", "second -p first.count=2"), both_stages);
    assert_eq!(diff("first", "first"), ["no differences"]);
    assert_eq!(diff("first", "second"), ["second: stage: absent → \"mix\""]);
    assert_eq!(diff("second", "first"), ["second: stage: \"mix\" → absent"]);
    let report: Value =
        serde_json::from_str(&project.ok(&["diff", "--json", "first", "first -p first.count=6"]))
            .unwrap();
    let names: Vec<&str> = report[0]["changes"]
        .as_array()
        .unwrap()
        .iter()
        .map(|change| change["name"].as_str().unwrap())
        .collect();
    let files =
        ["file 1.txt", "file 2.txt", "file 3.txt", "file 4.txt", "file 5.txt", "file 6.txt"];
    assert_eq!(
        names,
        [&files[..], &["metric mean.psnr", "parameter count", "resolved steps"]].concat()
    );
    assert_eq!(
        report[0]["changes"][6],
        json!({"name": "metric mean.psnr", "before": 31.25, "now": 36.25})
    );
    // Without an artifact, `diff` still reports the differences between records.
    project.ok(&["pin", "one"]);
    project.ok(&["pin", "two", "-p", "first.count=2"]);
    std::fs::remove_dir_all(project.artifact("first", &["-p", "first.count=2"])).unwrap();
    let records = ["first: artifact: \"kept\" → \"gone\"", two[1], both_stages[5]];
    assert_eq!(diff("one", "two"), records);
}

fn run_and_pin(project: &Project, name: &str, mode: &str) {
    for verb in [&["run", "first"][..], &["pin", name, "first"]] {
        assert!(project.command(verb).env("MIX_MODE", mode).output().unwrap().status.success());
    }
}

/// Differences outside the pipeline's parameters are reported as well.
#[test]
fn diff_reports_code_environment_and_sources() {
    let project = project();
    run_and_pin(&project, "one", "");
    project.write("source/unread.md", "more\n");
    project.program("mix", &format!("{PROGRAM}# changed\n"));
    run_and_pin(&project, "two", " ");
    let lines = output_lines(&project, &["diff", "one", "two"]);
    let starts: Vec<&str> = lines
        .iter()
        .map(|line| line.split_once(": \"").map_or(line.as_str(), |(start, _)| start))
        .collect();
    assert_eq!(starts[..2], ["first: code", "first: environment MIX_MODE"], "{lines:?}");
    assert_eq!(
        lines[2..],
        ["first: input a: ########## → ##########", "first: file 1.txt: ########## → ##########"]
    );
}
