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
    let film = std::fs::read(project.path("out/video/video.mp4"));
    if Command::new("ffmpeg").arg("-version").output().is_err() {
        assert!(first.stderr.contains("no video.mp4: ffmpeg isn't installed") && film.is_err());
        eprintln!("skipped: no ffmpeg");
        return;
    }
    // The first box, behind its length.
    let film = film.unwrap_or_else(|e| panic!("no film: {e}\n{}", first.stderr));
    assert_eq!(film.get(4..8), Some(&b"ftyp"[..]), "no MP4 file");
}

#[test]
fn a_list_of_poses_is_a_path_and_a_wrong_one_is_refused() {
    let project = project();
    project.replace(
        "{frames: 6}",
        "{poses: [[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4]], [[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 4]]]}",
    );
    project.ok(&["run", "camera-path"]);
    let summary = project.artifact("camera-path", &["camera-path"]).join("summary.txt");
    assert!(std::fs::read_to_string(summary).unwrap().contains("2 frames of 48×48, list"));
    project.replace("[1, 0, 0, 1]", "[3, 0, 0, 1]");
    project.run(&["run", "camera-path"]).fails(2, &["poses", "frame_00001", "not a rigid motion"]);
}
