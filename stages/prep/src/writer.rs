use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use anyhow::Context as _;
use artifact::{FailureExt as _, WARNING, bail_bad_input, format_count, printable};
use dataset::{Clipping, Frame};
use pixels::{
    COLOUR_CHANNELS, Channel, DEGRADATION_FILE, DEPTH_CHANNELS, Degradation, DepthMap, Kernel,
    Mask, Rgba8, SampleType, read_exr, write_exr, write_png,
};
use rayon::prelude::*;
use scene::{VIEWS_FILE, View, Views, mask_file};
use stage::{Context, Progress};

use crate::degrade::{self, LrImage, degrade};
use crate::frame_label;
use crate::scene_plan::ScenePlan;

/// Writer of a scene's subtrees. At most one image per thread is in memory.
pub(crate) struct SceneWriter<'a> {
    context: &'a Context,
    plan: &'a ScenePlan<'a>,
    progress: Progress,
    /// Frame names and clipped pixels of EXR photographs, by file.
    clipping: Mutex<BTreeMap<PathBuf, (String, Clipping)>>,
    /// Names of the frames without a pixel that counts.
    fully_masked: Mutex<BTreeSet<String>>,
}

impl<'a> SceneWriter<'a> {
    pub(crate) fn new(context: &'a Context, plan: &'a ScenePlan<'a>) -> Self {
        let progress = context.progress("preparing", (plan.train.len() + plan.test.len()) as u64);
        let (clipping, fully_masked) = Default::default();
        Self { context, plan, progress, clipping, fully_masked }
    }

    /// Writes all subtrees.
    pub(crate) fn write(&self) -> anyhow::Result<()> {
        let ScenePlan { train, test, references, .. } = self.plan;
        self.write_images(train, |i, frame| {
            self.write_training_image(frame, references.contains(&i))
        })?;
        self.write_views_of_training_frames()?;
        self.write_images(test, |_, frame| self.write_test_image(frame))?;
        self.write_views_of_test_frames()
    }

    /// Returns warnings about pixels brighter than 1 and about frames that are masked entirely.
    pub(crate) fn warnings(&self) -> Vec<String> {
        [self.clipping_warning(), self.mask_warning()].into_iter().flatten().collect()
    }

    fn mask_warning(&self) -> Option<String> {
        let names = self.fully_masked.lock().unwrap_or_else(PoisonError::into_inner);
        let first = names.first()?;
        Some(format!(
            "{WARNING}masks exclude every pixel of {} (first: frame {first}); check the masks, or \
            remove the photographs",
            format_count(names.len(), "view")
        ))
    }

    fn clipping_warning(&self) -> Option<String> {
        let all = self.clipping.lock().unwrap_or_else(PoisonError::into_inner);
        let mut with_clipped = all.values().filter(|(_, clipping)| clipping.clipped > 0);
        let (first, _) = with_clipped.next()?;
        let count = 1 + with_clipped.count();
        let mut sum = Clipping::default();
        for (_, clipping) in all.values() {
            sum.add(*clipping);
        }
        Some(format!(
            "{WARNING}{} of {} pixels ({:.2} %) are brighter than 1 and clipped to 1, in {count} \
            of {} (first: frame {first}); to keep them, scale the files to at most 1",
            sum.clipped,
            sum.pixels,
            100.0 * sum.clipped as f64 / sum.pixels as f64,
            format_count(all.len(), "EXR photograph"),
        ))
    }

    fn write_views(&self, subtree: &str, views: impl Iterator<Item = View>) -> anyhow::Result<()> {
        let views = Views::new(self.plan.background, self.plan.bounds, views.collect());
        self.context.write_json(&format!("{subtree}/{VIEWS_FILE}"), &views)
    }

    fn write_degradation(
        &self,
        subtree: &str,
        kernel: Kernel,
        hr: (u32, u32),
    ) -> anyhow::Result<()> {
        self.context.write_json(
            &format!("{subtree}/{DEGRADATION_FILE}"),
            &Degradation { kernel, hr: hr.into() },
        )
    }

    /// Writes the lists of views of the training frames:
    /// * `train`: LR images;
    /// * `downscaled`: LR images shrunk once more, whose ground truth is `train`;
    /// * `train-cameras`: training cameras at HR size, without images;
    /// * `references`, if there are any: training views at HR size.
    fn write_views_of_training_frames(&self) -> anyhow::Result<()> {
        let ScenePlan { train, references, images, .. } = self.plan;
        let lr_views = || train.iter().map(|frame| self.training_view(frame));
        self.write_views("downscaled", lr_views().map(|view| self.downscaled_view(view)))?;
        self.write_views("train", lr_views())?;
        self.write_degradation("train", images.kernel, images.sizes.hr)?;
        // `shrunk` downscales unrounded LR images by the box filter, which suits any scale.
        let kernel = if images.kernel == Kernel::Average { Kernel::Box } else { images.kernel };
        self.write_degradation("downscaled", kernel, images.sizes.lr)?;
        self.write_views("train-cameras", train.iter().map(|frame| self.hr_view(frame)))?;
        if references.is_empty() {
            return Ok(());
        }
        let references = references.iter().map(|&i| train[i]);
        self.write_views(
            "references",
            references.map(|frame| View {
                image: Some(format!("images/{}.png", frame.name)),
                mask: mask_path(frame),
                ..self.hr_view(frame)
            }),
        )
    }

    fn training_view(&self, frame: &Frame) -> View {
        View {
            image: Some(format!("images/{}.{}", frame.name, self.extension())),
            mask: mask_path(frame),
            ..View::camera_only(self.plan.images.lr_camera(&frame.camera()))
        }
    }

    fn downscaled_view(&self, view: View) -> View {
        let k = &view.camera.intrinsics;
        let (width, height) = self.plan.images.downscaled_size((k.width, k.height));
        View { camera: view.camera.resized(width, height), ..view }
    }

    /// Returns the view of a frame's camera at HR size, without files.
    fn hr_view(&self, frame: &Frame) -> View {
        View::camera_only(self.plan.images.hr_camera(&frame.camera()))
    }

    /// Writes the lists of views of the test frames:
    /// * `truth`: test views at HR size, with their LR photographs;
    /// * `cameras`: test cameras at HR size, without images.
    fn write_views_of_test_frames(&self) -> anyhow::Result<()> {
        let ScenePlan { test, images, .. } = self.plan;
        self.write_views("cameras", test.iter().map(|frame| self.hr_view(frame)))?;
        self.write_degradation("truth", images.kernel, images.sizes.hr)?;
        self.write_views("truth", test.iter().map(|frame| self.test_view(frame)))
    }

    fn test_view(&self, frame: &Frame) -> View {
        let (name, has_truth) = (&frame.name, self.plan.images.has_truth);
        let has_depth = has_truth && frame.depth_file.is_some();
        View {
            image: has_truth.then(|| format!("images/{name}.png")),
            mask: mask_path(frame),
            depth: has_depth.then(|| format!("depth/{name}.exr")),
            low_resolution: Some(format!("low/{name}.{}", self.extension())),
            ..self.hr_view(frame)
        }
    }

    /// Returns the extension of LR files.
    fn extension(&self) -> &'static str {
        degrade::extension(self.plan.images.kernel)
    }

    /// Writes the images of frames, several at a time.
    fn write_images(
        &self,
        frames: &[&Frame],
        write: impl Fn(usize, &Frame) -> anyhow::Result<()> + Sync,
    ) -> anyhow::Result<()> {
        frames.par_iter().enumerate().try_for_each(|(i, frame)| {
            self.context.check_interrupt()?;
            write(i, frame)?;
            self.progress.add(1);
            Ok(())
        })
    }

    /// Writes the images of a training frame: LR image, downscaled LR image, HR reference, and
    /// their masks.
    fn write_training_image(&self, frame: &Frame, is_reference: bool) -> anyhow::Result<()> {
        let (hr, lr) = self.create_images(frame)?;
        let name = &frame.name;
        self.write_lr("train/images", name, &lr)?;
        let mask = self.read_mask(frame)?;
        let lr_mask = mask.as_ref().map(|mask| self.lr_mask(mask, &lr));
        if let Some(mask) = &lr_mask {
            self.write_mask("train", name, mask)?;
        }
        if let Some(hr) = hr.filter(|_| is_reference) {
            self.write_hr("references", name, &hr)?;
            if let Some(mask) = &mask {
                self.write_mask("references", name, &mask.resized((hr.width, hr.height), 0))?;
            }
        }
        let lr_size = self.plan.images.sizes_of(&frame.intrinsics()).lr;
        let (width, height) = self.plan.images.downscaled_size(lr_size);
        let downscaled = lr.shrunk((width as usize, height as usize), self.plan.images.kernel);
        self.write_lr("downscaled/images", name, &downscaled)?;
        if let Some(mask) = lr_mask {
            self.write_mask("downscaled", name, &self.lr_mask(&mask, &downscaled))?;
        }
        Ok(())
    }

    /// Writes the images of a test frame: HR image, LR image, mask and depth.
    fn write_test_image(&self, frame: &Frame) -> anyhow::Result<()> {
        let (hr, lr) = self.create_images(frame)?;
        if let Some(hr) = &hr {
            self.write_hr("truth", &frame.name, hr)?;
        }
        self.write_lr("truth/low", &frame.name, &lr)?;
        if let Some(mask) = self.read_mask(frame)? {
            let mask = match &hr {
                Some(hr) => mask.resized((hr.width, hr.height), 0),
                None => self.lr_mask(&mask, &lr),
            };
            self.write_mask("truth", &frame.name, &mask)?;
        }
        if let (Some(depth), Some(hr)) = (&frame.depth_file, hr) {
            self.write_depth(frame, depth, (hr.width, hr.height))?;
        }
        Ok(())
    }

    /// Creates a frame's HR image, if the plan has HR truth, and its LR image.
    fn create_images(&self, frame: &Frame) -> anyhow::Result<(Option<Rgba8>, LrImage)> {
        let (image, clipping) = frame.photograph_and_clipping().bad_input(frame_label(frame))?;
        if clipping.pixels > 0 {
            let mut all = self.clipping.lock().unwrap_or_else(PoisonError::into_inner);
            all.insert(frame.image.clone(), (frame.name.clone(), clipping));
        }
        if !self.plan.images.has_truth {
            return Ok((None, LrImage::Bytes(image)));
        }
        let (hr, lr) = degrade(
            &image,
            &self.plan.images.sizes_of(&frame.intrinsics()),
            self.plan.images.kernel,
        );
        Ok((Some(hr), lr))
    }

    /// Reads a frame's mask, and records the frame if its mask excludes every pixel.
    fn read_mask(&self, frame: &Frame) -> anyhow::Result<Option<Mask>> {
        let mask = frame.mask().bad_input(frame_label(frame))?;
        if mask.as_ref().is_some_and(|mask| !mask.counts.contains(&true)) {
            let mut names = self.fully_masked.lock().unwrap_or_else(PoisonError::into_inner);
            names.insert(frame.name.clone());
        }
        Ok(mask)
    }

    fn write_hr(&self, subtree: &str, name: &str, image: &Rgba8) -> anyhow::Result<()> {
        let path = self.context.output_path(&format!("{subtree}/images/{name}.png"))?;
        Ok(write_png(&path, image)?)
    }

    fn write_mask(&self, subtree: &str, name: &str, mask: &Mask) -> anyhow::Result<()> {
        let path = self.context.output_path(&format!("{subtree}/{}", mask_file(name)))?;
        Ok(write_png(&path, &mask.to_rgba8())?)
    }

    /// Shrinks a mask to an LR image: all old pixels under an LR pixel, and under its neighbours
    /// within the kernel's reach, must count. A mask of the same size is kept.
    fn lr_mask(&self, mask: &Mask, image: &LrImage) -> Mask {
        let is_same_size = image.size() == (mask.width, mask.height);
        let kernel = self.plan.images.kernel;
        let margin = if is_same_size { 0 } else { degrade::mask_reach(kernel) };
        mask.resized(image.size(), margin)
    }

    fn write_lr(&self, folder: &str, name: &str, image: &LrImage) -> anyhow::Result<()> {
        let path = self.context.output_path(&format!("{folder}/{name}.{}", self.extension()))?;
        match image {
            LrImage::Bytes(image) => write_png(&path, image)?,
            LrImage::Floats(image) => {
                let channels =
                    COLOUR_CHANNELS.map(|name| Channel { name, sample_type: SampleType::Float });
                write_exr(
                    &path,
                    (image.width, image.height),
                    &channels,
                    "display-encoded sRGB, premultiplied",
                    |first, rows, samples| {
                        samples.copy_from_slice(
                            &image.data[first * image.width * 4..(first + rows) * image.width * 4],
                        );
                        Ok::<(), pixels::PixelError>(())
                    },
                )?;
            }
        }
        Ok(())
    }

    /// Writes true depth at HR size, sampled at the depth file's nearest pixel centre: averaging
    /// depths across an edge would invent surfaces. Fails if the depth file's aspect ratio isn't
    /// the photograph's.
    fn write_depth(
        &self,
        frame: &Frame,
        source: &Path,
        (width, height): (usize, usize),
    ) -> anyhow::Result<()> {
        let native = read_exr(source)
            .and_then(|image| image.with_finite(&DEPTH_CHANNELS, source))
            .bad_input(frame_label(frame))?;
        let source = source.display().to_string();
        let map = DepthMap::of(&native)
            .with_context(|| format!("{}: depth requires channels Z and A", printable(&source)))
            .bad_input(frame_label(frame))?;
        let native_size @ [columns, rows] = [native.width, native.height];
        if !frame.has_aspect_of(columns as u32, rows as u32) {
            let k = frame.intrinsics();
            bail_bad_input!(
                "{}: {}: depth has {columns}×{rows} pixels, its photograph {}×{}; aspect ratios \
                must match",
                frame_label(frame),
                printable(&source),
                k.width,
                k.height
            );
        }
        let path = self.context.output_path(&format!("truth/depth/{}.exr", frame.name))?;
        let channels = [
            Channel { name: "A", sample_type: SampleType::Half },
            Channel { name: "Z", sample_type: SampleType::Float },
        ];
        write_exr(
            &path,
            (width, height),
            &channels,
            "Z: z-depth of the nearest native pixel centre; A: 0 where nothing is seen",
            |first, _, samples| {
                for (i, sample) in samples.chunks_exact_mut(2).enumerate() {
                    let (column, row) = (i % width, first + i / width);
                    let [x, y] = depth_pixel(frame, [column, row], [width, height], native_size);
                    let pixel = y * native.width + x;
                    sample.copy_from_slice(&[map.opacity[pixel], map.depth[pixel]]);
                }
                Ok(())
            },
        )
    }
}

/// Returns the pixel of a depth file that the centre of a pixel of the HR image is in.
fn depth_pixel(
    frame: &Frame,
    pixel: [usize; 2],
    size: [usize; 2],
    native: [usize; 2],
) -> [usize; 2] {
    if frame.pinhole.is_none() {
        return [0, 1].map(|i| nearest_index(pixel[i], native[i], size[i]));
    }
    let k = frame.intrinsics();
    let camera_size = [k.width, k.height].map(f64::from);
    let position = [0, 1].map(|i| (pixel[i] as f64 + 0.5) * camera_size[i] / size[i] as f64);
    let source = frame.position_in_lens_image(position);
    [0, 1].map(|i| {
        let index = (source[i] * native[i] as f64 / camera_size[i]).max(0.0) as usize;
        index.min(native[i] - 1)
    })
}

/// Returns the index among `native` pixels whose centre is nearest to that of pixel `i` of `count`.
fn nearest_index(i: usize, native: usize, count: usize) -> usize {
    (2 * i + 1) * native / (2 * count)
}

/// Returns the path of a frame's mask in its subtree; `None` without a mask.
fn mask_path(frame: &Frame) -> Option<String> {
    frame.is_masked().then(|| mask_file(&frame.name))
}

#[cfg(test)]
mod tests {
    use dataset::Turn;
    use scene::{Distortion, Intrinsics};

    use super::*;

    /// Depth is looked up where the lens sees the pixel of the undistorted photograph.
    #[test]
    fn depth_follows_the_removed_distortion() {
        let distortion = Distortion::brown([-0.3, 0.0, 0.0], [0.0; 2]);
        let lens = Intrinsics { distortion, ..Intrinsics::from_angle_x(80, 60, 1.0) };
        let pinhole = lens.pinhole().unwrap();
        let mut frame = Frame {
            name: "a".to_owned(),
            image: PathBuf::from("a.png"),
            turn: Turn::Stored,
            mask: None,
            depth_file: None,
            lens_intrinsics: lens,
            pinhole: None,
            camera_to_world: [[0.0; 4]; 3],
            depth_range: None,
        };
        // The HR image has half the size of the depth file, the depth file that of the photograph.
        let found = |frame: &Frame, pixel| depth_pixel(frame, pixel, [40, 30], [80, 60]);
        assert_eq!(found(&frame, [3, 20]), [7, 41]);
        frame.pinhole = Some(pinhole);
        for pixel in [[0, 0], [3, 20], [39, 29], [20, 15]] {
            let [x, y] = [
                (2.0 * pixel[0] as f64 + 1.0 - 40.0) / pinhole.fx,
                (2.0 * pixel[1] as f64 + 1.0 - 30.0) / pinhole.fy,
            ];
            let factor = 1.0 - 0.3 * (x * x + y * y);
            let expected =
                [(factor * x * lens.fx + 40.0) as usize, (factor * y * lens.fy + 30.0) as usize];
            assert_eq!(found(&frame, pixel), expected, "{pixel:?}");
        }
        assert_ne!(found(&frame, [3, 20]), [7, 41]);
    }
}
