//! Tables of docs/results are made by experiments. A comment above each names its command; at small
//! budgets that makes a table with these columns, and has all of these rows. `UPDATE=1` puts what
//! the commands made in `out/` into the documents (`make results`).

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

use common::{Project, data, root};

/// Columns that say what a row is of.
const KEYS: [&str; 6] = ["protocol", "method", "supervision", "scene", "has seen", "gain"];
/// Protocols of the usual names on images of 48 pixels.
const SMALL: &str = "  presets:
    100x2: {lr_width: 24, prep.scale: 2}
    100x4: {lr_width: 12, prep.scale: 4}
    200x2: {lr_width: 22, prep.scale: 2}
    200x4: {lr_width: 11, prep.scale: 4}
    252x2: {lr_width: 20, prep.scale: 2}
    252x4: {lr_width: 10, prep.scale: 4}
";
/// The presets that paper-table.yaml adds, likewise.
const SMALL_IN_PAPER_TABLE: [(&str, &str); 6] = [
    ("rays: 8000000}", "rays: 10000, views-low.size: 24, prep-hr.lr_width: 48}"),
    ("rays: 16000000}", "rays: 10000, views-low.size: 12, prep-hr.lr_width: 48}"),
    ("rays: 20000000}", "rays: 10000, views-low.size: 22, prep-hr.lr_width: 44}"),
    ("rays: 16500000}", "rays: 10000, views-low.size: 11, prep-hr.lr_width: 44}"),
    ("      views-low.size: \"{width}\"\n", ""),
    ("      prep-hr.lr_width: \"{hr_width}\"\n", ""),
];
/// Stages whose budgets are cut besides.
const BUDGETS: [&str; 8] = [
    "train-ss.rays=20000",
    "downscaled-field.rays=10000",
    "finetuned-field.rays=10000",
    "train-refine.steps=10",
    "train-refine.features=8",
    "train-reference.steps=10",
    "train-reference.features=8",
    "render-depth.samples_per_axis=1",
];

/// A table of a document, below a comment with the command that makes it.
struct Marked {
    /// Words after `nerf-sr`.
    command: Vec<String>,
    head: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Marked {
    /// Returns the path to which its command wrote it: `OUT/SINK/table.md`, with the first target.
    fn file(&self) -> PathBuf {
        let out =
            self.command.iter().position(|word| word == "--out").expect("--out in the comment");
        Path::new(&self.command[out + 1]).join(&self.command[1]).join("table.md")
    }

    /// The command without `--out` and its folder.
    fn words(&self) -> Vec<&str> {
        let out = self.command.iter().position(|word| word == "--out").unwrap();
        let words =
            self.command.iter().enumerate().filter(|(place, _)| *place != out && *place != out + 1);
        words.map(|(_, word)| word.as_str()).collect()
    }
}

fn cells(line: &str) -> Vec<String> {
    let cells = line.trim().trim_matches('|').split('|').map(|cell| cell.trim().replace("**", ""));
    cells.map(|cell| if cell == "–" { String::new() } else { cell }).collect()
}

fn is_first(lines: &[&str], place: usize) -> bool {
    lines[place].starts_with('|') && (place == 0 || !lines[place - 1].starts_with('|'))
}

fn table_at<'a>(lines: &[&'a str], place: usize) -> Vec<&'a str> {
    lines[place..].iter().take_while(|line| line.starts_with('|')).copied().collect()
}

/// The tables of a text: the line before, and their lines.
fn tables(text: &str) -> Vec<(&str, Vec<&str>)> {
    let lines: Vec<&str> = text.lines().collect();
    let firsts = (0..lines.len()).filter(|&place| is_first(&lines, place));
    firsts
        .map(|place| (if place == 0 { "" } else { lines[place - 1] }, table_at(&lines, place)))
        .collect()
}

fn command_of(comment: &str) -> Option<String> {
    Some(comment.strip_prefix("<!-- nerf-sr ")?.strip_suffix(" -->")?.to_owned())
}

/// The marked tables of a document.
fn marked(text: &str) -> Vec<Marked> {
    let found = tables(text).into_iter().filter_map(|(before, lines)| {
        Some(Marked {
            command: command_of(before)?.split_whitespace().map(str::to_owned).collect(),
            head: cells(lines[0]),
            rows: lines[2..].iter().map(|line| cells(line)).collect(),
        })
    });
    found.collect()
}

fn documents() -> Vec<PathBuf> {
    let entries =
        std::fs::read_dir(root().join("docs/results")).unwrap().map(|entry| entry.unwrap().path());
    let mut documents: Vec<PathBuf> =
        entries.filter(|path| path.extension().is_some_and(|end| end == "md")).collect();
    documents.sort();
    documents
}

/// The cells of a row that say what it is of.
fn keys(head: &[String], row: &[String]) -> Vec<String> {
    head.iter()
        .zip(row)
        .filter(|(name, _)| KEYS.contains(&name.as_str()))
        .map(|(_, cell)| cell.clone())
        .collect()
}

/// The project's scene under the names of those in the documents.
fn project() -> Option<Project> {
    let weights = data()?.join("weights");
    let project = Project::experiments();
    // Some of them near a reference.
    project.replace("test: 3", "test: 8");
    project.demo_data("lego");
    for name in ["chair", "fern"] {
        let folders = [project.path("data/lego/."), project.path("data").join(name)];
        assert!(Command::new("cp").arg("-rL").args(folders).status().unwrap().success());
    }
    std::os::unix::fs::symlink(weights, project.path("data/weights")).unwrap();
    let shipped = std::fs::read_to_string(root().join("experiments/common.yaml")).unwrap();
    let (before, _) = shipped.split_once("  presets:\n").unwrap();
    project.write("experiments/common.yaml", &format!("{before}{SMALL}"));
    let mut table = std::fs::read_to_string(root().join("experiments/paper-table.yaml")).unwrap();
    for (large, small) in SMALL_IN_PAPER_TABLE {
        assert!(table.contains(large), "{large}");
        table = table.replace(large, small);
    }
    project.write("experiments/paper-table.yaml", &table);
    Some(project)
}

#[test]
fn experiments_make_these_tables() {
    let all: Vec<Marked> = documents()
        .iter()
        .flat_map(|path| marked(&std::fs::read_to_string(path).unwrap()))
        .collect();
    assert!(all.len() >= 8, "{} tables", all.len());
    let Some(project) = project() else { return };
    let budgets: Vec<&str> = BUDGETS.into_iter().flat_map(|word| ["-p", word]).collect();
    for table in &all {
        let words = table.words();
        project.ok(&[&words[..], &["--data", "data", "--out", "made"], &budgets].concat());
        let made =
            std::fs::read_to_string(project.path("made").join(words[1]).join("table.md")).unwrap();
        let of_head = tables(&made).into_iter().find(|(_, lines)| cells(lines[0]) == table.head);
        let (_, lines) = of_head
            .unwrap_or_else(|| panic!("{words:?}: no table with {:?} in\n{made}", table.head));
        let made: Vec<Vec<String>> =
            lines[2..].iter().map(|line| keys(&table.head, &cells(line))).collect();
        for row in &table.rows {
            let wanted = keys(&table.head, row);
            assert!(made.contains(&wanted), "{words:?}: no row {wanted:?} among {made:?}");
        }
    }
}

fn is_meant((before, lines): &(&str, Vec<&str>), comment: &str, head: &[String]) -> bool {
    *before == comment.trim_end() && cells(lines[0]) == head
}

/// Puts the tables that the commands made at full budgets into the documents; those whose command
/// hasn't run stay.
#[test]
fn what_was_measured_is_put_into_the_documents() {
    if std::env::var_os("UPDATE").is_none() {
        return;
    }
    for path in documents() {
        let mut text = std::fs::read_to_string(&path).unwrap();
        for table in marked(&text.clone()) {
            let Ok(made) = std::fs::read_to_string(root().join(table.file())) else { continue };
            let Some((_, lines)) =
                tables(&made).into_iter().find(|(_, lines)| cells(lines[0]) == table.head)
            else {
                continue;
            };
            let comment = format!("<!-- nerf-sr {} -->\n", table.command.join(" "));
            let old = tables(&text)
                .into_iter()
                .find(|one| is_meant(one, &comment, &table.head))
                .unwrap()
                .1
                .join("\n");
            text = text.replacen(
                &format!("{comment}{old}"),
                &format!("{comment}{}", lines.join("\n")),
                1,
            );
            println!("{}: {}", path.display(), table.file().display());
        }
        std::fs::write(&path, text).unwrap();
    }
}
