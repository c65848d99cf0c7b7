//! `nerf-sr run video`: a flight through the scene, rendered and shown as a film.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::process::Command;

use common::Project;

fn project() -> Project {
    Project::shipped(&["video"], "  camera-path:\n    parameters: {frames: 6}\n")
}

#[test]
fn a_flight_is_rendered_and_filmed() {
    let project = project();
    // The film's block extends the other.
    let first = project.run(&["run", "video", "-p", "render-depth.samples_per_axis=1"]);
    assert_eq!(first.code, 0, "{}", first.stderr);
    for i in 0..6 {
        let frame =
            pixels::read_png(&project.path(&format!("out/video/frames/{i:05}.png"))).unwrap();
        // Colour and depth, each of HR's size.
        assert_eq!((frame.width, frame.height), (96, 48));
        let levels = |half: usize| (0..48 * 48).map(move |k| (k / 48) * 96 + half * 48 + k % 48);
        for half in [0, 1] {
            let first = &frame.data[4 * levels(half).next().unwrap()..][..3];
            assert!(
                levels(half).any(|p| &frame.data[4 * p..][..3] != first),
                "half {half} of frame {i} is one colour"
            );
        }
    }
    // Evaluation isn't part of a film.
    assert!(!first.stdout.contains("eval"), "{}", first.stdout);
    if Command::new("ffmpeg").arg("-version").output().is_err() {
        assert!(first.stderr.contains("no video.mp4: ffmpeg isn't installed"), "{}", first.stderr);
        eprintln!("skipped: no ffmpeg");
        return;
    }
    // The path's rate; the first box, behind its length.
    let words = "video.mp4: H.264, quality CRF 18, 30 frames per second, 0.2 s";
    assert!(first.stderr.contains(words), "{}", first.stderr);
    let film = std::fs::read(project.path("out/video/video.mp4")).unwrap();
    assert_eq!(film.get(4..8), Some(&b"ftyp"[..]), "no MP4 file");
}

/// Without ffmpeg the film is an animated PNG, of colour alone if depth isn't requested, and at
/// most 640 pixels wide.
#[test]
fn without_ffmpeg_the_film_is_an_animated_png() {
    let project = project();
    let programs = tempfile::tempdir().unwrap();
    let arguments = ["run", "video", "-p", "samples_per_axis=1", "-p", "show_depth=false"];
    let size = ["-p", "camera-path.size=700"];
    let output = project
        .command(&[&arguments[..], &size].concat())
        .env("PATH", programs.path())
        .output()
        .unwrap();
    let finished = common::Finished::of(output);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    let words = "no video.mp4: ffmpeg isn't installed; video.png is an animated PNG instead";
    assert!(finished.stderr.contains(words), "{}", finished.stderr);
    let size_of = |file: &str| {
        let image = pixels::read_png(&project.path(file)).unwrap();
        (image.width, image.height)
    };
    assert_eq!(size_of("out/video/frames/00005.png"), (700, 700));
    assert_eq!(size_of("out/video/video.png"), (640, 640));
    let bytes = std::fs::read(project.path("out/video/video.png")).unwrap();
    let chunks = |name: &[u8]| bytes.windows(4).filter(|window| *window == name).count();
    // At 30 frames per second every other frame.
    assert_eq!([b"acTL", b"fcTL"].map(|name| chunks(name)), [1, 3]);
    assert!(!project.path("out/video/video.mp4").exists());
}

/// `camera_path.json` of a path gives the path again, and its rate is the film's.
#[test]
fn a_written_path_is_a_path() {
    let project = project();
    project.ok(&["run", "camera-path"]);
    let file = |name: &str, arguments: &[&str]| {
        let folder = project.artifact("camera-path", &[&["camera-path"], arguments].concat());
        std::fs::read_to_string(folder.join(name)).unwrap()
    };
    let first = project.artifact("camera-path", &["camera-path"]);
    let again = ["-i", &format!("camera-path.path={}", first.display())];
    project.ok(&[&["run", "camera-path"], &again[..]].concat());
    for name in ["camera_path.json", "views.json"] {
        assert_eq!(file(name, &again), file(name, &[]), "{name}");
    }
    project.write(
        "slow/camera_path.json",
        &file("camera_path.json", &[]).replace("\"fps\": 30", "\"fps\": 12.5"),
    );
    let slow =
        ["-i", "camera-path.path=slow", "-p", "samples_per_axis=1", "-p", "show_depth=false"];
    let run = project.run(&[&["run", "video"], &slow[..]].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    if Command::new("ffmpeg").arg("-version").output().is_ok() {
        assert!(run.stderr.contains("12.5 frames per second, 0.5 s"), "{}", run.stderr);
    }
}

/// The film of refined views differs from the other, and has their depth.
#[test]
fn a_film_of_refined_views() {
    let blocks = "  camera-path:\n    parameters: {frames: 2}\n  downscaled-field:\n    \
        parameters: {rays: 80000}\n  train-refine:\n    parameters: {steps: 60, batch_size: 4, \
        patch_size: 16, features: 8, blocks: 1}\n";
    let project = Project::shipped(&["refined-video"], blocks);
    project.ok(&["run", "video", "refined-video"]);
    let frame = |folder: &str| {
        let path = project.path(&format!("out/{folder}/frames/00001.png"));
        pixels::read_png(&path).unwrap()
    };
    let (rendered, refined) = (frame("video"), frame("refined-video"));
    assert_eq!((refined.width, refined.height), (96, 48));
    let differing = |columns: std::ops::Range<usize>| {
        let pixels = columns.flat_map(|x| (0..48).map(move |y| 4 * (y * 96 + x)));
        pixels.filter(|&i| rendered.data[i..i + 3] != refined.data[i..i + 3]).count()
    };
    assert!(differing(0..48) > 100 && differing(48..96) == 0, "{}", differing(0..48));
    // The views of the training of the refiner have no film.
    let films = std::fs::read_dir(project.path("out/refined-video")).unwrap();
    assert!(films.map(|entry| entry.unwrap().file_name()).all(|name| name != "downscaled-views"));
}
