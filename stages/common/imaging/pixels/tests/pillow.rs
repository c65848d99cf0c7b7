//! Comparison of our resampling with pinned Pillow's, sample by sample: odd sizes, one axis alone,
//! enlarging, transparent edges.

#![allow(missing_docs, reason = "a test")]
#[allow(unreachable_pub, reason = "shared with eval's tests")]
mod pattern;

use pixels::{Filter, Rgba8, resize_pillow};

#[test]
fn equals_pillow_on_every_sample() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/pillow");
    let list: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.join("cases.json")).unwrap()).unwrap();
    let cases = list["cases"].as_array().unwrap();
    assert_eq!(cases.len(), 27);
    for case in cases {
        let size = |key: &str| [0, 1].map(|i| case[key][i].as_u64().unwrap() as usize);
        let ([w, h], [tw, th]) = (size("source"), size("target"));
        let filter = match case["filter"].as_str().unwrap() {
            "box" => Filter::Box,
            "bicubic" => Filter::Bicubic,
            "lanczos" => Filter::Lanczos,
            other => panic!("unknown filter {other}"),
        };
        let image =
            Rgba8::new(w, h, pattern::pattern(w, h, 4, case["seed"].as_u64().unwrap() as u32));
        let ours = resize_pillow(&image, tw, th, filter);
        let theirs = std::fs::read(folder.join(case["file"].as_str().unwrap())).unwrap();
        let differing = ours.data.iter().zip(&theirs).filter(|(a, b)| a != b).count();
        assert_eq!((ours.data.len(), differing), (theirs.len(), 0), "{case}");
    }
}
