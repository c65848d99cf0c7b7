//! Stages that share a machine: their usage is recorded, and the next run schedules by it.

#![allow(missing_docs, reason = "a test")]
mod common;

use common::Project;
use serde_json::Value;

/// A stage that takes some memory for a while, keeps one core busy, and writes when it began and
/// ended and how many threads it had. With a file `together` next to it, it runs until that
/// number of stages has started, or for a minute.
const HUNGRY: &str = r#"#!/usr/bin/env python3
import json, os, pathlib, sys, time
if sys.argv[1:] == ["describe"]:
    number = {"type": "number"}
    properties = {name: {**number, "default": 0} for name in ["mb", "seconds", "x"]}
    schema = {"type": "object", "properties": properties, "additionalProperties": False}
    print(json.dumps({"name": "hungry", "version": "1", "code": "1", "summary": "Takes.", "parameters": schema, "inputs": {},
                      "output": {"kind": "text"}}))
    sys.exit()
given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
wanted = json.load(open(given["--params"]))
began = time.time()
held = bytearray(b"x") * int(wanted["mb"] * 1e6)
here = pathlib.Path(__file__).parent
def is_alone():
    return (here / "together").exists() and len(list(here.glob("begun-*"))) < int((here / "together").read_text())
if (here / "together").exists(): (here / f"begun-{os.getpid()}").touch()
while time.time() < began + wanted["seconds"] or (is_alone() and time.time() < began + 60):
    pass
os.mkdir(given["--output"])
json.dump({"began": began, "ended": time.time(), "threads": given["--threads"], "x": wanted["x"]}, open(given["--output"] + "/it.json", "w"))
"#;

fn project(pipeline: &str) -> Project {
    let project = Project::new(pipeline);
    project.program("hungry", HUNGRY);
    project
}

const ALONE: &str = "default: [hungry]
stages:
  hungry: {run: ./hungry, parameters: {mb: 200, seconds: 0.6}}
";

/// Returns the output of each point of a sweep.
fn written(project: &Project, arguments: &[&str]) -> Vec<Value> {
    let outputs = project.output_of("hungry", arguments);
    let read = |output: &String| std::fs::read(project.object(output).join("it.json")).unwrap();
    outputs.iter().map(|output| serde_json::from_slice(&read(output)).unwrap()).collect()
}

fn lie_apart(spans: &[Value]) -> bool {
    let time = |span: &Value, name: &str| span[name].as_f64().unwrap();
    spans.iter().enumerate().all(|(i, one)| {
        spans[..i].iter().all(|other| {
            time(one, "began") >= time(other, "ended") || time(other, "began") >= time(one, "ended")
        })
    })
}

#[test]
fn memory_and_processor_time_are_recorded() {
    let project = project(ALONE);
    project.ok(&["run"]);
    let status: Value = serde_json::from_str(&project.ok(&["status", "--json"])).unwrap();
    let (memory, busy) = (
        status["nodes"][0]["peak_memory"].as_f64().unwrap(),
        status["nodes"][0]["processor_seconds"].as_f64().unwrap(),
    );
    assert!((2.0e8..2.6e8).contains(&memory), "200 MB and the interpreter's: {memory}");
    // Beside other work a core isn't a stage's own for all of its time.
    assert!((0.05..2.0).contains(&busy), "{busy}");
}

#[test]
fn memory_gives_places() {
    let project = project(ALONE);
    project.ok(&["run"]);
    let refused = project.run(&["run", "-p", "x=1", "--memory", "100M"]);
    refused.fails(
        1,
        &[
            "hungry: failed: needs 2",
            "MB of memory, as in its most similar earlier run, but the limit is 104.9 MB; change",
        ],
    );
    let sweep = ["-p", "x=1,2"];
    let waited = project
        .run(&[&["run", "-j", "2", "--threads", "8", "--memory", "400M"][..], &sweep].concat());
    assert_eq!(waited.code, 0, "{}", waited.stderr);
    let said = waited.stderr.lines().filter(|line| line.contains("hungry [x=2]: waiting: needs 2"));
    assert_eq!(said.count(), 1, "{}", waited.stderr);
    assert!(lie_apart(&written(&project, &sweep)), "one after the other");
    let sweep = ["-p", "x=3,4"];
    project.write("together", "2");
    project.ok(&[&["run", "-j", "2", "--threads", "8", "--memory", "1G"][..], &sweep].concat());
    assert!(!lie_apart(&written(&project, &sweep)), "side by side");
}

#[test]
fn a_cached_stage_takes_no_place_and_one_left_alone_has_all_threads() {
    let project = project(ALONE);
    let sweep = ["-p", "x=1,2,3,4,5,6,7,8"];
    project.ok(&["run", "-p", "x=1,2,3,4,5,6,7", "-p", "seconds=0", "--threads", "1"]);
    project.ok(&[&["run", "-p", "seconds=0", "-j", "8", "--threads", "5"], &sweep[..]].concat());
    let threads: Vec<String> = written(&project, &[&sweep[..], &["-p", "seconds=0"]].concat())
        .iter()
        .map(|one| one["threads"].as_str().unwrap().to_owned())
        .collect();
    assert_eq!(threads, ["1", "1", "1", "1", "1", "1", "1", "5"]);
}

/// A record that an earlier version wrote, and one with a field of a later version.
#[test]
fn records_of_other_versions_are_read() {
    let project = project(ALONE);
    project.ok(&["run"]);
    let action =
        std::fs::read_dir(project.path(".nerf-sr/actions")).unwrap().map(|e| e.unwrap().path());
    let file =
        action.into_iter().find(|path| path.extension().is_some_and(|end| end == "json")).unwrap();
    let mut record: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let fields = record.as_object_mut().unwrap();
    assert!(fields.remove("peak_memory").is_some() && fields.remove("processor_seconds").is_some());
    fields.insert("of_a_later_version".to_owned(), Value::from(1));
    std::fs::write(&file, record.to_string()).unwrap();
    assert_eq!(project.ok(&["run"]), "nothing to run: the stage is cached\n");
}
