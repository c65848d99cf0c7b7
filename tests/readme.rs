//! Checks of the documents: commands plan, pipeline blocks are valid, linked files exist, and
//! figures are in the results.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use common::{Finished, Project, bin};
use serde_json::Value;

/// Documents whose commands and blocks are checked, and folders of more such documents.
const DOCUMENTS: [&str; 2] = ["README.md", "ARCHITECTURE.md"];
const FOLDERS: [&str; 2] = ["docs/guide", "docs/results"];
/// Documents in which only links are checked.
const LINKED: [&str; 4] =
    ["CONTRIBUTING.md", "CHANGELOG.md", "docs/glossary.md", "docs/comparison.md"];
const LINKED_FOLDERS: [&str; 1] = ["docs/design"];

/// Folder of documents whose figures must be in [`RESULTS`].
const GUIDES: &str = "docs/guide";
/// Folder of documents with measured figures.
const RESULTS: &str = "docs/results";
/// Units of measured figures, each with its spellings.
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

/// Returns `files` and the paths of all Markdown files of the folders, relative to the root.
fn document_paths(files: &[&str], folders: &[&str]) -> Vec<String> {
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

fn documents_text() -> String {
    document_paths(&DOCUMENTS, &FOLDERS).iter().map(|path| read(path) + "\n").collect()
}

/// Returns the contents of a text's fenced blocks of a language.
fn fenced_blocks(text: &str, language: &str) -> Vec<String> {
    let fence = format!("```{language}\n");
    text.split(&fence).skip(1).map(|rest| rest.split("```").next().unwrap().to_owned()).collect()
}

/// Splits a command line into arguments, without quotes.
fn split_arguments(line: &str) -> Vec<&str> {
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
    // Folders that the documents' commands name.
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
    for block in fenced_blocks(&documents_text(), "sh") {
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
            let mut args = split_arguments(rest);
            // `init` refuses to overwrite a pipeline, and this folder has one.
            if args[0] == "init" {
                continue;
            }
            // Artifacts that don't exist yet can't be pinned, located or compared.
            match args[0] {
                "pin" => _ = args.splice(..2, ["plan"]),
                "path" => args = vec!["plan", args[1].split('/').next().unwrap()],
                "diff" => args = ["plan"].into_iter().chain(args[1].split_whitespace()).collect(),
                _ => {}
            }
            // Nor can such an artifact be an input.
            if let Some(index) = args.iter().position(|arg| *arg == "init=train-ss") {
                args.drain(index - 1..=index);
            }
            // `run` would train for minutes. `plan` runs the same code up to the first stage, but
            // lacks the other options of `run`.
            if args[0] == "run" {
                args[0] = "plan";
                args.retain(|arg| !arg.starts_with("--watch"));
                while let Some(index) =
                    args.iter().position(|a| ["-j", "--threads", "--memory", "--out"].contains(a))
                {
                    args.drain(index..index + 2);
                }
            }
            let output =
                project.command(&args).current_dir(project.path("project")).output().unwrap();
            assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
            planned += 1;
        }
    }
    assert!(planned >= 8, "only {planned} commands in the documents");
}

#[test]
fn every_make_target_exists() {
    let makefile = read("Makefile");
    for block in fenced_blocks(&documents_text(), "sh") {
        for line in block.lines().filter_map(|l| l.trim().strip_prefix("make ")) {
            let target = line.split_whitespace().next().unwrap();
            assert!(makefile.contains(&format!("\n{target}:")), "no make target {target}");
        }
    }
}

#[test]
fn pipeline_blocks_are_valid() {
    let blocks = fenced_blocks(&documents_text(), "yaml");
    assert!(!blocks.is_empty());
    for block in blocks {
        let project = Project::tiny();
        std::fs::create_dir(project.path("scripts")).unwrap();
        let script = common::root().join("scripts/example-eval.py");
        std::fs::copy(script, project.path("scripts/example-eval.py")).unwrap();
        // Each block replaces the stage with its name.
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
            // Only `run` may start a user's program for the first time.
            project.run(&["plan"]).fails(2, &["check what the program does"]);
            project.ok(&["run"]);
        }
        project.ok(&["plan"]);
    }
}

/// Reads the code cells of a notebook.
fn code_cells(notebook: &str) -> Vec<String> {
    let notebook: Value = serde_json::from_str(&read(notebook)).unwrap();
    let cells = notebook["cells"].as_array().unwrap().iter();
    let code = cells.filter(|cell| cell["cell_type"] == "code");
    let lines = code.map(|cell| cell["source"].as_array().unwrap().iter());
    lines.map(|lines| lines.map(|line| line.as_str().unwrap()).collect()).collect()
}

/// The notebook's programs, which the guide contains too, must succeed after a finished run.
#[test]
fn programs_of_the_notebook_run() {
    let modules = ["-c", "import numpy, pandas, OpenEXR"];
    let import = Command::new("python3").args(modules).output();
    if !import.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: no numpy, pandas or OpenEXR (python3 -m pip install them)");
        return;
    }
    let project = Project::shipped(&["video"], "  report:\n    inputs: {run: eval}\n");
    project.ok(&["run", "report"]);
    let programs = bin("nerf-sr").parent().unwrap().to_owned();
    let path = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths([programs].into_iter().chain(std::env::split_paths(&path)));
    let path = path.unwrap();
    let cells = code_cells("docs/guide/python.ipynb");
    let texts = [&["eval", "psnr", "seconds"][..], &["view_0 (48, 48, 4)", "view_2 (48, 48, 4)"]];
    assert_eq!(cells.len(), texts.len());
    for (cell, texts) in cells.iter().zip(texts) {
        assert!(cell.lines().count() <= 30);
        let mut python = project.command_of(Path::new("python3"), &["-c", cell]);
        let finished = Finished::of(python.env("PATH", &path).output().unwrap());
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        assert!(texts.iter().all(|text| finished.stdout.contains(text)), "{}", finished.stdout);
    }
}

#[test]
fn linked_files_exist() {
    let files = [&DOCUMENTS[..], &LINKED[..]].concat();
    let folders = [&FOLDERS[..], &LINKED_FOLDERS[..]].concat();
    for document in document_paths(&files, &folders) {
        let folder = common::root().join(&document).parent().unwrap().to_owned();
        for target in
            read(&document).split("](").skip(1).map(|rest| rest.split([')', '#']).next().unwrap())
        {
            assert!(folder.join(target).exists(), "{document}: {target} not found");
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

/// Splits a text at all characters that are part of neither numbers nor units.
fn tokens(text: &str) -> Vec<&str> {
    text.split(|c: char| !c.is_alphanumeric() && c != '.' && c != '%')
        .map(|token| token.trim_end_matches('.'))
        .filter(|token| !token.is_empty())
        .collect()
}

/// Finds numbers with a unit outside code, such as `4.5 GB`, with the unit's first spelling.
fn quantities(text: &str) -> BTreeSet<String> {
    let prose: String = text.split("```").step_by(2).collect();
    let words = tokens(&prose);
    let mut found = BTreeSet::new();
    for (i, word) in words.iter().enumerate() {
        // Number and unit may be one word: 90s.
        let split = word.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(word.len());
        let (number, suffix) = word.split_at(split);
        let unit = if suffix.is_empty() { words.get(i + 1).unwrap_or(&"") } else { suffix };
        if is_number(number)
            && let Some(unit) = UNITS.iter().find(|spellings| spellings.contains(&unit))
        {
            found.insert(format!("{number} {}", unit[0]));
        }
    }
    found
}

/// Finds scores in a text's tables: numbers with two or more decimals.
fn scores(text: &str) -> BTreeSet<String> {
    let rows = text.lines().filter(|line| line.starts_with('|'));
    rows.flat_map(tokens)
        .filter(|word| is_number(word))
        .filter(|word| word.split_once('.').is_some_and(|(_, decimals)| decimals.len() >= 2))
        .map(str::to_owned)
        .collect()
}

/// Returns the figures of `text` that are not in `results`. A number with decimals may have another
/// unit in the results, a whole number may not.
fn unmeasured(text: &str, results: &str) -> Vec<String> {
    let (numbers, measured) = (BTreeSet::from_iter(tokens(results)), quantities(results));
    let is_measured = |figure: &String| {
        let number = figure.split(' ').next().unwrap();
        measured.contains(figure) || number.contains('.') && numbers.contains(number)
    };
    quantities(text).into_iter().chain(scores(text)).filter(|figure| !is_measured(figure)).collect()
}

#[test]
fn figures_are_in_the_results() {
    let results: String =
        document_paths(&[], &[RESULTS]).iter().map(|path| read(path) + "\n").collect();
    for document in document_paths(&DOCUMENTS, &[GUIDES]) {
        let unknown = unmeasured(&read(&document), &results);
        assert!(unknown.is_empty(), "{document}: not in {RESULTS}: {unknown:?}");
    }
}

#[test]
fn figures_without_a_result_are_found() {
    let results = "| lego | 31.20 |\nIt takes 12 minutes and 4.5 GB.\n";
    let text = "It takes 12 minutes, 12 s, 4.5 GB (1.5 GB for `s: 3`), 90s.\n```\n7 s\n```\n\
                | 31.20 | **31.34** | 200×4 | 0.5 |\n";
    assert_eq!(unmeasured(text, results), ["1.5 GB", "12 s", "90 s", "31.34"]);
}
