//! Conversion of the reference implementation's checkpoints, written by PyTorch (`make goldens`),
//! to a field, and of released weights for `upsample`.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

use common::{Finished, Project, demo_train, stage};

fn root_file(file: &str) -> PathBuf {
    common::root().join(file)
}

fn convert_checkpoint(coarse: &Path, fine: &Path, out: &Path) -> Finished {
    let script = root_file("scripts/convert-checkpoint.py");
    Finished::of(Command::new("python3").arg(script).args([coarse, fine, out]).output().unwrap())
}

#[test]
fn a_checkpoint_of_the_reference_is_rendered() {
    let project = Project::tiny();
    let [coarse, fine] =
        ["tests/data/7_net_Coarse.pth", "tests/data/7_net_Fine.pth"].map(root_file);
    let field = project.path("field");
    let finished = convert_checkpoint(&coarse, &fine, &field);
    assert_eq!(finished.code, 0, "{}", finished.stderr);

    // Layer k contains k, k + 1/8, …, row by row, for any precision and strides.
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
    // All weights are this large and none is negative, so space is opaque and white.
    let image = pixels::read_exr(&views.join("images/r_0.exr")).unwrap();
    assert_eq!((image.width, image.height), (8, 8));
    for name in ["R", "G", "B", "A"] {
        assert_eq!(image.channel(name).unwrap(), [1.0; 64], "channel {name}");
    }
    // The depth is that of the scene's border.
    let depths = image.channel("Z").unwrap();
    assert!(depths.iter().all(|depth| (1.5..3.5).contains(depth)), "{depths:?}");
}

#[track_caller]
fn assert_checkpoint_refused(coarse: &Path, fine: &Path, out: &Path, texts: &[&str]) {
    let finished = convert_checkpoint(coarse, fine, out);
    finished.fails(1, texts);
    assert_eq!(finished.stderr.lines().count(), 1, "{}", finished.stderr);
    assert!(!out.exists());
}

#[test]
fn other_files_than_checkpoints_are_refused_in_one_line() {
    let project = Project::tiny();
    let [coarse, fine] =
        ["tests/data/7_net_Coarse.pth", "tests/data/7_net_Fine.pth"].map(root_file);
    let out = project.path("out");
    assert_checkpoint_refused(
        &project.path("nowhere.pth"),
        &fine,
        &out,
        &["nowhere.pth", "No such file"],
    );
    assert_checkpoint_refused(
        &root_file("Cargo.toml"),
        &fine,
        &out,
        &["Cargo.toml", "not a checkpoint"],
    );
    let bytes = std::fs::read(&coarse).unwrap();
    let cut = project.path("cut.pth");
    for length in [0, 1, bytes.len() / 3, bytes.len() - 1] {
        std::fs::write(&cut, &bytes[..length]).unwrap();
        assert_checkpoint_refused(&cut, &fine, &out, &["cut.pth", "not a"]);
    }
    // A pickle that would run a command.
    let hostile = project.path("hostile.pth");
    let script = "import os, pickle, sys, zipfile\n\
                 class Run:\n    def __reduce__(self): return os.system, ('touch ' + sys.argv[1] \
                 + '.ran',)\n\
                 zipfile.ZipFile(sys.argv[1], 'w').writestr('x/data.pkl', pickle.dumps(Run()))\n";
    assert!(Command::new("python3").args(["-c", script]).arg(&hostile).status().unwrap().success());
    assert_checkpoint_refused(&hostile, &fine, &out, &["hostile.pth", "system"]);
    assert!(!hostile.with_extension("pth.ran").exists());
}

fn convert_weights(network: &str, from: &str, out: &Path) -> Finished {
    let script = root_file("scripts/convert-weights.py");
    Finished::of(
        Command::new("python3")
            .arg(script)
            .arg(network)
            .arg(root_file(from))
            .arg(out)
            .output()
            .unwrap(),
    )
}

#[track_caller]
fn assert_weights_refused(out: &Path, network: &str, from: &str, texts: &[&str]) {
    let finished = convert_weights(network, from, out);
    finished.fails(1, texts);
    assert!(finished.stderr.lines().count() == 1 && !out.exists(), "{}", finished.stderr);
}

/// Converted files contain the released tensors unchanged; another network's weights and files
/// without weights are refused.
#[test]
fn released_weights_are_converted_for_upsample() {
    let project = Project::tiny();
    for (network, golden) in [("imdn", "imdn"), ("liif", "liif"), ("swinir", "swinir_light")] {
        let out = project.path(&format!("{network}.safetensors"));
        let finished = convert_weights(network, &format!("tests/data/{network}.pth"), &out);
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        let expected = std::fs::read(root_file(&format!(
            "stages/upsample/tests/goldens/{golden}.safetensors"
        )))
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
    assert_weights_refused(
        &out,
        "imdn",
        "tests/data/liif.pth",
        &["liif.pth", "fea_conv.weight is missing", "imdn"],
    );
    assert_weights_refused(
        &out,
        "swinir",
        "tests/data/imdn.pth",
        &["conv_first.weight is missing"],
    );
    assert_weights_refused(&out, "liif", "Cargo.toml", &["Cargo.toml", "not a checkpoint"]);
}
