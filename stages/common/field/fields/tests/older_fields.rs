//! Fields trained by an older build render unchanged, or are refused. The files in `goldens/` are
//! of the demo scene at 16 px: weights of `mlp` are from commit 5af0c3e, weights of `grid` from the
//! first commit with format 2. Descriptions have today's format and names.

#![allow(missing_docs, reason = "a test")]

use std::path::Path;

use artifact::GivenInput;
use fields::FieldArtifact;
use fields::{FIELD_FILE, FieldFile};
use radiance::{Ray, RayField as _};
use scene::{Camera, Intrinsics, Views};

fn goldens() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/goldens"))
}

/// Creates a field artifact from the older build's compressed weights.
fn artifact(name: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::copy(goldens().join(format!("{name}.json")), folder.path().join(FIELD_FILE)).unwrap();
    let packed = std::fs::File::open(goldens().join(format!("{name}.safetensors.gz"))).unwrap();
    let mut weights = std::fs::File::create(folder.path().join(FieldFile::member_file(0))).unwrap();
    std::io::copy(&mut flate2::read::GzDecoder::new(packed), &mut weights).unwrap();
    folder
}

fn ray(camera: &Camera, i: u32) -> Ray {
    let width = camera.intrinsics.width;
    let ray = camera.ray(f64::from(i % width) + 0.5, f64::from(i / width) + 0.5);
    Ray::new(&ray, [1.0; 3])
}

fn rays(camera: &Camera) -> Vec<Ray> {
    let Intrinsics { width, height, .. } = camera.intrinsics;
    (0..width * height).map(|i| ray(camera, i)).collect()
}

/// Compares a render with the older build's EXR file, whose colours have half precision.
fn assert_renders_as_before(name: &str) {
    let folder = artifact(name);
    let members =
        FieldArtifact::read(&GivenInput::open("field", folder.path()).unwrap(), "cpu").unwrap();
    let views: Views =
        serde_json::from_slice(&std::fs::read(goldens().join("views.json")).unwrap()).unwrap();
    let expected = pixels::read_exr(&goldens().join(format!("{name}.exr"))).unwrap();
    let channel = |name: &str| expected.channel(name).unwrap();
    let rendered = members.render(&rays(&views.views[0].camera)).unwrap();
    assert_eq!(rendered.len(), channel("A").len());
    assert!(
        channel("A").iter().any(|a| *a > 0.5) && channel("A").iter().any(|a| *a < 0.99),
        "the view must contain opaque and transparent pixels"
    );
    for (i, pixel) in rendered.iter().enumerate() {
        for (value, name) in
            pixel.premultiplied.into_iter().chain([pixel.opacity]).zip(["R", "G", "B", "A"])
        {
            let expected_value = channel(name)[i];
            assert!(
                (value - expected_value).abs() < 1e-3,
                "pixel {i} {name}: {value}, expected {expected_value}"
            );
        }
    }
}

#[test]
fn a_grid_renders_as_before() {
    assert_renders_as_before("grid");
}

#[test]
fn a_grid_without_a_format_is_refused() {
    let folder = artifact("grid");
    let file = folder.path().join(FIELD_FILE);
    let mut description: serde_json::Value =
        serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    // Files of the first format have no `format`.
    description.as_object_mut().unwrap().remove("format").unwrap();
    std::fs::write(&file, description.to_string()).unwrap();
    let error = FieldArtifact::read(&GivenInput::open("field", folder.path()).unwrap(), "cpu")
        .err()
        .unwrap();
    let message = format!("{error:#}");
    assert!(
        message.ends_with(
            "field has format 1 of another build; this build reads format 3: train the field again"
        ),
        "{message}"
    );
}

#[cfg(feature = "torch")]
#[test]
fn the_papers_mlps_render_as_before() {
    assert_renders_as_before("mlp");
}
