use dataset::{Format, Split, Turn};
use scene::Intrinsics;

use super::*;

fn set(format: Format, sizes: &[(u32, u32)]) -> Dataset {
    let frames = sizes.iter().map(|&(width, height)| Frame {
        name: String::new(),
        image: PathBuf::new(),
        turn: Turn::Stored,
        mask: None,
        depth_file: None,
        lens_intrinsics: Intrinsics::from_angle_x(width, height, 0.7),
        pinhole: None,
        camera_to_world: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]],
        depth_range: None,
    });
    Dataset { format, frames: frames.collect(), split: None, notes: Vec::new() }
}

/// Large photographs are shrunk. The narrowest photograph decides: images are never enlarged.
#[test]
fn images_keep_a_size_that_a_cpu_can_train() {
    for (format, sizes, line) in [
        (Format::Colmap, vec![(640, 480)], "lr_source: photographs"),
        (Format::Transforms, vec![(800, 600), (4000, 3000)], "lr_source: photographs"),
        (Format::Llff, vec![(640, 480)], "lr_source: downscaled"),
        (Format::Blender, vec![(801, 801)], "lr_width: 400"),
        (Format::Colmap, vec![(4000, 3000), (3000, 4000)], "lr_width: 400"),
    ] {
        let images = image_parameters(&set(format, &sizes));
        assert!(images.trim_start().starts_with(line), "{format} {sizes:?}: {images}");
    }
}

#[test]
fn summaries_describe_the_data_set() {
    let several = set(Format::Colmap, &[(640, 480), (480, 640)]);
    assert_eq!(summarize(&several), "COLMAP (sparse): 2 photographs of several sizes");
    let single = set(Format::Llff, &[(640, 480)]);
    assert_eq!(summarize(&single), "LLFF (poses_bounds.npy): 1 photograph of 640×480");
    let own_split = Split { train: vec![0], test: vec![1] };
    for (split, expected) in [(None, "every eighth view"), (Some(own_split), "own test views")] {
        let text = pipeline_text(&Dataset { split, ..several.clone() }, "found", "./data");
        assert!(text.contains(expected) && !text.contains(['{', '}']), "{text}");
    }
}

/// The text has the sizes of photographs, training images and views, with and without shrinking.
#[test]
fn sizes_are_described() {
    for (format, sizes_of_photographs, expected) in [
        (
            Format::Colmap,
            vec![(1080, 1920); 2],
            "photographs 1080×1920; training at 400, views at 800; `-p lr_source=photographs` \
            gives views at 2160",
        ),
        (
            Format::Blender,
            vec![(800, 800)],
            "photographs 800×800; training at 400, views at 800; `-p lr_source=photographs` \
            gives views at 1600",
        ),
        (
            Format::Colmap,
            vec![(640, 480)],
            "photographs 640×480; training at their size, views at 1280",
        ),
        (
            Format::Colmap,
            vec![(640, 480), (480, 640)],
            "photographs of several sizes; training at their size, views 2 times as wide as each \
            photograph",
        ),
    ] {
        assert_eq!(sizes(&set(format, &sizes_of_photographs)), expected);
    }
}

/// Every file of `pipelines/` and `experiments/` is shipped.
#[test]
fn no_target_is_missing() {
    for folder in ["pipelines", "experiments"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../..").join(folder);
        let mut names: Vec<String> = fs::read_dir(path)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        let shipped = TARGETS.iter().filter(|target| target.0 == folder);
        let targets: Vec<&str> = shipped.map(|target| target.1).collect();
        assert_eq!(names, targets);
    }
}

#[test]
fn images_without_cameras_come_with_a_command() {
    for (subfolder, count, expected) in [
        ("images", 2, "2 images, but no cameras; estimate them with COLMAP: `colmap "),
        ("", 2, "estimate them with COLMAP: move them to 'DIR/images', then `colmap "),
        ("photos", 2, "COLMAP: rename 'DIR/photos' 'DIR/images', then `colmap "),
        ("rgb", 1, "1 image, but no cameras; give several photographs, taken from different"),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join(subfolder);
        fs::create_dir_all(&folder).unwrap();
        for number in 0..count {
            fs::write(folder.join(format!("{number}.jpg")), "").unwrap();
        }
        let error = Starter::new(dir.path(), Path::new("pipeline.yaml")).unwrap_err().to_string();
        let expected = expected.replace("DIR", &dir.path().display().to_string());
        assert!(error.contains(&expected), "{error}");
    }
}

#[test]
fn experiments_run_on_the_pipelines_own_scene() {
    let text = "experiment:\n  scenes: [lego, chair]\n    inputs: {dataset: demo-scene}\n";
    for (dataset, expected) in
        [("./a", "./../a"), (r#""./a \"b\"""#, r#"./../a \"b\""#), ("/data/a", "/data/a")]
    {
        let written = own_scene(text, dataset);
        assert!(written.contains(&format!("dataset: \"{expected}\"}}")), "{written}");
        assert!(written.contains("\n  scenes: [demo] #"), "{written}");
    }
}
