use artifact::{Failure, FailureExt as _, GivenInput, bail_bad_input};
use refinement::{KnownView, LrObservations, Rendered};
use scene::Views;
use stage::Context;

/// Interval of the views that are left out of training (design note 015).
const HOLD_OUT_EVERY: usize = 8;

/// Leaves some examples out of training. Returns first the examples to train on, then those left
/// out, to score the network on: the fifth of each eight, or the last of fewer than five. A single
/// example is used for both.
pub(crate) fn leave_out<T: Clone>(all: Vec<T>) -> (Vec<T>, Vec<T>) {
    if all.len() == 1 {
        return (all.clone(), all);
    }
    let middle = (HOLD_OUT_EVERY / 2).min(all.len() - 1);
    let (mut training, mut left_out) = (Vec::new(), Vec::new());
    for (i, example) in all.into_iter().enumerate() {
        let is_left_out = i % HOLD_OUT_EVERY == middle;
        if is_left_out { &mut left_out } else { &mut training }.push(example);
    }
    (training, left_out)
}

/// Reads rendered views and their truth, and makes the views consistent with LR `photographs` if
/// given. Views without an image, or without one in their truth, are skipped.
pub(crate) fn read_examples(
    views: &GivenInput,
    truth: &GivenInput,
    photographs: Option<&LrObservations<'_>>,
) -> Result<Vec<KnownView>, Failure> {
    let true_views = Views::read(truth)?;
    let background = true_views.background.grey_level();
    let mut all = Vec::new();
    for view in &Views::read(views)?.views {
        let Some(true_view) = true_views.taken_by(&view.camera) else { continue };
        let photograph = true_view.read_photograph(truth);
        let photograph = photograph.bad_input(format!("view {}", view.camera.name))?;
        let Some(photograph) = photograph else { continue };
        let Some((mut rendered, _)) = Rendered::read(views, view, background, true)? else {
            continue;
        };
        if let Some(photographs) = photographs {
            rendered = photographs.make_consistent(rendered)?;
        }
        let known = KnownView::new(rendered, photograph.over(background));
        all.push(known.bad_input("input views")?);
    }
    if all.is_empty() {
        bail_bad_input!(
            "input views: no view has an image in input truth with the same name and pose"
        );
    }
    Ok(all)
}

/// Reads the LR photographs of the downscaled field's views, if the views to be refined will have
/// LR photographs, too: training and application must have the same task.
pub(crate) fn lr_photographs(context: &Context) -> Result<Option<LrObservations<'_>>, Failure> {
    let Some((photographs, cameras)) =
        context.optional_input("photographs").zip(context.optional_input("cameras"))
    else {
        return Ok(None);
    };
    let photographs = LrObservations::read(photographs)?;
    if !photographs.covers(&Views::read(cameras)?) {
        return Ok(None);
    }
    context.log_line(
        "all views to be refined have LR photographs: training views are made consistent with \
        their own LR photographs, too",
    );
    Ok(Some(photographs))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use pixels::{Image, write_png};
    use scene::{
        Background, Bounds, Camera, Intrinsics, VIEW_CHANNELS, VIEWS_FILE, View, write_view_image,
    };

    use super::*;

    /// Side of all images in pixels.
    const SIDE: usize = 4;

    /// Returns a view at x = `right`. The view's image, if any, has the view's name.
    fn view(name: &str, right: f64, extension: Option<&str>) -> View {
        let camera = Camera {
            name: name.to_owned(),
            intrinsics: Intrinsics::from_angle_x(SIDE as u32, SIDE as u32, 1.0),
            camera_to_world: [[1.0, 0.0, 0.0, right], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        };
        let image = extension.map(|extension| format!("{name}.{extension}"));
        View { image, ..View::camera_only(camera) }
    }

    /// Writes and opens an input: rendered views are half transparent, photographs are grey.
    fn write_input(dir: &Path, name: &str, views: Vec<View>) -> GivenInput {
        let folder = dir.join(name);
        std::fs::create_dir(&folder).unwrap();
        for file in views.iter().filter_map(|view| view.image.as_ref()) {
            let path = folder.join(file);
            if file.ends_with("exr") {
                write_rendered(&path);
            } else {
                let grey = Image::new(SIDE, SIDE, 3, vec![0.2; 3 * SIDE * SIDE]);
                write_png(&path, &grey.to_rgba8()).unwrap();
            }
        }
        let bounds = Bounds::cube(1.0, 0.1, 9.0);
        let list = Views::new(Background::White, bounds, views);
        artifact::write_json(&folder.join(VIEWS_FILE), &list).unwrap();
        GivenInput::open(name, &folder).unwrap()
    }

    fn write_rendered(path: &Path) {
        let pixel = [0.25, 0.25, 0.25, 0.5, 2.0];
        let written = write_view_image(path, (SIDE, SIDE), &VIEW_CHANNELS, |_, _, samples| {
            samples.as_chunks_mut().0.fill(pixel);
            Ok::<(), Box<dyn std::error::Error>>(())
        });
        written.unwrap();
    }

    #[test]
    fn views_are_read_with_their_truth() {
        let dir = tempfile::tempdir().unwrap();
        let exr = Some("exr");
        let views = vec![
            view("whole", 0.0, exr),
            view("unrendered", 0.0, None),
            view("elsewhere", 0.0, exr),
            view("unseen", 0.0, exr),
            view("unknown", 0.0, exr),
        ];
        let truth = vec![
            view("unseen", 0.0, None),
            view("elsewhere", 1.0, Some("png")),
            view("unrendered", 0.0, Some("png")),
            view("whole", 0.0, Some("png")),
        ];
        let [views, truth] = [("views", views), ("truth", truth)]
            .map(|(name, views)| write_input(dir.path(), name, views));
        let examples = read_examples(&views, &truth, None).unwrap();
        assert_eq!(examples.len(), 1);
        let KnownView { rendered, truth } = &examples[0];
        assert_eq!(rendered.camera.name, "whole");
        // Composited over white.
        assert_eq!(rendered.colours().data, [0.75; 3 * SIDE * SIDE]);
        assert_eq!(rendered.depth, [2.0; SIDE * SIDE]);
        assert_eq!(truth.data, [0.2; 3 * SIDE * SIDE]);
    }

    #[test]
    fn views_without_truth_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let [views, truth] = [("views", "one"), ("truth", "other")].map(|(input_name, name)| {
            write_input(dir.path(), input_name, vec![view(name, 0.0, None)])
        });
        let Err(Failure::BadInput(message)) = read_examples(&views, &truth, None) else {
            panic!("views without ground truth are accepted");
        };
        assert!(message.starts_with("input views: no view has an image"), "{message}");
    }

    #[test]
    fn every_eighth_is_left_out_and_none_is_lost() {
        for count in 2..40usize {
            let (training, left_out) = leave_out((0..count).collect());
            let mut all = [training.clone(), left_out.clone()].concat();
            all.sort_unstable();
            assert_eq!(all, (0..count).collect::<Vec<_>>(), "{count}");
            assert!(!training.is_empty() && !left_out.is_empty(), "{count}");
            assert!(left_out.len() <= count.div_ceil(HOLD_OUT_EVERY), "{count}: {left_out:?}");
        }
        let (_, left_out) = leave_out((0..16).collect::<Vec<_>>());
        assert_eq!(left_out, [4, 12]);
    }

    #[test]
    fn a_single_example_is_trained_on_and_left_out() {
        assert_eq!(leave_out(vec![7]), (vec![7], vec![7]));
    }
}
