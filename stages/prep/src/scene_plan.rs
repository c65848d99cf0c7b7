use artifact::{Failure, WARNING, bail_bad_input, bail_usage, format_number};
use dataset::{Dataset, Frame, Split};
use scene::{Background, Bounds, Camera, Space, format_length};

use crate::bounds::{CameraDepths, scene_bounds};
use crate::image_plan::ImagePlan;
use crate::params::Params;
use crate::pose_conventions::convention_warning;
use crate::pose_warnings;
use crate::split::choose_references;

/// All decisions about a scene before anything is written.
pub(crate) struct ScenePlan<'a> {
    pub(crate) images: ImagePlan,
    pub(crate) background: Background,
    pub(crate) bounds: Bounds,
    /// Training views.
    pub(crate) train: Vec<&'a Frame>,
    /// Indices of the training views that are references.
    pub(crate) references: Vec<usize>,
    /// Test views.
    pub(crate) test: Vec<&'a Frame>,
}

impl<'a> ScenePlan<'a> {
    /// Plans a scene; fails if bounds or parameters are invalid.
    pub(crate) fn new(
        set: &'a Dataset,
        split: &Split,
        params: &Params,
        images: ImagePlan,
        background: Background,
    ) -> Result<Self, Failure> {
        let train: Vec<&Frame> = split.train.iter().map(|&i| &set.frames[i]).collect();
        let test: Vec<&Frame> = split.test.iter().map(|&i| &set.frames[i]).collect();
        let bounds = bounds(&train, &test, params, background)?;
        let count = if images.has_truth { params.hr_references as usize } else { 0 };
        let references = choose_references(train.iter().map(|f| f.camera().centre()), count);
        Ok(Self { images, background, bounds, train, references, test })
    }
}

/// Message about a bounding box whose sides vanish in f64.
const EMPTY_BOX: &str =
    "dataset: the scene's bounding box has no volume; check the poses and their unit";
/// Minimum side of a scene, and maximum of `far`, in scene units: the product of two distances must
/// be representable in single precision.
const MIN_SIDE: f64 = 1e-18;
const MAX_FAR: f64 = 1e18;

/// Returns the scene's bounds from cameras, depths and parameters.
fn bounds(
    train: &[&Frame],
    test: &[&Frame],
    params: &Params,
    background: Background,
) -> Result<Bounds, Failure> {
    // If both `near` and `far` are given, they replace unknown depths of views.
    let given = params
        .near
        .zip(params.far)
        .map(|(near, far)| [near, far])
        .filter(|[near, far]| 0.0 < *near && near < far);
    let (train, test) = (camera_depths(train, given), camera_depths(test, given));
    let is_unbounded = background == Background::Opaque;
    let mut bounds = scene_bounds(&train, &test, is_unbounded, params.space)
        .map_err(|reason| Failure::Usage(reason.to_owned()))?;
    if !bounds.is_valid() {
        return Err(Failure::BadInput(EMPTY_BOX.to_owned()));
    }
    let side = bounds.longest_side();
    if side < MIN_SIDE {
        bail_bad_input!(
            "dataset: the scene is {} units wide, less than {MIN_SIDE:e}; multiply all camera \
            centres by a constant",
            format_length(side, 3)
        );
    }
    for (name, given, bound) in
        [("near", params.near, &mut bounds.near), ("far", params.far, &mut bounds.far)]
    {
        if let Some(value) = given {
            if !value.is_finite() || value > MAX_FAR {
                let value = format_number(value);
                bail_usage!(
                    "parameter {name}: {value} is not a valid distance; choose at most 1e18"
                );
            }
            *bound = value;
        }
    }
    if let (Some(far), Space::Ndc(frustum)) = (params.far, &mut bounds.space) {
        if far <= frustum.near {
            let [far, near] = [far, frustum.near].map(format_number);
            bail_usage!("parameter far: {far} is nearer than the scene, which begins at {near}");
        }
        frustum.far = frustum.far.min(far);
    }
    if !bounds.is_valid() {
        let [near, far] = [bounds.near, bounds.far].map(format_number);
        if params.near.is_none() {
            bail_usage!("parameter far: {far} is not greater than near = {near}");
        }
        bail_usage!("parameter near: {near} is not less than far = {far}");
    }
    Ok(bounds)
}

/// Pairs cameras with their depth ranges, or with the given range where a view's own is unknown.
fn camera_depths(frames: &[&Frame], given: Option<[f64; 2]>) -> Vec<CameraDepths> {
    frames.iter().map(|f| (f.camera(), f.depth_range.or(given))).collect()
}

/// Returns warnings about implausible poses; fails if all training poses are equal.
pub(crate) fn check_poses(set: &Dataset, split: &Split) -> Result<Vec<String>, Failure> {
    let training: Vec<Camera> = split.train.iter().map(|&i| set.frames[i].camera()).collect();
    let only_test = split.test.iter().filter(|i| !split.train.contains(i));
    let test: Vec<Camera> = only_test.map(|&i| set.frames[i].camera()).collect();
    if pose_warnings::have_equal_poses(&training) {
        bail_bad_input!(
            "dataset: all {} training views have the same pose: depth cannot be estimated; check \
            the poses",
            training.len()
        );
    }
    let mut warnings = pose_warnings::warnings(&training, &test);
    warnings.extend(convention_warning(&training));
    Ok(warnings.into_iter().map(|text| format!("{WARNING}{text}")).collect())
}

/// Describes space and background for the log.
pub(crate) fn space_note(bounds: &Bounds, background: Background) -> String {
    let background = match background {
        Background::White => "white",
        Background::Black => "black",
        Background::Alpha => "alpha",
        Background::Opaque => "opaque",
    };
    let side = format_length(bounds.longest_side(), 3);
    let space = match bounds.space {
        Space::Box => format!(
            "space: box, longest side {side} units, rays from {} to {}",
            format_length(bounds.near, 3),
            format_length(bounds.far, 3)
        ),
        Space::Ndc(f) => format!(
            "space: NDC, for cameras that face one direction, depth from {} to {}",
            format_length(f.near, 3),
            format_length(f.far, 3)
        ),
        Space::Contraction => format!(
            "space: contraction around a ball of diameter {side}, rays up to {}",
            format_length(bounds.far, 0)
        ),
    };
    format!("{space}; background {background}")
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use dataset::{Format, Turn};
    use scene::Intrinsics;

    use super::*;
    use crate::params::SplitKind;
    use crate::split::split_views;

    fn frame(i: usize, count: usize) -> Frame {
        let (sin, cos) = (i as f64 / count as f64 * std::f64::consts::TAU).sin_cos();
        let camera_to_world =
            [[-sin, 0.0, cos, 4.0 * cos], [cos, 0.0, sin, 4.0 * sin], [0.0, 1.0, 0.0, 0.0]];
        Frame {
            name: format!("r_{i}"),
            image: PathBuf::from(format!("r_{i}.png")),
            turn: Turn::Stored,
            mask: None,
            depth_file: None,
            lens_intrinsics: Intrinsics::from_angle_x(80, 60, 0.7),
            pinhole: None,
            camera_to_world,
            depth_range: None,
        }
    }

    /// Returns a dataset of `count` cameras on a ring, which face its centre.
    fn ring(format: Format, count: usize) -> Dataset {
        Dataset {
            format,
            frames: (0..count).map(|i| frame(i, count)).collect(),
            split: None,
            notes: Vec::new(),
        }
    }

    fn planned(
        set: &Dataset,
        params: &Params,
        background: Background,
    ) -> Result<(ImagePlan, Bounds, Vec<usize>), Failure> {
        let split = split_views(set, params)?;
        let images = ImagePlan::new(set, &split, params)?;
        let plan = ScenePlan::new(set, &split, params, images, background)?;
        Ok((plan.images, plan.bounds, plan.references))
    }

    /// A benchmark's images are HR ground truth, photographs are unmodified LR images. The sizes,
    /// the kernel and the number of references depend on this.
    #[test]
    fn images_follow_from_the_format() {
        let params =
            Params { hr_references: 2, split: Some(SplitKind::Holdout), ..Params::default() };
        let (benchmark, _, references) =
            planned(&ring(Format::Blender, 16), &params, Background::White).unwrap();
        assert_eq!(
            (benchmark.has_truth, benchmark.sizes.lr, benchmark.sizes.hr),
            (true, (40, 30), (80, 60))
        );
        assert_eq!(references.len(), 2);
        let (photographs, _, references) =
            planned(&ring(Format::Transforms, 16), &params, Background::White).unwrap();
        assert_eq!(
            (photographs.has_truth, photographs.sizes.lr, photographs.sizes.hr),
            (false, (80, 60), (160, 120))
        );
        assert_eq!((photographs.kernel, references.len()), (pixels::Kernel::Box, 0));
    }

    fn near_and_far(
        set: &Dataset,
        near: Option<f64>,
        far: Option<f64>,
    ) -> Result<(f64, f64), Failure> {
        let params = Params { near, far, ..Params::default() };
        planned(set, &params, Background::White).map(|(_, bounds, _)| (bounds.near, bounds.far))
    }

    /// Impossible near and far values are refused.
    #[test]
    fn given_near_and_far_are_used() {
        let set = ring(Format::Blender, 8);
        assert_eq!(near_and_far(&set, Some(1.5), Some(7.0)).unwrap(), (1.5, 7.0));
        assert_eq!(
            near_and_far(&set, Some(7.0), Some(1.5)).unwrap_err().to_string(),
            "parameter near: 7 is not less than far = 1.5"
        );
        assert_eq!(
            near_and_far(&set, None, Some(f64::INFINITY)).unwrap_err().to_string(),
            "parameter far: inf is not a valid distance; choose at most 1e18"
        );
    }

    /// Lengths are printed with significant digits, however large the scene's unit is.
    #[test]
    fn spaces_are_printed_with_significant_digits() {
        let (near, far) = (2e-5, 9e-5);
        for (space, note) in [
            (
                Space::Box,
                "space: box, longest side 6.00e-5 units, rays from 2.00e-5 to 9.00e-5; \
                background black",
            ),
            (
                Space::Contraction,
                "space: contraction around a ball of diameter 6.00e-5, rays up to 9.00e-5; \
                background black",
            ),
        ] {
            let bounds = Bounds { min: [-3e-5; 3], max: [3e-5; 3], near, far, space };
            assert_eq!(space_note(&bounds, Background::Black), note);
        }
    }

    /// A bounding box that f64 rounds to a point is refused. The message names no parameter, since
    /// none was given.
    #[test]
    fn boxes_without_volume_are_refused() {
        let mut set = ring(Format::Blender, 8);
        for frame in &mut set.frames {
            (frame.lens_intrinsics.fx, frame.lens_intrinsics.fy) = (1e300, 1e300);
        }
        let failure = planned(&set, &Params::default(), Background::White).unwrap_err();
        assert!(matches!(failure, Failure::BadInput(_)));
        assert_eq!(
            failure.to_string(),
            "dataset: the scene's bounding box has no volume; check the poses and their unit"
        );
    }

    fn error_message(format: Format, params: &Params) -> String {
        planned(&ring(format, 8), params, Background::White).unwrap_err().to_string()
    }

    /// The pipeline of `init` has `lr_width`, which `-p lr_source=photographs` overrides.
    #[test]
    fn photographs_override_the_lr_width() {
        let params = |lr_width| Params {
            lr_source: Some(crate::params::LrSource::Photographs),
            lr_width,
            ..Params::default()
        };
        let sizes = |lr_width| {
            let set = ring(Format::Transforms, 8);
            planned(&set, &params(lr_width), Background::White).unwrap().0.sizes
        };
        assert_eq!(sizes(Some(40)), sizes(None));
    }

    /// A message about an impossible value names the parameter.
    #[test]
    fn impossible_values_are_refused() {
        let params =
            Params { kernel: Some(pixels::Kernel::Average), scale: 2.7, ..Params::default() };
        let message = error_message(Format::Blender, &params);
        assert!(
            message.starts_with("parameter kernel: average requires an integer scale"),
            "{message}"
        );
    }
}
