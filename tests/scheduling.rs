//! Stages that share a machine: their usage is recorded, and the runner schedules by the records.

#![allow(missing_docs, reason = "a test")]
mod common;

use common::Project;
use serde_json::Value;

/// Stage that occupies memory and one core for a given time, and writes its start, end and number
/// of threads. With a file `together` next to the program, the stage runs until the number of
/// stages in this file has started, or for a minute.
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

const ONE_STAGE: &str = "default: [hungry]
stages:
  hungry: {run: ./hungry, parameters: {mb: 200, seconds: 0.6}}
";

/// Returns the content of each output of a sweep.
fn read_outputs(project: &Project, arguments: &[&str]) -> Vec<Value> {
    let outputs = project.output_of("hungry", arguments);
    let read = |output: &String| std::fs::read(project.object(output).join("it.json")).unwrap();
    outputs.iter().map(|output| serde_json::from_slice(&read(output)).unwrap()).collect()
}

fn are_disjoint(spans: &[Value]) -> bool {
    let time = |span: &Value, name: &str| span[name].as_f64().unwrap();
    spans.iter().enumerate().all(|(i, span)| {
        spans[..i].iter().all(|other| {
            time(span, "began") >= time(other, "ended")
                || time(other, "began") >= time(span, "ended")
        })
    })
}

#[test]
fn memory_and_processor_time_are_recorded() {
    let project = project(ONE_STAGE);
    project.ok(&["run"]);
    let status: Value = serde_json::from_str(&project.ok(&["status", "--json"])).unwrap();
    let (memory, processor_seconds) = (
        status["nodes"][0]["peak_memory"].as_f64().unwrap(),
        status["nodes"][0]["processor_seconds"].as_f64().unwrap(),
    );
    assert!(
        (2.0e8..2.6e8).contains(&memory),
        "expected 200 MB and the interpreter's memory, found {memory}"
    );
    // Other processes may use the stage's core for a part of the time.
    assert!((0.05..2.0).contains(&processor_seconds), "{processor_seconds}");
}

#[test]
fn memory_limits_parallel_stages() {
    let project = project(ONE_STAGE);
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
    let lines =
        waited.stderr.lines().filter(|line| line.contains("hungry [x=2]: waiting: needs 2"));
    assert_eq!(lines.count(), 1, "{}", waited.stderr);
    assert!(
        are_disjoint(&read_outputs(&project, &sweep)),
        "the stages must run one after the other"
    );
    let sweep = ["-p", "x=3,4"];
    project.write("together", "2");
    project.ok(&[&["run", "-j", "2", "--threads", "8", "--memory", "1G"][..], &sweep].concat());
    assert!(!are_disjoint(&read_outputs(&project, &sweep)), "the stages must run in parallel");
}

#[test]
fn cached_stages_leave_all_threads_to_the_running_one() {
    let project = project(ONE_STAGE);
    let sweep = ["-p", "x=1,2,3,4,5,6,7,8"];
    project.ok(&["run", "-p", "x=1,2,3,4,5,6,7", "-p", "seconds=0", "--threads", "1"]);
    project.ok(&[&["run", "-p", "seconds=0", "-j", "8", "--threads", "5"], &sweep[..]].concat());
    let threads: Vec<String> = read_outputs(&project, &[&sweep[..], &["-p", "seconds=0"]].concat())
        .iter()
        .map(|output| output["threads"].as_str().unwrap().to_owned())
        .collect();
    assert_eq!(threads, ["1", "1", "1", "1", "1", "1", "1", "5"]);
}

/// A record without fields of this version and with a field of a later version is read.
#[test]
fn records_of_other_versions_are_read() {
    let project = project(ONE_STAGE);
    project.ok(&["run"]);
    let paths =
        std::fs::read_dir(project.path(".nerf-sr/actions")).unwrap().map(|e| e.unwrap().path());
    let file = paths
        .into_iter()
        .find(|path| path.extension().is_some_and(|extension| extension == "json"))
        .unwrap();
    let mut record: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let fields = record.as_object_mut().unwrap();
    assert!(fields.remove("peak_memory").is_some() && fields.remove("processor_seconds").is_some());
    fields.insert("of_a_later_version".to_owned(), Value::from(1));
    std::fs::write(&file, record.to_string()).unwrap();
    assert_eq!(project.ok(&["run"]), "nothing to run: the stage is cached\n");
}
