//! The shipped further targets, `pipelines/` of the repository.

/// File names and texts.
pub(crate) const TARGETS: [(&str, &str); 9] = [
    ("export.yaml", include_str!("../../../../pipelines/export.yaml")),
    ("hr-finetune.yaml", include_str!("../../../../pipelines/hr-finetune.yaml")),
    ("paper-refine.yaml", include_str!("../../../../pipelines/paper-refine.yaml")),
    ("reference-refine.yaml", include_str!("../../../../pipelines/reference-refine.yaml")),
    ("refined.yaml", include_str!("../../../../pipelines/refined.yaml")),
    ("registered.yaml", include_str!("../../../../pipelines/registered.yaml")),
    ("sisr-fuse.yaml", include_str!("../../../../pipelines/sisr-fuse.yaml")),
    ("video.yaml", include_str!("../../../../pipelines/video.yaml")),
    ("viewer.yaml", include_str!("../../../../pipelines/viewer.yaml")),
];
