//! Expansion of pipeline files and command lines to nodes, with given descriptions of stages.

use std::path::Path;

use serde_json::{Value, json};

use super::*;
use crate::node::Devices;

const PIPELINE: &str = "default: [report]
stages:
  make: {}
  prep:
    inputs: {data: make}
    parameters: {scale: 2}
  train:
    inputs:
      scene: prep/train
  again:
    extends: train
    inputs: {scene: prep/train}
    parameters:
      rays: 7
  score:
    inputs: {field: train, truth: prep}
  report:
    inputs: {run: score}
";

/// Adds missing fields to a description. Returns the stage's name and the description.
fn complete_description(mut description: Value) -> (String, Description) {
    for (name, value) in [
        ("version", json!("1")),
        ("code", json!("1")),
        ("summary", json!("")),
        ("inputs", json!({})),
        ("parameters", json!({})),
    ] {
        description.as_object_mut().unwrap().entry(name).or_insert(value);
    }
    (description["name"].as_str().unwrap().to_owned(), serde_json::from_value(description).unwrap())
}

/// Returns the descriptions of the stages of [`PIPELINE`].
fn descriptions() -> BTreeMap<String, Description> {
    let seed = json!({"type": "integer", "format": "uint64", "default": 0});
    let stages = json!([
        {"name": "make", "output": {"kind": "data"}, "parameters": {"properties": {
            "size": {"type": "integer", "format": "uint32", "minimum": 1, "default": 4},
            "seed": seed}}},
        {"name": "prep", "output": {"kind": "scene", "subtrees": {"train": "scene/train"}},
         "inputs": {"data": {"kinds": ["data"], "summary": "images"}},
         "parameters": {"properties": {
            "scale": {"type": ["number", "null"], "default": null},
            "kernel": {"anyOf": [{"enum": ["box", "average"]}, {"type": "null"}], "default": null},
            "background": {"enum": ["white", "alpha"], "default": "white"},
            "place": {"type": "array", "items": {"type": "number"}, "default": []}}},
         "rules": [{"when": {"kernel": {"const": "average"}}, "must": {"scale": {"multipleOf": 1}},
         "message": "average needs a whole scale"}]},
        {"name": "train", "output": {"kind": "field"},
         "inputs": {"scene": {"kinds": ["scene/train"], "summary": "scene"},
                    "weights": {"kinds": ["weights", "field"], "optional": true,
                    "summary": "weights"}},
         "parameters": {"properties": {
            "rays": {"type": ["integer", "null"], "format": "uint64", "minimum": 1,
            "default": null},
            "supersample": {"type": "number", "minimum": 1, "default": 2.0},
            "method": {"enum": ["plain", "net"], "default": "plain"},
            "open": {"type": "boolean", "default": false}, "seed": seed}},
         "rules": [
            {"when": {"method": {"const": "net"}}, "needs": ["weights"],
                "message": "input weights is missing: method net needs it"},
            {"when": {"scene.background": {"const": "alpha"}}, "must": {"open": {"const": true}},
                "message": "alpha needs open"}]},
        {"name": "score", "output": {"kind": "metrics"},
         "inputs": {"field": {"kinds": ["field"], "summary": "field"},
         "truth": {"kinds": ["scene"], "summary": "truth"}},
         "parameters": {"properties": {"quick": {"type": "boolean", "default": false}}}},
        {"name": "report", "output": {"kind": "page"}, "sink": true,
            "inputs": {"run": {"kinds": ["run"], "summary": "a run"}},
         "parameters": {"properties": {"views": {"type": "integer", "default": 4}}},
         "rules": [{"when": {"run.quick": {"const": true}}, "must": {"views": {"maximum": 8}},
            "message": "quick scores have few views"}]}
    ]);
    stages.as_array().unwrap().iter().cloned().map(complete_description).collect()
}

fn plan_of(text: &str, arguments: &[&str]) -> Result<Plan, PlanError> {
    let mut request = Request::default();
    let mut remaining = arguments.iter().map(|argument| (*argument).to_owned());
    while let Some(argument) = remaining.next() {
        match argument.as_str() {
            "-p" => request.parameters.extend(remaining.next()),
            "-i" => request.inputs.extend(remaining.next()),
            _ => request.targets.push(argument),
        }
    }
    let pipeline = Pipeline::parse(text.as_bytes(), Path::new("dir/pipeline.yaml"))?;
    Plan::from_descriptions(&pipeline, &descriptions(), &request)
}

#[track_caller]
fn plan_error(text: &str, arguments: &[&str]) -> PlanError {
    plan_of(text, arguments).map(|plan| plan.nodes.len()).unwrap_err()
}

#[test]
fn every_combination_that_reaches_a_stage_is_a_node() {
    for (arguments, expected) in [
        (&[][..], &["make", "prep", "train", "score"][..]),
        (&["make"], &["make"]),
        (
            &["again", "-p", "supersample=1,2"],
            &["make", "prep", "again [supersample=1]", "again [supersample=2]"],
        ),
        (
            &["train", "-p", "prep.scale=2,3", "-p", "rays=5,6"],
            &[
                "make",
                "prep [scale=2]",
                "prep [scale=3]",
                "train [scale=2, rays=5]",
                "train [scale=2, rays=6]",
                "train [scale=3, rays=5]",
                "train [scale=3, rays=6]",
            ],
        ),
        // An input replaced by a folder needs no stage; two folders are a sweep.
        (
            &["train", "-i", "data=one,two"],
            &["prep [data=one]", "prep [data=two]", "train [data=one]", "train [data=two]"],
        ),
        (&["train", "-i", "train.scene=one"], &["train"]),
        // Axes of equal names, and those named like an entry of tables, are named by their stages.
        (
            &["train", "-p", "make.seed=1,2", "-p", "train.seed=3,4"],
            &[
                "make [make.seed=1]",
                "make [make.seed=2]",
                "prep [make.seed=1]",
                "prep [make.seed=2]",
                "train [make.seed=1, train.seed=3]",
                "train [make.seed=1, train.seed=4]",
                "train [make.seed=2, train.seed=3]",
                "train [make.seed=2, train.seed=4]",
            ],
        ),
        (
            &["train", "-i", "weights=one", "-p", "method=plain,net"],
            &["make", "prep", "train [train.method=plain]", "train [train.method=net]"],
        ),
        // The target decides between parameters of equal names.
        (&["make", "-p", "seed=3"], &["make"]),
    ] {
        let plan = plan_of(PIPELINE, arguments).unwrap();
        assert_eq!(
            plan.nodes.iter().map(Node::label).collect::<Vec<_>>(),
            expected,
            "{arguments:?}"
        );
    }
    let plan = plan_of(PIPELINE, &["-p", "supersample=1,2", "-p", "views=2"]).unwrap();
    assert_eq!((plan.sinks[0].stage.as_str(), plan.sinks[0].nodes()), ("report", [4, 5].into()));
    assert_eq!(plan.sinks[0].parameters, json!({"views": 2}));
}

#[test]
fn a_block_inherits_the_parameters_that_it_does_not_set() {
    let plan = plan_of(PIPELINE, &["again", "train", "-p", "train.rays=9", "-p", "supersample=3"])
        .unwrap();
    let parameters =
        |stage: &str| &plan.nodes.iter().find(|n| n.stage == stage).unwrap().parameters;
    assert_eq!(
        (&parameters("train")["rays"], &parameters("train")["supersample"]),
        (&json!(9), &json!(3.0))
    );
    assert_eq!(
        (&parameters("again")["rays"], &parameters("again")["supersample"]),
        (&json!(7), &json!(3.0))
    );
}

fn keys(text: &str, arguments: &[&str]) -> Vec<String> {
    let plan = plan_of(text, arguments).unwrap();
    plan.nodes.iter().map(|node| artifact::hash_json(&key_parts(node, &[], "cpu"))).collect()
}

/// Equal values have equal keys, in every notation, in files and on command lines. An explicit
/// default and an omitted parameter also have equal keys.
#[test]
fn equal_values_have_equal_keys() {
    let equal: [(&[&str], &[&str]); 8] = [
        (&[], &["-p", "supersample=2"]),
        (&[], &["-p", "supersample=2e0", "-p", "size=4.0", "-p", "train.seed=0"]),
        (&[], &["-p", "prep.scale=2.0"]),
        (&[], &["-p", "rays=", "-p", "kernel=null", "-p", "place=[]"]),
        (&["-p", "rays=6e4"], &["-p", "rays=60000"]),
        (&["-p", "prep.scale=3"], &["-p", "prep.scale=3.0"]),
        (&["-p", "place=[1,2.5]"], &["-p", "place=[1.0,25e-1]"]),
        (&["-p", "supersample=3"], &["-p", "supersample=4", "-p", "train.supersample=3.0"]),
    ];
    for (left, right) in equal {
        assert_eq!(keys(PIPELINE, left), keys(PIPELINE, right), "{left:?} {right:?}");
    }
    for (from, to) in [
        ("{scale: 2}", "{scale: 2.0}"),
        ("{scale: 2}", "{scale: 2e0, kernel: ~, place: []}"),
        ("{scale: 2}", "{scale: 0x2}"),
        ("  make: {}", "  make: {parameters: {size: 4.0}}"),
    ] {
        assert_eq!(keys(&PIPELINE.replace(from, to), &[]), keys(PIPELINE, &[]), "{to}");
    }
    assert_ne!(keys(PIPELINE, &["-p", "supersample=3"]), keys(PIPELINE, &[]));
}

/// The last of several values for one parameter wins, and the plan notes the others.
#[test]
fn the_last_value_wins() {
    for (arguments, notes, name, value) in [
        (
            &["-p", "kernel=box", "-p", "prep.kernel=average"][..],
            &["-p kernel=box: overridden by -p prep.kernel=average"][..],
            "kernel",
            json!("average"),
        ),
        (
            &["-p", "prep.scale=2", "-p", "scale=3", "-p", "scale=4"],
            &["-p prep.scale=2: overridden by -p scale=3", "-p scale=3: overridden by -p scale=4"],
            "scale",
            json!(4.0),
        ),
        (
            &["-p", "scale=1,1.0,2,2e0", "-p", "scale=3,3.0"],
            &[
                "-p scale=1,1.0,2,2e0: 1.0 equals 1; it is used once",
                "-p scale=1,1.0,2,2e0: 2e0 equals 2; it is used once",
                "-p scale=3,3.0: 3.0 equals 3; it is used once",
                "-p scale=1,1.0,2,2e0: overridden by -p scale=3,3.0",
            ],
            "scale",
            json!(3.0),
        ),
        (
            &["-i", "data=one", "-i", "prep.data=.", "-p", "kernel=box"],
            &["-i data=one: overridden by -i prep.data=."],
            "kernel",
            json!("box"),
        ),
        (
            &["-i", "data=.,./,two"],
            &["-i data=.,./,two: ./ equals .; it is used once"],
            "kernel",
            json!(null),
        ),
    ] {
        let plan = plan_of(PIPELINE, &[&["prep"], arguments].concat()).unwrap();
        assert_eq!(plan.notes, notes);
        assert_eq!(plan.nodes.last().unwrap().parameters[name], value, "{arguments:?}");
    }
    let plan = plan_of(PIPELINE, &["prep", "-i", "data=one", "-i", "data=two"]).unwrap();
    assert!(matches!(&plan.nodes[0].inputs[0].from,
            Origin::Folder(folder) if folder == Path::new("two")));
}

#[test]
fn invalid_command_lines_are_refused() {
    for (arguments, expected) in [
        (&["evla"][..], "no stage \"evla\"; known: again, make, prep, report, score, train"),
        (&["socre"], "no stage \"socre\"; did you mean score? known:"),
        (&["-p", "kernal=box"], "-p kernal: no stage has this parameter; did you mean kernel? see"),
        (&["-i", "date=x"], "-i date: no stage has this input; did you mean data?"),
        (&["-p", "kernel"], "-p kernel: expected NAME=VALUE"),
        (&["-p", "perp.kernel=box"], "-p perp.kernel: no stage \"perp\"; did you mean prep?"),
        (
            &["-p", "prep.kernle=box"],
            "-p prep.kernle: prep has no such parameter; did you mean kernel? known: background, \
            kernel, place, scale",
        ),
        (
            &["-p", "kernel=bxo"],
            "stage prep: parameter kernel: \"bxo\" is not one of \"box\", \"average\"; did you \
            mean \"box\"?",
        ),
        (
            &["-p", "seed=1"],
            "-p seed: several stages have this parameter; choose one: make.seed, train.seed",
        ),
        (
            &["-p", "rays=1,,2"],
            "-p rays=1,,2: empty value in the list; remove the comma, or write null",
        ),
        (&["-p", "rays=,"], "empty value in the list"),
        (&["-i", "data="], "-i data=: expected a folder after `=`"),
        (&["-i", "data=a,"], "-i data=a,: empty folder name in the list"),
        (&["-p", "size=0x10"], "stage make: parameter size: \"0x10\" is not a whole number"),
        (&["-p", "size=+2"], "\"+2\" is not a whole number"),
        (&["-p", "size= 2"], "\" 2\" is not a whole number"),
        (&["-p", "size=02"], "\"02\" is not a whole number"),
        (&["-p", "size=2.5"], "2.5 is not a whole number"),
        (&["-p", "size=5000000000"], "maximum of 4294967295"),
        (&["-p", "rays=18446744073709551616"], "maximum of 18446744073709551615"),
        (&["-p", "supersample="], "parameter supersample: null is not a number"),
        (&["-p", "views=1,2"], "report is a sink and shows all points of a sweep at once"),
        (&["-i", "report.run=x"], "report is a sink, which shows results of the run and reads no"),
        (
            &["-p", "kernel=average", "-p", "prep.scale=2,2.7"],
            "stage prep [scale=2.7]: average needs a whole scale",
        ),
        (&["-p", "method=net"], "stage train: input weights is missing: method net needs it"),
        (&["-p", "background=alpha"], "stage train: alpha needs open"),
        (&["-p", "quick=true", "-p", "views=9"], "stage report: quick scores have few views"),
        (&["-p", "method=plain,net"], "stage train [train.method=net]: input weights is missing"),
    ] {
        let problem = plan_error(PIPELINE, arguments);
        assert!(matches!(problem, PlanError::Usage(_)), "{problem:?}");
        assert!(problem.to_string().contains(expected), "{arguments:?}: {problem}");
    }
    for valid in [
        &["-p", "kernel=average"][..],
        &["-p", "method=net", "-i", "weights=w"],
        &["-p", "background=alpha", "-p", "open=true"],
        &["-p", "background=alpha", "-i", "scene=elsewhere"],
        &["prep", "-p", "background=alpha"],
        &["-p", "quick=true"],
    ] {
        assert!(plan_of(PIPELINE, valid).is_ok(), "{valid:?}");
    }
    let values = (0..120).map(|i| i.to_string()).collect::<Vec<_>>().join(",");
    let arguments = [format!("make.seed={values}"), format!("train.seed={values}")];
    let problem = plan_error(PIPELINE, &["train", "-p", &arguments[0], "-p", &arguments[1]]);
    assert!(
        problem
            .to_string()
            .contains("with the points of train, the plan has more than 10000 nodes"),
        "{problem}"
    );
}

/// Each error names its line.
#[test]
fn invalid_files_are_refused() {
    for (from, to, line, expected) in [
        (
            "default: [report]",
            "\n\ndefault: [reprot]",
            3,
            "default: no stage \"reprot\"; did you mean report?",
        ),
        (
            "{data: make}",
            "{data: maek}",
            5,
            "no stage \"maek\"; a folder starts with ./ or /; did you mean make?",
        ),
        ("{data: make}", "{date: make}", 5, "stage prep: no input \"date\"; did you mean data?"),
        (
            "extends: train",
            "extends: trian",
            11,
            "extends: no stage \"trian\"; did you mean train?",
        ),
        ("extends: train", "extends: train\n    run: x", 11, "remove one of them"),
        ("extends: train", "like: train", 11, "stages.again: unknown field `like`"),
        ("rays: 7", "rays: 0", 14, "parameter rays: 0 is less than the minimum"),
        ("rays: 7", "rayz: 7", 14, "parameter rayz: unknown; did you mean rays?"),
        ("rays: 7", "rays: .nan", 14, "stages.again.parameters.rays: expected a finite number"),
        ("rays: 7", "rays: -.inf", 14, "expected a finite number"),
        ("rays: 7", "rays: 7\n    prameters: {}", 15, "unknown field `prameters`"),
        (
            "rays: 7",
            "rays: 7\n      rays: 8",
            15,
            "stages.again.parameters: duplicate entry with key \"rays\"; remove one of them",
        ),
        (
            "      scene: prep/train",
            "      scene: prep/trian",
            9,
            "prep has no subtree \"trian\"; did you mean train?",
        ),
        (
            "truth: prep}",
            "truth: make}",
            16,
            "input truth takes kind scene, but make has kind data",
        ),
        (
            "{run: score}",
            "{run: score}\n  late: {run: report, inputs: {run: report}}",
            19,
            "input run: report is a sink, which has no artifact",
        ),
        (
            "{run: score}",
            "{run: score, more: ./x}",
            18,
            "input more: ./x is a folder, but a sink shows stages",
        ),
        ("{run: score}", "{}", 17, "input run is missing"),
        (
            "    inputs: {scene: prep/train}",
            "    inputs: {scene: prep/train, weights: again}",
            10,
            "stage again: inputs form a cycle",
        ),
        ("  make: {}", "  ../make: {}", 3, "stage \"../make\": choose a name of"),
        (
            "  make: {}",
            "  a/b: {}",
            3,
            "stage \"a/b\": choose a name of 1 to 100 bytes without `/`",
        ),
        ("  make: {}", "  a..b: {}", 3, "`..`"),
        ("  make: {}", "  -x: {}", 3, "starts with neither `.` nor `-`"),
        ("  make: {}", "  '': {}", 3, "1 to 100 bytes"),
        ("  make: {}", "  \"a\\nb\": {}", 3, "white space and control characters"),
        ("  train:\n", "  train:\n    run: other\n", 8, "stage train: no description of other"),
    ] {
        let text = PIPELINE.replace(from, to);
        let problem = plan_error(&text, &[]).to_string();
        assert!(
            problem.starts_with(&format!("dir/pipeline.yaml:{line}: "))
                && problem.contains(expected),
            "{to}: {problem}"
        );
    }
    // The program of an unneeded stage may be unknown.
    let unneeded = plan_of(&format!("{PIPELINE}  other: {{}}\n"), &[]).unwrap();
    assert_eq!(unneeded.nodes.len(), 4);
    let problem =
        plan_error(&format!("{PIPELINE}  other: {{}}\n"), &["-p", "nothing=1"]).to_string();
    assert!(
        problem.contains("has this parameter") && problem.contains("were not searched: other"),
        "{problem}"
    );
}

#[test]
fn byte_order_marks_crlf_and_merge_keys_are_accepted() {
    let expected =
        plan_of(PIPELINE, &[]).unwrap().nodes.iter().map(Node::label).collect::<Vec<_>>();
    let with_crlf = format!("\u{feff}{}", PIPELINE.replace('\n', "\r\n"));
    let merged = PIPELINE
        .replace("{scale: 2}", "&prep {scale: 2}")
        .replace("rays: 7", "<<: *prep\n      rays: 7");
    let found = plan_of(&with_crlf, &[]).unwrap().nodes.iter().map(Node::label).collect::<Vec<_>>();
    assert_eq!(found, expected);
    // A merged key is checked like any other key.
    let problem = plan_error(&merged, &[]).to_string();
    assert!(
        problem.starts_with("dir/pipeline.yaml:13: ")
            && problem.contains("parameter scale: unknown"),
        "{problem}"
    );
    let merged = PIPELINE
        .replace("      scene: prep/train", "      <<: &scene {scene: prep/train}")
        .replace("{scene: prep/train}\n    p", "*scene\n    p");
    assert_eq!(plan_of(&merged, &["again"]).unwrap().nodes.len(), 3);
    let merged =
        merged.replace("rays: 7", "rays: {x: 7}").replace("extends: train", "extends: [train]");
    let problem = plan_error(&merged, &["again"]).to_string();
    assert!(problem.starts_with("dir/pipeline.yaml:11: stages.again.extends"), "{problem}");
    // A tagged merge key is an ordinary key.
    let tagged = format!("!tag <<: {{a: 1}}\n{PIPELINE}");
    assert!(plan_error(&tagged, &[]).to_string().contains("dir/pipeline.yaml"));
}

#[test]
fn resources_are_inherited_and_gpus_choose_the_device() {
    let text = PIPELINE
        .replace("  make: {}", "  make: {resources: {cpus: 2}}")
        .replace("  train:\n", "  train:\n    resources: {gpus: 1, mem: 8G}\n")
        .replace("    extends: train\n", "    extends: train\n    resources: {mem: 4G}\n");
    let plan = plan_of(&text, &["again", "report"]).unwrap();
    let resources = |stage: &str| serde_json::to_value(plan.resources.get(stage)).unwrap();
    assert_eq!([resources("make"), resources("prep")], [json!({"cpus": 2}), json!(null)]);
    assert_eq!(
        [resources("train"), resources("again")],
        [json!({"gpus": 1, "mem": "8G"}), json!({"gpus": 1, "mem": "4G"})]
    );
    for (by_resources, device) in [(false, "cpu"), (true, "cuda:0")] {
        let devices = Devices { given: "cpu".to_owned(), by_resources };
        let plan = Plan { devices, resources: plan.resources.clone(), ..Plan::default() };
        assert_eq!((plan.device("again"), plan.device("prep")), (device, "cpu"));
    }
}

/// Returns the number of a node and its ancestors.
fn count_with_ancestors(plan: &Plan, node: usize) -> usize {
    let mut included = BTreeSet::from([node]);
    (0..=node)
        .rev()
        .filter(|&i| {
            included.contains(&i).then(|| included.extend(plan.nodes[i].parents())).is_some()
        })
        .count()
}

fn parent_labels(plan: &Plan, node: &Node) -> Vec<String> {
    node.parents().map(|p| plan.nodes[p].label()).collect()
}

/// A written plan that is read back gives each task its node and the node's ancestors.
#[test]
fn a_frozen_plan_contains_the_nodes_of_each_task() {
    use crate::frozen::FrozenPlan;
    let plan = plan_of(PIPELINE, &["-p", "supersample=1,2", "report"]).unwrap();
    let text = serde_json::to_vec(&FrozenPlan::new(&plan, Path::new("/out"))).unwrap();
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("plan.json"), &text).unwrap();
    let frozen = FrozenPlan::read(&folder.path().join("plan.json")).unwrap();
    for (index, node) in plan.nodes.iter().enumerate() {
        let task_plan = frozen.task_plan(index).unwrap();
        let last = task_plan.nodes.last().unwrap();
        assert_eq!((last.label(), &last.parameters), (node.label(), &node.parameters));
        assert_eq!(
            (parent_labels(&task_plan, last), task_plan.nodes.len()),
            (parent_labels(&plan, node), count_with_ancestors(&plan, index))
        );
    }
    let sink_plan = frozen.task_plan(plan.nodes.len()).unwrap();
    assert_eq!((sink_plan.nodes.len(), sink_plan.sinks[0].nodes().len()), (plan.nodes.len(), 2));
    assert!(frozen.task_plan(plan.nodes.len() + 1).is_err());
}
