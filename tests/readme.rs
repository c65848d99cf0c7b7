//! The documents tell the truth: commands parse and plan, pipeline blocks are valid, the files they
//! name are there.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use common::{Finished, Project, bin};
use serde_json::Value;

/// Documents whose commands and blocks are checked, and folders that hold more of them.
const DOCUMENTS: [&str; 2] = ["README.md", "ARCHITECTURE.md"];
const FOLDERS: [&str; 2] = ["docs/guide", "docs/results"];
/// Documents of which only links are checked.
const LINKED: [&str; 4] =
    ["CONTRIBUTING.md", "CHANGELOG.md", "docs/glossary.md", "docs/comparison.md"];
const LINKED_FOLDERS: [&str; 1] = ["docs/design"];

/// Documents that measure nothing themselves.
const GUIDES: &str = "docs/guide";
const RESULTS: &str = "docs/results";
/// Units of measured figures, and how results may spell each.
const UNITS: [&[&str]; 9] = [
    &["dB"],
    &["ms", "milliseconds", "millisecond"],
    &["s", "seconds", "second"],
    &["min", "minutes", "minute"],
    &["h", "hours", "hour"],
    &["KB", "kB"],
    &["MB"],
    &["GB"],
    &["%"],
];

fn read(path: impl AsRef<Path>) -> String {
    std::fs::read_to_string(common::root().join(path)).unwrap()
}

/// Paths of documents, from the root: those named, and every Markdown file of the folders.
fn paths(files: &[&str], folders: &[&str]) -> Vec<String> {
    let mut paths: Vec<String> = files.iter().map(|file| (*file).to_owned()).collect();
    for folder in folders {
        let entries = std::fs::read_dir(common::root().join(folder)).unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.retain(|name| name.ends_with(".md"));
        names.sort();
        assert!(!names.is_empty(), "no documents in {folder}");
        paths.extend(names.iter().map(|name| format!("{folder}/{name}")));
    }
    paths
}

fn documents() -> String {
    paths(&DOCUMENTS, &FOLDERS).iter().map(|path| read(path) + "\n").collect()
}

/// Contents of the fenced blocks of a language.
fn blocks(text: &str, language: &str) -> Vec<String> {
    let fence = format!("```{language}\n");
    text.split(&fence).skip(1).map(|rest| rest.split("```").next().unwrap().to_owned()).collect()
}

/// The words of a command line, without quotes.
fn words_of(line: &str) -> Vec<&str> {
    let pieces = line.split('"').enumerate();
    pieces
        .flat_map(
            |(i, piece)| if i % 2 == 1 { vec![piece] } else { piece.split_whitespace().collect() },
        )
        .collect()
}

#[test]
fn every_command_plans() {
    let project = Project::new(&read("pipeline.yaml"));
    // Folders that the examples name.
    for folder in [
        "my-scene",
        "my-photographs",
        "weights",
        "../shared/data/nerf_synthetic/lego",
        "../shared/data/nerf_synthetic/chair",
        "../shared/data/weights",
    ] {
        let target = project.path("project").join(folder);
        std::fs::create_dir_all(&target).unwrap();
        std::fs::write(target.join("x"), "").unwrap();
    }
    std::fs::rename(project.path("pipeline.yaml"), project.path("project/pipeline.yaml")).unwrap();
    for folder in ["pipelines", "experiments"] {
        project.copy_folder(folder, "project");
    }
    let mut planned = 0;
    for block in blocks(&documents(), "sh") {
        let joined = block.replace("\\\n", " ");
        for line in joined.lines().map(|l| l.split('#').next().unwrap().trim()) {
            let Some(rest) = line
                .strip_prefix("nerf-sr ")
                .or_else(|| line.strip_prefix("target/release/nerf-sr "))
            else {
                assert!(
                    line.is_empty()
                        || line.starts_with("make ")
                        || line.starts_with("cd ")
                        || line.starts_with("export ")
                        || line.starts_with("nerf-sr-remote ")
                        || line.contains("--help")
                        || line.contains("describe"),
                    "{line}"
                );
                continue;
            };
            let mut words = words_of(rest);
            // It overwrites nothing, and here there is a pipeline.
            if words[0] == "init" {
                continue;
            }
            // What isn't made yet can't be pinned, found or compared.
            match words[0] {
                "pin" => _ = words.splice(..2, ["plan"]),
                "path" => words = vec!["plan", words[1].split('/').next().unwrap()],
                "diff" => words = ["plan"].into_iter().chain(words[1].split_whitespace()).collect(),
                _ => {}
            }
            // Nor can it be an input.
            if let Some(at) = words.iter().position(|word| *word == "init=train-ss") {
                words.drain(at - 1..=at);
            }
            // `run` would train for minutes; the plan is the same code up to running. It has no use
            // for run's own options.
            if words[0] == "run" {
                words[0] = "plan";
                words.retain(|word| !word.starts_with("--watch"));
                while let Some(at) =
                    words.iter().position(|w| ["-j", "--threads", "--memory", "--out"].contains(w))
                {
                    words.drain(at..at + 2);
                }
            }
            let output =
                project.command(&words).current_dir(project.path("project")).output().unwrap();
            assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
            planned += 1;
        }
    }
    assert!(planned >= 8, "the README shows the runner's verbs");
}

#[test]
fn every_make_target_exists() {
    let makefile = read("Makefile");
    for block in blocks(&documents(), "sh") {
        for line in block.lines().filter_map(|l| l.trim().strip_prefix("make ")) {
            let target = line.split_whitespace().next().unwrap();
            assert!(makefile.contains(&format!("\n{target}:")), "no make target {target}");
        }
    }
}

#[test]
fn pipeline_blocks_are_valid() {
    let blocks = blocks(&documents(), "yaml");
    assert!(!blocks.is_empty());
    for block in blocks {
        let project = Project::tiny();
        std::fs::create_dir(project.path("scripts")).unwrap();
        let script = common::root().join("scripts/example-eval.py");
        std::fs::copy(script, project.path("scripts/example-eval.py")).unwrap();
        // Each block replaces the stage of its name.
        let name = block.lines().next().unwrap().trim().trim_end_matches(':').to_owned();
        let text = std::fs::read_to_string(project.path("pipeline.yaml")).unwrap();
        let start = text.find(&format!("  {name}:")).unwrap();
        let after = &text[start + 3..];
        let end = after
            .match_indices("\n  ")
            .map(|(i, _)| i + 1)
            .find(|&i| !after[i + 2..].starts_with(' '))
            .unwrap_or(after.len());
        project.write("pipeline.yaml", &format!("{}{block}{}", &text[..start], &after[end..]));
        if block.contains("run: ./") {
            // Somebody's program: it is for `run` to start.
            project.run(&["plan"]).fails(2, &["check what the program does"]);
            project.ok(&["run"]);
        }
        project.ok(&["plan"]);
    }
}

/// The code cells of a notebook.
fn code_cells(notebook: &str) -> Vec<String> {
    let notebook: Value = serde_json::from_str(&read(notebook)).unwrap();
    let cells = notebook["cells"].as_array().unwrap().iter();
    let code = cells.filter(|cell| cell["cell_type"] == "code");
    let lines = code.map(|cell| cell["source"].as_array().unwrap().iter());
    lines.map(|lines| lines.map(|line| line.as_str().unwrap()).collect()).collect()
}

/// The notebook's programs, which are the guide's, run one after the other, next to a finished run.
#[test]
fn programs_of_the_notebook_run() {
    let modules = ["-c", "import numpy, pandas, OpenEXR"];
    let has = Command::new("python3").args(modules).output();
    if !has.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: no numpy, pandas or OpenEXR (python3 -m pip install them)");
        return;
    }
    let project = Project::shipped(&["video"], "  report:\n    inputs: {run: eval}\n");
    project.ok(&["run", "report"]);
    let programs = bin("nerf-sr").parent().unwrap().to_owned();
    let path = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths([programs].into_iter().chain(std::env::split_paths(&path)));
    let path = path.unwrap();
    let blocks = code_cells("docs/guide/python.ipynb");
    let words = [&["eval", "psnr", "seconds"][..], &["view_0 (48, 48, 4)", "view_2 (48, 48, 4)"]];
    assert_eq!(blocks.len(), words.len());
    for (block, words) in blocks.iter().zip(words) {
        assert!(block.lines().count() <= 30);
        let mut python = project.command_of(Path::new("python3"), &["-c", block]);
        let finished = Finished::of(python.env("PATH", &path).output().unwrap());
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        assert!(words.iter().all(|word| finished.stdout.contains(word)), "{}", finished.stdout);
    }
}

#[test]
fn links_lead_somewhere() {
    let files = [&DOCUMENTS[..], &LINKED[..]].concat();
    let folders = [&FOLDERS[..], &LINKED_FOLDERS[..]].concat();
    for document in paths(&files, &folders) {
        let folder = common::root().join(&document).parent().unwrap().to_owned();
        for target in
            read(&document).split("](").skip(1).map(|rest| rest.split([')', '#']).next().unwrap())
        {
            assert!(folder.join(target).exists(), "{document}: {target} is not there");
        }
    }
}

#[test]
fn the_changelog_begins_with_this_version() {
    let changelog = read("CHANGELOG.md");
    let first = changelog.lines().find_map(|line| line.strip_prefix("## ")).unwrap();
    assert_eq!(first.split(' ').next(), Some(env!("CARGO_PKG_VERSION")));
}

fn is_number(word: &str) -> bool {
    word.starts_with(|c: char| c.is_ascii_digit())
        && word.chars().all(|c| c.is_ascii_digit() || c == '.')
}

/// Splits a text at everything that belongs to no number and no unit.
fn tokens(text: &str) -> Vec<&str> {
    text.split(|c: char| !c.is_alphanumeric() && c != '.' && c != '%')
        .map(|token| token.trim_end_matches('.'))
        .filter(|token| !token.is_empty())
        .collect()
}

/// Numbers with a unit outside code, such as `4.5 GB`, with the unit's first spelling.
fn with_unit(text: &str) -> BTreeSet<String> {
    let prose: String = text.split("```").step_by(2).collect();
    let words = tokens(&prose);
    let mut found = BTreeSet::new();
    for (i, word) in words.iter().enumerate() {
        // Number and unit may be one word: 90s.
        let split = word.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(word.len());
        let (number, glued) = word.split_at(split);
        let unit = if glued.is_empty() { words.get(i + 1).unwrap_or(&"") } else { glued };
        if is_number(number)
            && let Some(unit) = UNITS.iter().find(|spellings| spellings.contains(&unit))
        {
            found.insert(format!("{number} {}", unit[0]));
        }
    }
    found
}

/// Numbers with two or more decimals in a text's tables: scores.
fn scores(text: &str) -> BTreeSet<String> {
    let rows = text.lines().filter(|line| line.starts_with('|'));
    rows.flat_map(tokens)
        .filter(|word| is_number(word))
        .filter(|word| word.split_once('.').is_some_and(|(_, decimals)| decimals.len() >= 2))
        .map(str::to_owned)
        .collect()
}

/// Figures of `text` that are not in `results`. A number with decimals may be anywhere in them, a
/// whole number must have its unit.
fn unmeasured(text: &str, results: &str) -> Vec<String> {
    let (numbers, measured) = (BTreeSet::from_iter(tokens(results)), with_unit(results));
    let is_measured = |figure: &String| {
        let number = figure.split(' ').next().unwrap();
        measured.contains(figure) || number.contains('.') && numbers.contains(number)
    };
    with_unit(text).into_iter().chain(scores(text)).filter(|figure| !is_measured(figure)).collect()
}

#[test]
fn figures_are_those_of_the_results() {
    let results: String = paths(&[], &[RESULTS]).iter().map(|path| read(path) + "\n").collect();
    for document in paths(&DOCUMENTS, &[GUIDES]) {
        let unknown = unmeasured(&read(&document), &results);
        assert!(unknown.is_empty(), "{document}: not in {RESULTS}: {unknown:?}");
    }
}

#[test]
fn a_figure_without_a_result_is_found() {
    let results = "| lego | 31.20 |\nIt takes 12 minutes and 4.5 GB.\n";
    let text = "It takes 12 minutes, 12 s, 4.5 GB (1.5 GB for `s: 3`), 90s.\n```\n7 s\n```\n\
                | 31.20 | **31.34** | 200×4 | 0.5 |\n";
    assert_eq!(unmeasured(text, results), ["1.5 GB", "12 s", "90 s", "31.34"]);
}
