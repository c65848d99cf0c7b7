//! Property test: `plan` and `run` agree, for pipelines, edits and overrides drawn from
//! NERF_SR_SEED.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

use common::Project;
use numerics::CounterRng;
use serde_json::Value;

/// Stage as a shell script. The output depends on the inputs and on half of `value`, rounded down;
/// the subtree `sub` depends on this half alone. So a new value may leave the output unchanged. The
/// stage appends its key to `ran`.
const PROGRAM: &str = r#"#!/bin/sh
if [ "$1" = describe ]; then
    input='{"kinds": ["text"], "summary": "a text", "optional": true}'
    echo '{"name": "mix", "version": "1", "code": "'$(cksum < "$0")'", "summary": "Mixes.", "inputs": {"a": '$input', "b": '$input'},
      "parameters": {"type": "object", "properties": {"value": {"type": "number", "default": 0}}}, "output": {"kind": "text", "subtrees": {"sub": "text"}}}'
    exit
fi
texts=
while [ $# -gt 0 ]; do
    case $1 in
        --output) out=$2 ;;
        --params) value=$(tr -dc 0-9 < "$2") ;;
        --input) texts="$texts $(echo "$2" | cut -d= -f1) $(cat "${2#*=}"/*.txt)" ;;
    esac
    shift
done
mkdir -p "$out/sub"
echo "$texts $((value / 2))" | cksum > "$out/all.txt"
echo "$((value / 2))" > "$out/sub/half.txt"
basename "$(dirname "$out")" >> "$(dirname "$0")/ran"
"#;

const SOURCES: u64 = 2;
const PROGRAMS: u64 = 2;
const STAGES: u64 = 5;

/// Stage of a pipeline.
struct Block {
    program: u64,
    value: u64,
    /// Sources of inputs `a` and `b`.
    inputs: BTreeMap<&'static str, String>,
}

/// Test case: a project with a randomly drawn pipeline.
struct Case {
    project: Project,
    draws: CounterRng,
    blocks: Vec<Block>,
    /// Arguments `-p` and `-i` of the next commands.
    overrides: Vec<String>,
    /// Number of programs written so far, which makes each program unique.
    written_programs: u64,
}

impl Case {
    fn new(seed: u64, number: u64) -> Self {
        let mut case = Self {
            project: Project::new(""),
            draws: CounterRng::new(seed, 0, number),
            blocks: Vec::new(),
            overrides: Vec::new(),
            written_programs: 0,
        };
        for program in 0..PROGRAMS {
            case.write_program(program);
        }
        for source in 0..SOURCES {
            case.write_source(source);
        }
        for index in 0..1 + case.draws.below(STAGES) {
            let block = case.draw_block(index);
            case.blocks.push(block);
        }
        case.write_pipeline();
        case
    }

    fn draw_block(&mut self, index: u64) -> Block {
        let mut inputs = BTreeMap::from([("a", self.draw_input(index))]);
        if self.draws.below(2) == 0 {
            inputs.insert("b", self.draw_input(index));
        }
        Block { program: self.draws.below(PROGRAMS), value: self.draws.below(6), inputs }
    }

    /// Draws an input: a source, an earlier stage or an earlier stage's subtree.
    fn draw_input(&mut self, index: u64) -> String {
        match self.draws.below(index + 1) {
            0 => format!("./source{}", self.draws.below(SOURCES)),
            stage => format!("s{}{}", stage - 1, ["", "/sub"][self.draws.below(2) as usize]),
        }
    }

    fn write_program(&mut self, program: u64) {
        self.written_programs += 1;
        self.project.program(
            &format!("p{program}"),
            &format!("{PROGRAM}# p{program}, {}\n", self.written_programs),
        );
    }

    fn write_source(&mut self, source: u64) {
        let text = format!("{}\n", self.draws.below(1000));
        self.project.write(&format!("source{source}/in.txt"), &text);
    }

    fn write_pipeline(&self) {
        let names: Vec<String> = (0..self.blocks.len()).map(|index| format!("s{index}")).collect();
        let mut text = format!("default: [{}]\nstages:\n", names.join(", "));
        for (name, Block { program, value, inputs }) in names.iter().zip(&self.blocks) {
            let inputs: Vec<String> =
                inputs.iter().map(|(name, from)| format!("{name}: {from}")).collect();
            writeln!(
                text,
                "  {name}: {{run: ./p{program}, inputs: {{{}}}, parameters: {{value: {value}}}}}",
                inputs.join(", ")
            )
            .unwrap();
        }
        self.project.write("pipeline.yaml", &text);
    }

    /// Makes a random change of the pipeline, a program, a source, the overrides or the store.
    fn edit(&mut self) {
        let index = self.draws.below(self.blocks.len() as u64) as usize;
        match self.draws.below(9) {
            0 => self.blocks[index].value = self.draws.below(6),
            1 => self.blocks[index] = self.draw_block(index as u64),
            2 => {
                let source = self.draws.below(SOURCES);
                self.write_source(source);
            }
            3 => {
                let program = self.draws.below(PROGRAMS);
                self.write_program(program);
            }
            4 => {
                self.overrides =
                    vec!["-p".to_owned(), format!("s{index}.value={}", self.draw_values())];
            }
            5 => {
                self.overrides = vec![
                    "-i".to_owned(),
                    format!("s{index}.a=./source{}", self.draws.below(SOURCES)),
                ];
            }
            6 => self.damage_file("objects", "/all.txt"),
            7 => self.damage_file("actions", ""),
            _ => self.add_or_remove_stage(),
        }
        self.write_pipeline();
    }

    /// Adds a stage at the end or removes the last stage.
    fn add_or_remove_stage(&mut self) {
        self.overrides.clear();
        if self.blocks.len() > 1 && self.draws.below(2) == 0 {
            self.blocks.pop();
        } else {
            let block = self.draw_block(self.blocks.len() as u64);
            self.blocks.push(block);
        }
    }

    /// Returns the recorded keys; the value is true if the key's artifact is complete.
    fn records(&self) -> BTreeMap<String, bool> {
        let store = store::Store::open(&self.project.path(".nerf-sr")).unwrap();
        let keys = store.records().unwrap().into_iter().map(|record| record.key());
        keys.map(|key| (key.clone(), store.hit(&key).unwrap().is_some())).collect()
    }

    /// Draws the values of a parameter: one or, for a sweep, several.
    fn draw_values(&mut self) -> String {
        let values: BTreeSet<u64> =
            (0..1 + self.draws.below(3)).map(|_| self.draws.below(6)).collect();
        values.iter().map(u64::to_string).collect::<Vec<_>>().join(",")
    }

    /// Empties or deletes a random file of the store. The file's path is an entry of `folder`,
    /// followed by `suffix`.
    fn damage_file(&mut self, folder: &str, suffix: &str) {
        let entries = std::fs::read_dir(self.project.path(".nerf-sr").join(folder)).unwrap();
        let paths = entries
            .map(|entry| entry.unwrap().path().into_os_string().into_string().unwrap() + suffix);
        let mut paths: Vec<String> = paths.filter(|path| Path::new(path).is_file()).collect();
        paths.sort();
        let chosen = &paths[self.draws.below(paths.len() as u64) as usize];
        if self.draws.below(2) == 0 {
            std::fs::remove_file(chosen).unwrap();
        } else {
            std::fs::write(chosen, "").unwrap();
        }
    }

    fn with_overrides<'a>(&'a self, arguments: &[&'a str]) -> Vec<&'a str> {
        arguments.iter().copied().chain(self.overrides.iter().map(String::as_str)).collect()
    }

    /// Returns the nodes that `plan` or `status` reports, or none if the verb refuses to start a
    /// program that no run has started yet.
    fn nodes(&self, arguments: &[&str]) -> Vec<Value> {
        let finished = self.project.run(&self.with_overrides(arguments));
        if finished.stderr.contains("check what the program does, then start it") {
            return Vec::new();
        }
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        let report: Value = serde_json::from_str(&finished.stdout).unwrap();
        report["nodes"].as_array().unwrap().clone()
    }

    /// Runs all stages and returns the sorted keys of those that ran.
    fn run(&self, arguments: &[&str]) -> Vec<String> {
        let ran = self.project.path("ran");
        std::fs::remove_file(&ran).ok();
        self.project.ok(&[&self.with_overrides(&["run"])[..], arguments].concat());
        let mut keys: Vec<String> =
            std::fs::read_to_string(ran).unwrap_or_default().lines().map(str::to_owned).collect();
        keys.sort();
        keys
    }
}

fn text(node: &Value, name: &str) -> String {
    node[name].as_str().unwrap_or_default().to_owned()
}

/// Returns the distinct keys of the nodes in a state. Equal stages have one key.
fn keys(nodes: &[Value], state: &str) -> BTreeSet<String> {
    nodes.iter().filter(|node| node["state"] == state).map(|node| text(node, "key")).collect()
}

#[test]
fn plan_and_run_agree() {
    let seed = std::env::var("NERF_SR_SEED")
        .map_or_else(|_| std::process::id().into(), |text| text.parse().unwrap());
    let mut planned_count = 0;
    for number in 0..12 {
        let mut case = Case::new(seed, number);
        case.run(&[]);
        for edit in 0..8 {
            let context = format!("seed {seed}, pipeline {number}, edit {edit}");
            case.edit();
            let pipeline = std::fs::read_to_string(case.project.path("pipeline.yaml")).unwrap();
            let context = format!("{context}: {:?}\n{pipeline}", case.overrides);
            let records = case.records();
            let before = case.nodes(&["plan", "--json"]);
            planned_count += before.len();
            let ran = case.run(&[]);
            let distinct: BTreeSet<String> = ran.iter().cloned().collect();
            assert_eq!(distinct.len(), ran.len(), "each key runs once; {context}");
            let after = case.nodes(&["status", "--json"]);
            assert!(after.iter().all(|node| node["state"] == "cached"), "{context}");
            // The plan predicts each node's key and whether the node runs, unless the key isn't
            // known yet.
            assert!(keys(&before, "cached").is_disjoint(&distinct), "a cached key ran; {context}");
            for (planned, node) in before.iter().zip(&after) {
                assert_eq!(
                    [&planned["stage"], &planned["point"]],
                    [&node["stage"], &node["point"]],
                    "{context}"
                );
                assert!(planned["state"] == "waits" || planned["key"] == node["key"], "{context}");
            }
            // A node with a complete artifact doesn't run. Any other node runs, unless another key
            // recreates the artifact.
            let has_run = |node: &Value| distinct.contains(&text(node, "key"));
            let created: BTreeSet<String> = after
                .iter()
                .filter(|node| has_run(node))
                .map(|node| text(node, "output"))
                .collect();
            for node in &after {
                let record = records.get(&text(node, "key"));
                let is_recreated = record.is_some() && created.contains(&text(node, "output"));
                let was_complete = record == Some(&true);
                assert!(
                    if was_complete { !has_run(node) } else { has_run(node) || is_recreated },
                    "{node}; {context}"
                );
            }
            assert!(distinct.is_subset(&keys(&after, "cached")), "no other key runs; {context}");
            assert_eq!(case.run(&[]), Vec::<String>::new(), "{context}");
        }
        // An empty store gives equal outputs.
        let outputs =
            |nodes: &[Value]| nodes.iter().map(|node| text(node, "output")).collect::<Vec<_>>();
        let edited = outputs(&case.nodes(&["status", "--json"]));
        case.run(&["--store", "fresh"]);
        assert_eq!(
            edited,
            outputs(&case.nodes(&["status", "--json", "--store", "fresh"])),
            "seed {seed}, pipeline {number}"
        );
    }
    assert!(planned_count > 50, "{planned_count} nodes were planned");
}
