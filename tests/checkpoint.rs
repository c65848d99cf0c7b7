//! Checkpoints of the reference implementation, written by PyTorch itself (`make goldens`), become
//! a field that is rendered.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

use common::{Finished, Project, demo_train, stage};

fn here(file: &str) -> PathBuf {
    common::root().join(file)
}

fn convert(coarse: &Path, fine: &Path, out: &Path) -> Finished {
    let script = here("scripts/convert-checkpoint.py");
    Finished::of(Command::new("python3").arg(script).args([coarse, fine, out]).output().unwrap())
}

#[test]
fn a_checkpoint_of_the_reference_is_rendered() {
    let project = Project::tiny();
    let [coarse, fine] = ["tests/data/7_net_Coarse.pth", "tests/data/7_net_Fine.pth"].map(here);
    let field = project.path("field");
    let done = convert(&coarse, &fine, &field);
    assert_eq!(done.code, 0, "{}", done.stderr);

    // Layer k holds k, k + 1/8, …, row by row, whatever its precision and strides were.
    let bytes = std::fs::read(field.join("field-0.safetensors")).unwrap();
    let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    assert_eq!(tensors.len(), 40);
    for network in ["coarse", "fine"] {
        for (layer, shape, first) in [
            ("xyz_encoding_5.0", vec![8, 23], 4.0f32),
            ("sigma", vec![1, 8], 6.0),
            ("rgb.0", vec![3, 4], 9.0),
        ] {
            let weight = tensors.tensor(&format!("{network}.{layer}.weight")).unwrap();
            assert_eq!(weight.shape(), shape);
            let (numbers, _) = weight.data().as_chunks::<4>();
            for (i, number) in numbers.iter().enumerate() {
                assert_eq!(
                    f32::from_le_bytes(*number),
                    first + i as f32 / 8.0,
                    "{network}.{layer} {i}"
                );
            }
        }
    }

    demo_train(&project, 6);
    let (cameras, views) = (project.path("scene/cameras"), project.path("views"));
    let rendered = stage(
        "render-depth",
        r#"{"size": 8}"#,
        &[("field", &field), ("cameras", &cameras)],
        &views,
        &[],
    );
    assert_eq!(rendered.code, 0, "{}", rendered.stderr);
    // Where all weights are this large and none is negative, space is opaque and white.
    let image = pixels::read_exr(&views.join("images/r_0.exr")).unwrap();
    assert_eq!((image.width, image.height), (8, 8));
    for name in ["R", "G", "B", "A"] {
        assert_eq!(image.channel(name).unwrap(), [1.0; 64], "channel {name}");
    }
    // Its border is seen, about where the scene begins.
    let depths = image.channel("Z").unwrap();
    assert!(depths.iter().all(|depth| (1.5..3.5).contains(depth)), "{depths:?}");
}

#[track_caller]
fn assert_no_checkpoint(coarse: &Path, fine: &Path, out: &Path, words: &[&str]) {
    let said = convert(coarse, fine, out);
    said.fails(1, words);
    assert_eq!(said.stderr.lines().count(), 1, "{}", said.stderr);
    assert!(!out.exists());
}

#[test]
fn what_is_no_checkpoint_is_one_line() {
    let project = Project::tiny();
    let [coarse, fine] = ["tests/data/7_net_Coarse.pth", "tests/data/7_net_Fine.pth"].map(here);
    let out = project.path("out");
    assert_no_checkpoint(
        &project.path("nowhere.pth"),
        &fine,
        &out,
        &["nowhere.pth", "No such file"],
    );
    assert_no_checkpoint(&here("Cargo.toml"), &fine, &out, &["Cargo.toml", "not a checkpoint"]);
    let bytes = std::fs::read(&coarse).unwrap();
    let cut = project.path("cut.pth");
    for length in [0, 1, bytes.len() / 3, bytes.len() - 1] {
        std::fs::write(&cut, &bytes[..length]).unwrap();
        assert_no_checkpoint(&cut, &fine, &out, &["cut.pth", "not a"]);
    }
    // A pickle that would run something.
    let hostile = project.path("hostile.pth");
    let write = "import os, pickle, sys, zipfile\n\
                 class Run:\n    def __reduce__(self): return os.system, ('touch ' + sys.argv[1] \
                 + '.ran',)\n\
                 zipfile.ZipFile(sys.argv[1], 'w').writestr('x/data.pkl', pickle.dumps(Run()))\n";
    assert!(Command::new("python3").args(["-c", write]).arg(&hostile).status().unwrap().success());
    assert_no_checkpoint(&hostile, &fine, &out, &["hostile.pth", "system"]);
    assert!(!hostile.with_extension("pth.ran").exists());
}

fn convert_weights(network: &str, from: &str, out: &Path) -> Finished {
    let script = here("scripts/convert-weights.py");
    Finished::of(
        Command::new("python3").arg(script).arg(network).arg(here(from)).arg(out).output().unwrap(),
    )
}

#[track_caller]
fn assert_no_weights(out: &Path, network: &str, from: &str, words: &[&str]) {
    let said = convert_weights(network, from, out);
    said.fails(1, words);
    assert!(said.stderr.lines().count() == 1 && !out.exists(), "{}", said.stderr);
}

/// Weights as their projects release them become files that hold the same tensors; those of another
/// network, or of none, are refused.
#[test]
fn released_weights_become_what_upsample_reads() {
    let project = Project::tiny();
    for (network, golden) in [("imdn", "imdn"), ("liif", "liif"), ("swinir", "swinir_light")] {
        let out = project.path(&format!("{network}.safetensors"));
        let done = convert_weights(network, &format!("tests/data/{network}.pth"), &out);
        assert_eq!(done.code, 0, "{}", done.stderr);
        let expected =
            std::fs::read(here(&format!("stages/upsample/tests/goldens/{golden}.safetensors")))
                .unwrap();
        let (found, expected) = (std::fs::read(&out).unwrap(), expected);
        let [found, expected] =
            [&found, &expected].map(|bytes| safetensors::SafeTensors::deserialize(bytes).unwrap());
        let names = || expected.names().into_iter().filter(|name| !name.starts_with("golden."));
        assert_eq!(found.len(), names().count(), "{network}");
        for name in names() {
            let [a, b] = [&found, &expected].map(|file| file.tensor(name).unwrap());
            assert!(a.shape() == b.shape() && a.data() == b.data(), "{network}: {name}");
        }
    }
    let out = project.path("none.safetensors");
    assert_no_weights(
        &out,
        "imdn",
        "tests/data/liif.pth",
        &["liif.pth", "fea_conv.weight is missing", "imdn"],
    );
    assert_no_weights(&out, "swinir", "tests/data/imdn.pth", &["conv_first.weight is missing"]);
    assert_no_weights(&out, "liif", "Cargo.toml", &["Cargo.toml", "not a checkpoint"]);
}
