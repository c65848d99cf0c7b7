//! Property: `plan` and `run` agree, over random pipelines, edits and overrides. NERF_SR_SEED says
//! which.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

use common::Project;
use numerics::CounterRng;
use serde_json::Value;

/// A stage in shell. Its output follows from its inputs and from half of its value, that in `sub`
/// from the value alone: so a change may come out as before. It notes the key under which it ran.
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

/// A stage of the pipeline.
struct Block {
    program: u64,
    value: u64,
    /// Sources of inputs `a` and `b`.
    inputs: BTreeMap<&'static str, String>,
}

/// A project and all that is drawn for it.
struct World {
    project: Project,
    draws: CounterRng,
    blocks: Vec<Block>,
    /// `-p` and `-i` of the next commands.
    overrides: Vec<String>,
    edits: u64,
}

impl World {
    fn new(seed: u64, number: u64) -> Self {
        let mut world = Self {
            project: Project::new(""),
            draws: CounterRng::new(seed, 0, number),
            blocks: Vec::new(),
            overrides: Vec::new(),
            edits: 0,
        };
        for program in 0..PROGRAMS {
            world.write_program(program);
        }
        for source in 0..SOURCES {
            world.write_source(source);
        }
        for index in 0..1 + world.draws.below(STAGES) {
            let block = world.block(index);
            world.blocks.push(block);
        }
        world.write_pipeline();
        world
    }

    fn block(&mut self, index: u64) -> Block {
        let mut inputs = BTreeMap::from([("a", self.origin(index))]);
        if self.draws.below(2) == 0 {
            inputs.insert("b", self.origin(index));
        }
        Block { program: self.draws.below(PROGRAMS), value: self.draws.below(6), inputs }
    }

    /// A source, or an earlier stage or a folder of it.
    fn origin(&mut self, index: u64) -> String {
        match self.draws.below(index + 1) {
            0 => format!("./source{}", self.draws.below(SOURCES)),
            stage => format!("s{}{}", stage - 1, ["", "/sub"][self.draws.below(2) as usize]),
        }
    }

    fn write_program(&mut self, program: u64) {
        self.edits += 1;
        self.project
            .program(&format!("p{program}"), &format!("{PROGRAM}# p{program}, {}\n", self.edits));
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

    /// Changes something.
    fn edit(&mut self) {
        let index = self.draws.below(self.blocks.len() as u64) as usize;
        match self.draws.below(9) {
            0 => self.blocks[index].value = self.draws.below(6),
            1 => self.blocks[index] = self.block(index as u64),
            2 => {
                let source = self.draws.below(SOURCES);
                self.write_source(source);
            }
            3 => {
                let program = self.draws.below(PROGRAMS);
                self.write_program(program);
            }
            4 => {
                self.overrides = vec!["-p".to_owned(), format!("s{index}.value={}", self.values())];
            }
            5 => {
                self.overrides = vec![
                    "-i".to_owned(),
                    format!("s{index}.a=./source{}", self.draws.below(SOURCES)),
                ];
            }
            6 => self.harm("objects", "/all.txt"),
            7 => self.harm("actions", ""),
            _ => self.add_or_remove(),
        }
        self.write_pipeline();
    }

    /// Adds a stage at the end, or takes the last away.
    fn add_or_remove(&mut self) {
        self.overrides.clear();
        if self.blocks.len() > 1 && self.draws.below(2) == 0 {
            self.blocks.pop();
        } else {
            let block = self.block(self.blocks.len() as u64);
            self.blocks.push(block);
        }
    }

    /// Keys that have a record, each with whether its artifact is whole: what a run needn't make.
    fn records(&self) -> BTreeMap<String, bool> {
        let store = store::Store::open(&self.project.path(".nerf-sr")).unwrap();
        let keys = store.records().unwrap().into_iter().map(|record| record.key());
        keys.map(|key| (key.clone(), store.hit(&key).unwrap().is_some())).collect()
    }

    /// One value or a sweep's.
    fn values(&mut self) -> String {
        let values: BTreeSet<u64> =
            (0..1 + self.draws.below(3)).map(|_| self.draws.below(6)).collect();
        values.iter().map(u64::to_string).collect::<Vec<_>>().join(",")
    }

    /// Cuts a file of the store short, or takes it away: one of a folder, or one below an entry of
    /// it.
    fn harm(&mut self, folder: &str, below: &str) {
        let entries = std::fs::read_dir(self.project.path(".nerf-sr").join(folder)).unwrap();
        let paths = entries
            .map(|entry| entry.unwrap().path().into_os_string().into_string().unwrap() + below);
        let mut paths: Vec<String> = paths.filter(|path| Path::new(path).is_file()).collect();
        paths.sort();
        let chosen = &paths[self.draws.below(paths.len() as u64) as usize];
        if self.draws.below(2) == 0 {
            std::fs::remove_file(chosen).unwrap();
        } else {
            std::fs::write(chosen, "").unwrap();
        }
    }

    fn words<'a>(&'a self, verb: &[&'a str]) -> Vec<&'a str> {
        verb.iter().copied().chain(self.overrides.iter().map(String::as_str)).collect()
    }

    /// The nodes as a looking verb has them; none where it doesn't start a new program before a run
    /// has.
    fn nodes(&self, verb: &[&str]) -> Vec<Value> {
        let finished = self.project.run(&self.words(verb));
        if finished.stderr.contains("check what the program does, then start it") {
            return Vec::new();
        }
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        let report: Value = serde_json::from_str(&finished.stdout).unwrap();
        report["nodes"].as_array().unwrap().clone()
    }

    /// Runs all; the keys that ran, sorted.
    fn run(&self, more: &[&str]) -> Vec<String> {
        let ran = self.project.path("ran");
        std::fs::remove_file(&ran).ok();
        self.project.ok(&[&self.words(&["run"])[..], more].concat());
        let mut keys: Vec<String> =
            std::fs::read_to_string(ran).unwrap_or_default().lines().map(str::to_owned).collect();
        keys.sort();
        keys
    }
}

fn text(node: &Value, name: &str) -> String {
    node[name].as_str().unwrap_or_default().to_owned()
}

/// Keys of the nodes in a state, each once: two stages that do the same have one.
fn keys(nodes: &[Value], state: &str) -> BTreeSet<String> {
    nodes.iter().filter(|node| node["state"] == state).map(|node| text(node, "key")).collect()
}

#[test]
fn plan_and_run_agree() {
    let seed = std::env::var("NERF_SR_SEED")
        .map_or_else(|_| std::process::id().into(), |text| text.parse().unwrap());
    let mut planned = 0;
    for number in 0..12 {
        let mut world = World::new(seed, number);
        world.run(&[]);
        for edit in 0..8 {
            let place = format!("seed {seed}, pipeline {number}, edit {edit}");
            world.edit();
            let pipeline = std::fs::read_to_string(world.project.path("pipeline.yaml")).unwrap();
            let place = format!("{place}: {:?}\n{pipeline}", world.overrides);
            let records = world.records();
            let before = world.nodes(&["plan", "--json"]);
            planned += before.len();
            let ran = world.run(&[]);
            let distinct: BTreeSet<String> = ran.iter().cloned().collect();
            assert_eq!(distinct.len(), ran.len(), "each key once; {place}");
            let after = world.nodes(&["status", "--json"]);
            assert!(after.iter().all(|node| node["state"] == "cached"), "{place}");
            // What the plan said of each node: whether it runs, and under which key; or that its
            // key isn't known.
            assert!(keys(&before, "cached").is_disjoint(&distinct), "cached, and ran; {place}");
            for (planned, node) in before.iter().zip(&after) {
                assert_eq!(
                    [&planned["stage"], &planned["point"]],
                    [&node["stage"], &node["point"]],
                    "{place}"
                );
                assert!(planned["state"] == "waits" || planned["key"] == node["key"], "{place}");
            }
            // What was there didn't run. What wasn't did, but where another key made the artifact
            // again.
            let ran_now = |node: &Value| distinct.contains(&text(node, "key"));
            let made: BTreeSet<String> = after
                .iter()
                .filter(|node| ran_now(node))
                .map(|node| text(node, "output"))
                .collect();
            for node in &after {
                let known = records.get(&text(node, "key"));
                let made_by_another = known.is_some() && made.contains(&text(node, "output"));
                let was_there = known == Some(&true);
                assert!(
                    if was_there { !ran_now(node) } else { ran_now(node) || made_by_another },
                    "{node}; {place}"
                );
            }
            assert!(distinct.is_subset(&keys(&after, "cached")), "nothing else ran; {place}");
            assert_eq!(world.run(&[]), Vec::<String>::new(), "{place}");
        }
        // Whatever came of it is what a store that knows nothing gets.
        let outputs =
            |nodes: &[Value]| nodes.iter().map(|node| text(node, "output")).collect::<Vec<_>>();
        let kept = outputs(&world.nodes(&["status", "--json"]));
        world.run(&["--store", "fresh"]);
        assert_eq!(
            kept,
            outputs(&world.nodes(&["status", "--json", "--store", "fresh"])),
            "seed {seed}, pipeline {number}"
        );
    }
    assert!(planned > 50, "{planned} nodes were planned");
}
