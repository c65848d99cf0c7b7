//! `nerf-sr run video`: a flight through the scene, rendered and written as a film.

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
    // `render-depth`'s parameter applies to the film's views, whose block extends `render-depth`.
    let finished = project.run(&["run", "video", "-p", "render-depth.samples_per_axis=1"]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    for i in 0..6 {
        let frame =
            pixels::read_png(&project.path(&format!("out/video/frames/{i:05}.png"))).unwrap();
        // Colour and depth, each of the HR size.
        assert_eq!((frame.width, frame.height), (96, 48));
        let pixel_indices =
            |half: usize| (0..48 * 48).map(move |k| (k / 48) * 96 + half * 48 + k % 48);
        for half in [0, 1] {
            let first_colour = &frame.data[4 * pixel_indices(half).next().unwrap()..][..3];
            assert!(
                pixel_indices(half).any(|p| &frame.data[4 * p..][..3] != first_colour),
                "half {half} of frame {i} is one colour"
            );
        }
    }
    // A film needs no evaluation.
    assert!(!finished.stdout.contains("eval"), "{}", finished.stdout);
    if Command::new("ffmpeg").arg("-version").output().is_err() {
        assert!(
            finished.stderr.contains("no video.mp4: ffmpeg isn't installed"),
            "{}",
            finished.stderr
        );
        eprintln!("skipped: no ffmpeg");
        return;
    }
    // The frame rate is that of the camera path.
    let message = "video.mp4: H.264, quality CRF 18, 30 frames per second, 0.2 s";
    assert!(finished.stderr.contains(message), "{}", finished.stderr);
    let film = std::fs::read(project.path("out/video/video.mp4")).unwrap();
    // The type of the first box follows its length of four bytes.
    assert_eq!(film.get(4..8), Some(&b"ftyp"[..]), "no MP4 file");
}

/// The animated PNG contains only colour if depth isn't requested, and is at most 640 pixels wide.
#[test]
fn without_ffmpeg_the_film_is_an_animated_png() {
    let project = project();
    let empty_folder = tempfile::tempdir().unwrap();
    let arguments = ["run", "video", "-p", "samples_per_axis=1", "-p", "show_depth=false"];
    let size = ["-p", "camera-path.size=700"];
    let output = project
        .command(&[&arguments[..], &size].concat())
        .env("PATH", empty_folder.path())
        .output()
        .unwrap();
    let finished = common::Finished::of(output);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    let message = "no video.mp4: ffmpeg isn't installed; video.png is an animated PNG instead";
    assert!(finished.stderr.contains(message), "{}", finished.stderr);
    let image_size = |file: &str| {
        let image = pixels::read_png(&project.path(file)).unwrap();
        (image.width, image.height)
    };
    assert_eq!(image_size("out/video/frames/00005.png"), (700, 700));
    assert_eq!(image_size("out/video/video.png"), (640, 640));
    let bytes = std::fs::read(project.path("out/video/video.png")).unwrap();
    let chunks = |name: &[u8]| bytes.windows(4).filter(|window| *window == name).count();
    // Of 30 frames per second, an animated PNG contains every other frame.
    assert_eq!([b"acTL", b"fcTL"].map(|name| chunks(name)), [1, 3]);
    assert!(!project.path("out/video/video.mp4").exists());
}

/// A written `camera_path.json` gives the same path again, and sets the film's frame rate.
#[test]
fn a_written_camera_path_can_be_read() {
    let project = project();
    project.ok(&["run", "camera-path"]);
    let file = |name: &str, arguments: &[&str]| {
        let folder = project.artifact("camera-path", &[&["camera-path"], arguments].concat());
        std::fs::read_to_string(folder.join(name)).unwrap()
    };
    let path_folder = project.artifact("camera-path", &["camera-path"]);
    let reread = ["-i", &format!("camera-path.path={}", path_folder.display())];
    project.ok(&[&["run", "camera-path"], &reread[..]].concat());
    for name in ["camera_path.json", "views.json"] {
        assert_eq!(file(name, &reread), file(name, &[]), "{name}");
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

/// The film of refined views differs from the rendered film in colour, but not in depth.
#[test]
fn a_film_of_refined_views_has_refined_colours() {
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
    // The refiner's training views have no film.
    let films = std::fs::read_dir(project.path("out/refined-video")).unwrap();
    assert!(films.map(|entry| entry.unwrap().file_name()).all(|name| name != "downscaled-views"));
}
