//! Tests of files that extend others, targets in `pipelines/`, and the shipped pipelines.

use tempfile::TempDir;

use super::*;
use crate::file::Part;
use crate::request::PlanError;
use crate::targets;

/// Creates a folder with files.
fn folder(files: &[(&str, &str)]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, text) in files {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }
    folder
}

const BASE: &str = "default: [b]
stages:
  a: {inputs: {x: ./data, y: ./more}, parameters: {one: 1, two: 2}}
  b:
    run: ./b.sh
    inputs: {x: a}
";

const EXTENDING: &str = "extends: ../pipeline.yaml
stages:
  a:
    inputs:
      y: ./data
      z: /z
    parameters: {two: 3}
  b: {extends: a}
  c: {inputs: {x: b}}
";

fn base_and(more: &[(&str, &str)]) -> TempDir {
    folder(&[&[("pipeline.yaml", BASE)], more].concat())
}

#[test]
fn a_file_overrides_parts_of_the_file_that_it_extends() {
    let folder = base_and(&[("pipelines/c.yaml", EXTENDING)]);
    let project = folder.path().canonicalize().unwrap();
    let pipeline = Pipeline::read(&project.join("pipelines/c.yaml")).unwrap();
    assert_eq!(pipeline.default, ["b"]);
    assert_eq!(pipeline.stages.keys().collect::<Vec<_>>(), ["a", "b", "c"]);
    let (a, b) = (&pipeline.stages["a"], &pipeline.stages["b"]);
    let layers: Vec<_> = a.parameter_layers().filter(|layer| !layer.is_empty()).collect();
    assert_eq!(
        serde_json::to_value(layers).unwrap(),
        serde_json::json!([{"one": 1, "two": 2}, {"two": 3}])
    );
    assert_eq!(a.inputs.keys().collect::<Vec<_>>(), ["x", "y", "z"]);
    assert_eq!((b.run.as_deref(), b.extends.as_deref()), (None, Some("a")));
    assert_eq!(b.inputs["x"], "a");
    // Paths are relative to the file that contains them; errors name its lines.
    let (base, extending) = (project.join("pipeline.yaml"), project.join("pipelines/c.yaml"));
    for (stage, part, file, line) in [
        ("a", Part::Input("x"), &base, 3),
        ("a", Part::Input("y"), &extending, 5),
        ("a", Part::Parameter("one"), &base, 3),
        ("a", Part::Parameter("two"), &extending, 7),
        ("a", Part::Block, &extending, 3),
        ("b", Part::Field("extends"), &extending, 8),
        ("b", Part::Input("x"), &base, 6),
        ("c", Part::Field("run"), &extending, 9),
    ] {
        let error = pipeline.error(stage, part, "wrong").to_string();
        assert_eq!(error, format!("{}:{line}: stage {stage}: wrong", file.display()));
        assert_eq!(
            pipeline.resolve_path(stage, part, "./it"),
            file.with_file_name("it"),
            "{stage} {part:?}"
        );
    }
    let error = pipeline.error_in_default("wrong".to_owned()).to_string();
    assert_eq!(error, format!("{}:1: wrong", base.display()));
    // Null removes an inherited input, which a further file may give again.
    let text = "extends: pipelines/c.yaml\nstages: {a: {inputs: {y: null, z: null}}}";
    std::fs::write(project.join("x.yaml"), text).unwrap();
    std::fs::write(project.join("y.yaml"), "extends: x.yaml\nstages: {a: {inputs: {z: ./z}}}")
        .unwrap();
    for (name, expected) in [("x.yaml", &["x"][..]), ("y.yaml", &["x", "z"])] {
        let pipeline = Pipeline::read(&project.join(name)).unwrap();
        assert_eq!(pipeline.stages["a"].inputs.keys().collect::<Vec<_>>(), expected);
    }
}

/// Each error is one line and names the line of `extends`.
#[test]
fn files_that_cannot_be_extended_are_refused() {
    let deep: Vec<(String, String)> = (0..10)
        .map(|i| (format!("{i}.yaml"), format!("\nextends: {}.yaml", (i + 1).min(9))))
        .collect();
    let deep: Vec<(&str, &str)> =
        deep.iter().map(|(name, text)| (name.as_str(), text.as_str())).collect();
    for (files, location, reason) in [
        (
            &[("x.yaml", "\nextends: ../none.yaml\n")][..],
            "x.yaml:2: ",
            "paths are relative to the file that contains them",
        ),
        (&[("x.yaml", "extends: x.yaml")], "x.yaml:1: ", "extends x.yaml: the file extends itself"),
        (
            &[("x.yaml", "extends: y.yaml"), ("y.yaml", "extends: [./x.yaml]")],
            "y.yaml:1: ",
            "the file extends itself",
        ),
        (&[("x.yaml", "extends: 0.yaml")], "6.yaml:2: ", "more than 8 files in a chain"),
        (&[("x.yaml", "extends: .")], "x.yaml:1: ", "extends .: "),
        (
            &[("x.yaml", "extends: {a: b}")],
            "x.yaml:1",
            "expected the path of a pipeline file, or a list of paths",
        ),
        (
            &[("x.yaml", "extends: y.yaml"), ("y.yaml", "default: [a]\nstages:\n  a: {like: b}")],
            "y.yaml:3: ",
            "unknown field `like`",
        ),
        (
            &[("x.yaml", "extends: pipeline.yaml\nstages:\n  a: {inputs: {z: null}}")],
            "x.yaml:3: ",
            "stage a: input z: null removes an inherited input, but no extended file has it",
        ),
        (&[("x.yaml", "stages: {}")], "x.yaml: ", "missing field `default`"),
        (&[("x.yaml", "default: []")], "x.yaml: ", "missing field `stages`"),
        (
            &[
                ("x.yaml", "extends: [y.yaml, pipeline.yaml]"),
                ("y.yaml", "extends: pipeline.yaml\nstages:\n  a: {parameters: {one: 2}}"),
            ],
            "x.yaml:1: ",
            "differs in",
        ),
        (
            &[("x.yaml", "extends: [y/y.yaml, pipeline.yaml]"), ("y/y.yaml", BASE)],
            "x.yaml:1: ",
            "block a differs in",
        ),
    ] {
        let folder = base_and(&[files, &deep].concat());
        let project = folder.path().canonicalize().unwrap();
        let error = Pipeline::read(&project.join("x.yaml")).unwrap_err().to_string();
        assert!(
            error.starts_with(&project.join(location).display().to_string())
                && error.contains(reason),
            "{error}"
        );
        assert!(!error.contains('\n'), "{error}");
    }
    // Eight files in a chain are allowed, and so is one file reached in two ways.
    for text in ["extends: 3.yaml", "extends: [y.yaml, pipeline.yaml, z.yaml]"] {
        let shared = "extends: pipeline.yaml\nstages: {d: {}}";
        let folder = base_and(
            &[
                &deep[..9],
                &[("9.yaml", BASE), ("x.yaml", text), ("y.yaml", shared), ("z.yaml", shared)],
            ]
            .concat(),
        );
        let pipeline = Pipeline::read(&folder.path().join("x.yaml")).unwrap();
        assert_eq!(pipeline.default, ["b"]);
    }
}

fn find(project: &Path, names: &[&str]) -> Result<(Pipeline, Vec<String>), PlanError> {
    let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
    targets::find_targets(&Pipeline::read(&project.join("pipeline.yaml")).unwrap(), &names)
}

/// Targets are searched in pipeline.yaml, then among the files of `pipelines/`, then among the
/// blocks of these files.
#[test]
fn targets_are_found_next_to_the_pipeline() {
    let files = [
        (
            "pipelines/c.yaml",
            "extends: ../pipeline.yaml\nstages: {c: {inputs: {x: b}}, inner: {}, b: {}}",
        ),
        ("pipelines/d.yaml", "extends: c.yaml\ndefault: [inner, a]\nstages: {other: {}}"),
        (
            "pipelines/e.yaml",
            "extends: ../pipeline.yaml\nstages: {e: {}, a: {parameters: {one: 7}}}",
        ),
        ("pipelines/broken.yaml", "stages: ["),
        ("pipelines/notes.txt", "c"),
        // Earlier names than those of the files that define `inner` and `other`.
        ("pipelines/a1.yaml", "extends: c.yaml\nstages: {inner: {}, twice: {}}"),
        ("pipelines/a2.yaml", "extends: ../pipeline.yaml\nstages: {twice: {}}"),
        ("experiments/a0.yaml", "extends: ../pipeline.yaml\nstages: {other: {}}"),
    ];
    let folder = base_and(&files);
    let project = folder.path().canonicalize().unwrap();
    for (names, blocks, stages) in [
        (&[][..], &[][..], &["a", "b"][..]),
        (&["a"], &["a"], &["a", "b"]),
        (&["c"], &["c"], &["a", "b", "c", "inner"]),
        (&["d"], &["inner", "a"], &["a", "b", "c", "inner", "other"]),
        (&["inner"], &["inner"], &["a", "b", "c", "inner"]),
        (&["b", "c", "other"], &["b", "c", "other"], &["a", "b", "c", "inner", "other"]),
        (&["e"], &["e"], &["a", "b", "e"]),
    ] {
        let (pipeline, found) = find(&project, names).unwrap();
        assert_eq!(found, blocks, "{names:?}");
        assert_eq!(pipeline.stages.keys().collect::<Vec<_>>(), stages, "{names:?}");
    }
    for (names, reasons) in [
        (
            &["othre"][..],
            &["no stage \"othre\"; did you mean other? known: a, a0, a1, a2, b, broken, c, d, e, \
                inner, other, twice"][..],
        ),
        (&["../pipeline"], &["no stage \"../pipeline\""]),
        (
            &["twice"],
            &["several files have a block twice: ", "pipelines/a1.yaml, ", "pipelines/a2.yaml; "],
        ),
        (&["broken"], &["pipelines/broken.yaml"]),
        (&["c", "e"], &["e can't be combined with c: block a differs in", "run e alone"]),
    ] {
        let error = find(&project, names).unwrap_err().to_string();
        assert!(reasons.iter().all(|reason| error.contains(reason)), "{error}");
    }
}

fn relative_project_folder(folder: &Path, file: &str) -> PathBuf {
    let pipeline = Pipeline::read(&folder.join(file)).unwrap();
    pipeline
        .project_folder()
        .canonicalize()
        .unwrap()
        .strip_prefix(folder.canonicalize().unwrap())
        .unwrap()
        .to_owned()
}

/// A file of `pipelines/` shares store and pages with pipeline.yaml. An independent pipeline has
/// its own store and pages next to it.
#[test]
fn the_store_is_next_to_the_pipeline() {
    let more = [
        ("pipelines/c.yaml", EXTENDING),
        ("pipelines/alone.yaml", BASE),
        ("other/x.yaml", "extends: ../pipelines/c.yaml"),
    ];
    let folder = base_and(&more);
    for (file, expected) in [
        ("pipeline.yaml", ""),
        ("pipelines/c.yaml", ""),
        ("pipelines/../pipelines/c.yaml", ""),
        ("pipelines/alone.yaml", "pipelines"),
        ("other/x.yaml", "other"),
    ] {
        assert_eq!(relative_project_folder(folder.path(), file), Path::new(expected), "{file}");
    }
}

/// Returns the repository's pipelines.
fn shipped() -> (Pipeline, Vec<String>) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../..");
    let files =
        std::fs::read_dir(root.join("pipelines")).unwrap().map(|entry| entry.unwrap().path());
    let mut names: Vec<String> =
        files.map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned()).collect();
    names.sort();
    (Pipeline::read(&root.join("pipeline.yaml")).unwrap(), names)
}

/// Checks the names and the order of a pipeline's stages.
fn check_pipeline(pipeline: &Pipeline) -> Result<(), crate::PipelineError> {
    crate::check::check_names(pipeline)?;
    crate::check::topological_order(pipeline).map(drop)
}

#[test]
fn every_shipped_file_is_a_target_and_all_combine() {
    let (pipeline, names) = shipped();
    assert_eq!(pipeline.stages.len(), 6);
    let (all, blocks) = targets::find_targets(&pipeline, &names).unwrap();
    assert_eq!(blocks, names);
    check_pipeline(&all).unwrap();
    for name in &names {
        let (file_pipeline, _) =
            targets::find_targets(&pipeline, std::slice::from_ref(name)).unwrap();
        assert_eq!(&file_pipeline.default, std::slice::from_ref(name));
        check_pipeline(&file_pipeline).unwrap();
        // The file is complete, and its blocks are those of pipeline.yaml unless it overrides them.
        assert!(
            pipeline.stages.keys().all(|stage| pipeline.has_equal_block(&file_pipeline, stage)),
            "{name}"
        );
    }
}
