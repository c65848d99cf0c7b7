//! Reads a real LLFF scene.

use std::path::{Path, PathBuf};

use dataset::{Dataset, Format};

#[test]
fn fern_is_read() {
    let data = std::env::var("NERF_SR_DATA").map_or_else(
        |_| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../../../shared/data"),
        PathBuf::from,
    );
    let folder = data.join("nerf_llff_data/fern");
    if !folder.is_dir() {
        eprintln!("skipped: no data ({} is not there; set NERF_SR_DATA)", folder.display());
        return;
    }
    let set = Dataset::read(&folder).unwrap();
    assert_eq!((set.format, set.frames.len()), (Format::Llff, 20));
    let frame = &set.frames[0];
    assert_eq!(frame.name, "IMG_4026");
    let k = frame.lens_intrinsics;
    assert_eq!((k.width, k.height, k.cx, k.cy), (4032, 3024, 2016.0, 1512.0));
    assert!((k.fx - 3260.5).abs() < 1.0, "{}", k.fx);
    // All cameras face about the same direction, and are closer together than the near bound.
    let first = frame.camera();
    for frame in &set.frames {
        let camera = frame.camera();
        assert!(camera.forward().dot(first.forward()) > 0.9, "{}", frame.name);
        let [near, far] = frame.depth_range.unwrap();
        assert!(
            (camera.centre() - first.centre()).length() < near && near < far,
            "{} {near} {far}",
            frame.name
        );
    }
    let image = frame.photograph().unwrap();
    assert_eq!((image.width, image.height), (4032, 3024));
    // Lens distortion is in COLMAP's model; poses_bounds.npy has none.
    assert!((k.distortion.radial[0] - 0.01975).abs() < 1e-5, "{:?}", k.distortion);
}
