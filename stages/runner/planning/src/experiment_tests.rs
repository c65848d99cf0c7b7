//! Expansion of experiments to nodes, with given descriptions of stages.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::*;
use crate::experiment::Selection;

const EXPERIMENT: &str = "default: [table]
stages:
  prep:
    inputs: {dataset: ./own}
  train:
    inputs: {scene: prep}
  score:
    inputs: {field: train}
  table:
    inputs: {run: score}
experiment:
  folders: [first, second]
  inputs: {score.weights: weights}
  scenes: [demo, lego]
  protocols: [100x2]
  presets:
    100x2: {lr_width: 100, prep.scale: 2, rays: 1000}
    other: {rays: 500}
  variants:
    - {name: as it is}
    - {name: no warm-up, parameters: {warmup: 0}}
    - {name: 'one ray, shown', parameters: {score.samples: 1}}
";

fn description(
    (name, kind, inputs, parameters): (&str, &str, Value, Value),
) -> (String, Description) {
    let text = json!({"name": name, "version": "", "code": "", "summary": "", "inputs": inputs,
        "output": {"kind": kind},
        "parameters": {"properties": parameters}, "sink": name == "table",
        "partial": name == "table"});
    (name.to_owned(), serde_json::from_value(text).unwrap())
}

fn descriptions() -> BTreeMap<String, Description> {
    let integer = |default: u64| json!({"type": "integer", "default": default});
    let stages = [
        (
            "prep",
            "scene",
            json!({"dataset": {"kinds": ["data"], "summary": ""}}),
            json!({"lr_width": integer(10), "scale": integer(1)}),
        ),
        (
            "train",
            "field",
            json!({"scene": {"kinds": ["scene"], "summary": ""}}),
            json!({"rays": integer(1), "warmup": integer(3)}),
        ),
        (
            "score",
            "metrics",
            json!({"field": {"kinds": ["field"], "summary": ""},
                "weights": {"kinds": ["w"], "optional": true, "summary": ""}}),
            json!({"samples": integer(2)}),
        ),
        ("table", "table", json!({"run": {"kinds": ["run"], "summary": ""}}), json!({})),
    ];
    stages.map(description).into()
}

/// Plans an experiment with a folder of data sets, with `change` applied to the request.
fn plan_of(text: &str, data: &Path, change: impl Fn(&mut Request)) -> Result<Plan, PlanError> {
    let mut request = Request {
        selection: Selection { data: Some(data.to_path_buf()), ..Selection::default() },
        ..Request::default()
    };
    change(&mut request);
    let pipeline = Pipeline::parse(text.as_bytes(), Path::new("dir/pipeline.yaml"))?;
    Plan::from_descriptions(&pipeline, &descriptions(), &request)
}

fn data() -> tempfile::TempDir {
    let data = tempfile::tempdir().unwrap();
    for folder in ["second/lego", "second/chair", "first/chair", "weights"] {
        std::fs::create_dir_all(data.path().join(folder)).unwrap();
    }
    data
}

fn labels(plan: &Plan) -> Vec<String> {
    plan.nodes.iter().map(Node::label).collect()
}

fn folder_of(plan: &Plan, node: usize, input: &str) -> PathBuf {
    let input = plan.nodes[node].inputs.iter().find(|candidate| candidate.name == input).unwrap();
    match &input.from {
        Origin::Folder(folder) => folder.clone(),
        Origin::Node { .. } => panic!("{input:?}"),
    }
}

/// Variants aren't combined with each other, and share nodes with equal settings.
#[test]
fn scenes_protocols_and_variants_are_axes() {
    let data = data();
    let plan = plan_of(EXPERIMENT, data.path(), |_| ()).unwrap();
    let expected = [
        "prep [scene=demo]",
        "prep [scene=lego]",
        "train [scene=demo, variant=as it is]",
        "train [scene=demo, variant=no warm-up]",
        "train [scene=lego, variant=as it is]",
        "train [scene=lego, variant=no warm-up]",
        "score [scene=demo, variant=as it is]",
        "score [scene=demo, variant=no warm-up]",
        "score [scene=demo, variant=one ray, shown]",
        "score [scene=lego, variant=as it is]",
        "score [scene=lego, variant=no warm-up]",
        "score [scene=lego, variant=one ray, shown]",
    ];
    assert_eq!(labels(&plan), expected);
    let last = plan.nodes.last().unwrap();
    let values = [("protocol", "100x2"), ("scene", "lego"), ("variant", "one ray, shown")];
    assert_eq!(last.values, values.map(|(name, value)| (name.to_owned(), value.to_owned())).into());
    assert_eq!(
        (&last.parameters["samples"], &plan.nodes[3].parameters["warmup"]),
        (&json!(1), &json!(0))
    );
    assert_eq!(
        (&plan.nodes[0].parameters["lr_width"], &plan.nodes[2].parameters["rays"]),
        (&json!(100), &json!(1000))
    );
    assert!(
        folder_of(&plan, 1, "dataset").ends_with("second/lego")
            && folder_of(&plan, 0, "dataset").ends_with("own")
    );
    assert!(folder_of(&plan, 6, "weights").ends_with("weights"));
    assert_eq!(plan.sinks[0].points.len(), 6);
}

fn scores(data: &Path, change: &dyn Fn(&mut Request)) -> Vec<String> {
    let plan = plan_of(EXPERIMENT, data, change).unwrap();
    labels(&plan).into_iter().filter(|label| label.starts_with("score")).collect()
}

#[test]
fn the_command_line_selects_and_overrides() {
    let data = data();
    let owned = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
    assert_eq!(
        scores(data.path(), &|r| (r.selection.scenes, r.selection.max_variants) =
            (owned(&["chair"]), Some(1))),
        ["score"]
    );
    assert_eq!(
        scores(data.path(), &|r| (r.selection.scenes, r.selection.variants) =
            (owned(&["demo"]), owned(&["no warm-up", "as it is"]))),
        ["score [variant=as it is]", "score [variant=no warm-up]"]
    );
    let plan = plan_of(EXPERIMENT, data.path(), |r| {
        r.selection.scenes = owned(&["chair"]);
        r.selection.protocols = owned(&["50x3"]);
        r.selection.max_variants = Some(2);
        r.parameters = owned(&["warmup=7", "lr_width=20,30"]);
    });
    let plan = plan.unwrap();
    // The command line overrides the settings of both variants, so they share a node.
    assert_eq!(
        labels(&plan)[2..4],
        ["train [variant=as it is, lr_width=20]", "train [variant=as it is, lr_width=30]"]
    );
    assert_eq!(
        (&plan.nodes[0].parameters["lr_width"], &plan.nodes[0].parameters["scale"]),
        (&json!(20), &json!(3))
    );
    assert_eq!(
        (&plan.nodes[2].parameters["warmup"], &plan.nodes[2].parameters["rays"]),
        (&json!(7), &json!(500))
    );
}

/// A sink shows every point, in the order of the axes, even if several points share a node.
#[test]
fn points_of_a_shared_node_are_all_shown() {
    let data = data();
    let text = EXPERIMENT.replace("100x2: {", "50x3: {rays: 9, score.samples: 1}\n    100x2: {");
    let text = text.replace("- {name: no warm-up, parameters: {warmup: 0}}\n    ", "");
    let plan =
        plan_of(&(text + "    - {name: warm-up, parameters: {warmup: 9}}\n"), data.path(), |r| {
            r.selection.scenes = vec!["demo".to_owned()];
            r.selection.protocols = vec!["50x3".to_owned(), "100x2".to_owned()];
        });
    let sink = &plan.unwrap().sinks[0];
    let mut shown = Vec::new();
    for point in &sink.points {
        let values = ["protocol", "variant"].map(|axis| point.values[axis].as_str());
        assert_eq!(point.point, format!("protocol={}, variant={}", values[0], values[1]));
        shown.push((point.node - sink.points[0].node, values));
    }
    assert_eq!(
        shown,
        [
            (0, ["50x3", "as it is"]),
            (0, ["50x3", "one ray, shown"]),
            (1, ["50x3", "warm-up"]),
            (2, ["100x2", "as it is"]),
            (3, ["100x2", "one ray, shown"]),
            (4, ["100x2", "warm-up"]),
        ]
    );
    assert_eq!(sink.nodes().len(), 5);
}

/// The pipeline's own scene changes no setting, but tables show its name.
#[test]
fn the_only_value_of_an_axis_is_in_all_nodes_but_no_labels() {
    let data = data();
    let text = EXPERIMENT.replace("  inputs: {score.weights: weights}\n", "");
    let plan =
        plan_of(&text, data.path(), |r| r.selection.scenes = vec!["demo".to_owned()]).unwrap();
    assert!(
        plan.nodes
            .iter()
            .all(|node| node.values["scene"] == "demo" && !node.label().contains("demo"))
    );
}

#[test]
fn the_command_line_overrides_a_sweep_of_the_file() {
    let data = data();
    let text = EXPERIMENT.replace("  variants:\n", "  sweeps: {train.rays: [5, 6]}\n  variants:\n");
    let select = |r: &mut Request| {
        (r.selection.scenes, r.selection.max_variants) = (vec!["demo".to_owned()], Some(1));
    };
    let plan = plan_of(&text, data.path(), select).unwrap();
    assert_eq!(labels(&plan)[1..3], ["train [rays=5]", "train [rays=6]"]);
    let plan = plan_of(&text, data.path(), |r| {
        select(r);
        r.parameters = vec!["rays=9".to_owned()];
    });
    assert_eq!(labels(&plan.unwrap())[1..2], ["train"]);
}

/// Blocks of a second field, which has its own scene, and of a table of both fields' scores.
const TWO_FIELDS: &str = "
  prep-large:
    extends: prep
    inputs: {dataset: ./own}
  train-large:
    extends: train
    inputs: {scene: prep-large}
  score-large:
    extends: score
    inputs: {field: train-large}
  table:
    inputs: {small: score, large: score-large}
";

/// Returns an experiment with both fields; the second one requires a file of weights.
fn two_field_experiment() -> String {
    let text = EXPERIMENT.replace("\n  table:\n    inputs: {run: score}\n", TWO_FIELDS);
    let text = text.replace(
        "  variants:\n",
        "    every: {prep-large.lr_width: '{hr_width}', score-large.samples: '{scale}'}\n  \
        variants:\n",
    );
    text.replace("  variants:\n", "  needs: {train-large: 'weights/x{rays}'}\n  variants:\n")
}

fn plan_showing(data: &Path, show: &[&str]) -> Result<Plan, PlanError> {
    plan_of(&two_field_experiment(), data, |r| {
        (r.selection.scenes, r.selection.protocols, r.selection.max_variants) =
            (vec!["lego".to_owned()], vec!["50x3".to_owned()], Some(1));
        r.selection.show = show.iter().map(|name| (*name).to_owned()).collect();
    })
}

#[test]
fn only_shown_inputs_are_planned() {
    let data = data();
    std::fs::write(data.path().join("weights/x500"), "").unwrap();
    for (show, expected) in [
        (&[][..], &["prep", "prep-large", "train", "score", "train-large", "score-large"][..]),
        (
            &["large", "score"],
            &["prep", "prep-large", "train", "score", "train-large", "score-large"],
        ),
        (&["small"], &["prep", "train", "score"]),
        (&["score-large"], &["prep-large", "train-large", "score-large"]),
    ] {
        let mut planned = labels(&plan_showing(data.path(), show).unwrap());
        let mut expected: Vec<&str> = expected.to_vec();
        planned.sort_unstable();
        expected.sort_unstable();
        assert_eq!(planned, expected, "{show:?}");
    }
    // The selected scene replaces the pipeline's in every block; sizes follow from the protocol.
    let large = &plan_showing(data.path(), &["large"]).unwrap().nodes;
    let folder = NodeInput {
        name: "dataset".to_owned(),
        from: Origin::Folder(data.path().join("second/lego").canonicalize().unwrap()),
    };
    assert_eq!(
        (&large[0].inputs[..], &large[0].parameters["lr_width"]),
        (&[folder][..], &json!(150))
    );
    assert_eq!(large[2].parameters["samples"], json!(3));
    let unknown = plan_showing(data.path(), &["larg"]).map(|plan| labels(&plan));
    assert_eq!(
        unknown.unwrap_err().to_string(),
        "--show larg: not an input of table; did you mean large? known: large, score, \
        score-large, small"
    );
}

#[test]
fn stages_without_a_required_file_are_left_out() {
    let data = data();
    std::fs::write(data.path().join("weights/x500"), "").unwrap();
    let plan = plan_of(&two_field_experiment(), data.path(), |r| {
        r.selection.protocols = vec!["50x3".to_owned(), "100x2".to_owned()];
        (r.selection.scenes, r.selection.max_variants) = (vec!["chair".to_owned()], Some(1));
    });
    let plan = plan.unwrap();
    let scores: Vec<String> =
        labels(&plan).into_iter().filter(|label| label.starts_with("score")).collect();
    assert_eq!(
        scores,
        ["score [protocol=50x3]", "score [protocol=100x2]", "score-large [protocol=50x3]"]
    );
    assert_eq!(plan.sinks[0].points.len(), 3);
    let [left_out] = &plan.sinks[0].left_out[..] else { panic!("{:?}", plan.sinks[0].left_out) };
    assert_eq!(
        (left_out.stage.as_str(), left_out.values["protocol"].as_str()),
        ("score-large", "100x2")
    );
    assert_eq!(left_out.reason.as_deref(), Some("no weights/x1000"));
    assert!(
        plan.notes[0].starts_with("train-large: left out: no weights/x1000 in "),
        "{:?}",
        plan.notes
    );
}

#[test]
fn invalid_selections_are_refused() {
    let data = data();
    for (text, change, expected) in [
        (
            EXPERIMENT.to_owned(),
            &(|c: &mut Selection| c.scenes = vec!["ship".to_owned()]) as &dyn Fn(&mut Selection),
            "no scene ship in ",
        ),
        (
            EXPERIMENT.to_owned(),
            &|c| c.protocols = vec!["100y2".to_owned()],
            "no protocol \"100y2\", and the name isn't WIDTHxSCALE; did you mean 100x2?",
        ),
        (
            EXPERIMENT.to_owned(),
            &|c| c.protocols = vec!["other".to_owned()],
            "no protocol \"other\"",
        ),
        (
            EXPERIMENT.to_owned(),
            &|c| c.variants = vec!["no warmup".to_owned()],
            "no variant \"no warmup\"; did you mean no warm-up?",
        ),
        (
            EXPERIMENT.split("  table:").next().unwrap().replace("[table]", "[score]"),
            &|c| c.show = vec!["score".to_owned()],
            "--show selects results on pages and in tables, but no target shows results",
        ),
        (
            EXPERIMENT.replace("  variants:", "  needs: {scor: x}\n  variants:"),
            &|_| (),
            "needs scor: no such stage; did you mean score?",
        ),
        (
            EXPERIMENT.replace("warmup: 0", "warmap: 0"),
            &|_| (),
            "experiment: warmap: no stage has this parameter; did you mean warmup?",
        ),
        (EXPERIMENT.replace("score.samples: 1", "scor.samples: 1"), &|_| (), "no stage \"scor\""),
        (
            EXPERIMENT.split("experiment:").next().unwrap().to_owned(),
            &|c| c.scenes = vec!["demo".to_owned()],
            "--scene, --protocol, --variant and --first-variants are for experiments",
        ),
    ] {
        let plan = plan_of(&text, data.path(), |request| change(&mut request.selection));
        let message = plan.map(|plan| labels(&plan)).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
}
