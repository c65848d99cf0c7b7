//! Runs the commands of README and the guides with installed programs and small parameters.

#![allow(missing_docs, reason = "a test")]
mod common;
#[path = "common/forms.rs"]
mod forms;
#[path = "common/installed.rs"]
mod installed;

use std::path::Path;

use common::{FAST, Finished, Project, commands, data, root, stage};

/// Document whose commands `tests/slurm.rs` runs on a cluster.
const CLUSTER_GUIDE: &str = "slurm.md";
/// Option of commands that need a GPU.
const GPU_OPTION: &str = "--device cuda";
/// Parts of commands and their replacements, so that each command takes a second. Commands end in a
/// space.
const REPLACEMENTS: [(&str, &str); 23] = [
    ("rays=30M", "rays=5000"),
    ("rays=2000000", "rays=500 -p layers=2 -p hidden_dim=16"),
    ("run seeds ", "run seeds -p train-ss.rays=4000 "),
    ("run viewer ", "run viewer -p viewer.resolution=32 "),
    (" -p viewer.resolution=384", ""),
    ("run video ", "run video -p frames=2 "),
    (" -p frames=300", ""),
    ("run refined-video ", "run refined-video -p frames=2 -p train-refine.steps=2 "),
    ("run refined ", "run refined -p train-refine.steps=2 "),
    ("run sisr-fuse ", "run sisr-fuse -p train-refine.steps=2 "),
    ("camera-path.size=400", "camera-path.size=24"),
    ("lr_width=100", "lr_width=12"),
    ("--protocol 100x2", "--protocol 16x2 -p rays=4000"),
    (" paper-table ", " paper-table --data data "),
    (
        " paper-page ",
        " paper-page --data data -p field-nerf-epochs.rays=4000 -p downscaled-field.rays=4000 -p \
        steps=2 ",
    ),
    (
        "--show mlp-nerf,mlp",
        "--show mlp-nerf,mlp --protocol 16x2 -p field-mlp.rays=500 -p field-mlp-nerf.rays=500 -p \
        layers=2 -p hidden_dim=16",
    ),
    ("train-paper.steps=100", "train-paper.steps=1 -p features=4"),
    // A folder replaces the team's folder and the bucket; tests of `nerf-sr-remote` use a server.
    ("/mnt/team/nerf-sr", "team"),
    ("s3://bucket/nerf-sr", "team"),
    ("3f9c27d1", "\"$(basename \"$(nerf-sr path train-ss)\")\""),
    ("compare=r_5", "compare=r_1"),
    ("--memory 8G", "--memory 3G"),
    ("references_per_view=2", "references_per_view=2 -p train-reference.steps=2"),
];

/// Runs a shell command with the installed programs.
fn run(project: &Project, line: &str) -> Finished {
    let path = std::env::var("PATH").unwrap_or_default();
    let mut shell = project.command_of(Path::new("sh"), &["-c", line]);
    shell.env("PATH", format!("{}:{path}", project.path("usr/bin").display()));
    shell.env_remove("LD_LIBRARY_PATH").current_dir(project.path("work"));
    Finished::of(shell.output().unwrap())
}

/// Installs the programs, prepares a work folder by `nerf-sr init`, and replaces the pipeline by a
/// pipeline that runs in seconds. Returns `false` if the programs can't be installed.
fn prepare(project: &Project) -> bool {
    if !installed::install(&project.path("usr")) {
        return false;
    }
    let photographs = forms::as_transforms(project);
    std::fs::create_dir(project.path("work")).unwrap();
    std::fs::rename(photographs, project.path("work/my-photographs")).unwrap();
    let params = r#"{"size": 48, "train": 8, "test": 2, "samples_per_axis": 1}"#;
    let scene = project.path("work/my-scene");
    assert_eq!(stage("demo-scene", params, &[], &scene, &[]).code, 0);
    std::fs::create_dir(project.path("work/data")).unwrap();
    for name in ["lego", "chair"] {
        std::os::unix::fs::symlink(&scene, project.path("work/data").join(name)).unwrap();
    }
    let init = run(project, "nerf-sr init my-photographs");
    assert_eq!(init.code, 0, "{}", init.stderr);
    // Photographs are used as LR images, as in the pipeline written by `init`.
    let pipeline = FAST.replace("size: 32", "size: 64").replace("lr_width: 16, ", "");
    // Blocks that extend `train-ss` don't inherit `rays`; the bounds limit their rays.
    let pipeline = pipeline.replace("rays: 4000,", "rays: 4000, min_rays: 4000, max_rays: 4000,");
    let pipeline = pipeline.replace("\ndefault:", "\nquality: draft\ndefault:");
    project.write("work/pipeline.yaml", &pipeline);
    if let Some(data) = data() {
        std::os::unix::fs::symlink(data.join("weights"), project.path("work/weights")).unwrap();
    }
    let video = run(
        project,
        "nerf-sr run video -p frames=2 && mkdir my-path && \
        cp \"$(nerf-sr path camera-path -p frames=2)\"/camera_path.json my-path",
    );
    assert_eq!(video.code, 0, "{}", video.stderr);
    true
}

#[test]
fn every_command_runs() {
    let project = Project::fast();
    if !prepare(&project) {
        return;
    }
    let mut documents = vec![root().join("README.md")];
    let guides = std::fs::read_dir(root().join("docs/guide")).unwrap();
    documents.extend(guides.map(|entry| entry.unwrap().path()));
    documents[1..].sort();
    documents.retain(|path| path.extension().is_some_and(|extension| extension == "md"));
    let mut count = 0;
    for document in documents {
        let name = document.file_name().unwrap().to_str().unwrap();
        if name == CLUSTER_GUIDE {
            continue;
        }
        for command in commands(&document) {
            let needs_weights =
                command.contains("=weights") && !project.path("work/weights").exists();
            let needs_remote = command.starts_with("nerf-sr-remote ")
                && !project.path("usr/bin/nerf-sr-remote").exists();
            // `prepare` has run `init`; a second `init` would overwrite the pipeline.
            if command.starts_with("nerf-sr init ") {
                continue;
            }
            if needs_weights || needs_remote || command.contains(GPU_OPTION) {
                println!("skipped: {command}");
                continue;
            }
            let command = command + " ";
            let shortened =
                REPLACEMENTS.iter().fold(command, |text, (from, to)| text.replace(from, to));
            let start = std::time::Instant::now();
            let finished = run(&project, &shortened);
            assert_eq!(finished.code, 0, "{name}: {shortened}\n{}", finished.stderr);
            println!("{:5.1} s: {shortened}", start.elapsed().as_secs_f64());
            count += 1;
        }
    }
    assert!(count > 50, "{count}");
}
