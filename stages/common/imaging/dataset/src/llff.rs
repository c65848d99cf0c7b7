use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};
use artifact::{format_count, format_number, one_line};
use glam::{DMat3, DVec3};
use scene::{Distortion, Intrinsics, pose_of};

use crate::colmap;
use crate::dataset::Dataset;
use crate::error::frame_label;
use crate::file_status::{check_file, check_link, is_file, path_text, visible_entries};
use crate::format::Format;
use crate::frame::{Frame, unique_names};
use crate::lookup::Lookup;
use crate::masks::without_dynamic_masks;
use crate::npy::read_matrix;
use crate::photograph::{ImageHeader, fit_camera, is_image_name, read_header};
use crate::text::read_text;
use crate::transforms::side_length;
use crate::unsupported::unsupported_summary;

/// Numbers per photograph: a 3×5 matrix (axes down, right and back; centre; height, width and focal
/// length), near and far.
const NUMBERS: usize = 17;

/// Reads `poses_bounds.npy` (Mildenhall et al. 2019) and the images next to it, sorted by name.
pub(crate) fn read(folder: &Path) -> anyhow::Result<Dataset> {
    let path = folder.join("poses_bounds.npy");
    let rows = read_numbers(&path)?;
    check_link(&folder.join("images"))?;
    let Photographs { images, labels, mut notes } = find_photographs(folder, &path, rows.len())?;
    let names = unique_names(&path, &labels)?;
    let (distortion, note) = colmap_distortion(folder, &rows);
    let mut frames = Vec::with_capacity(rows.len());
    for (index, image) in images.into_iter().enumerate() {
        let name = &names[index];
        let frame = read_frame(&rows[index], distortion, name, image)
            .with_context(|| frame_label(&path, index, name))?;
        frames.push(frame);
    }
    notes.extend(note);
    Ok(Dataset { format: Format::Llff, frames, split: None, notes })
}

/// Returns the photographs' lens distortion, with a note if the distortion is unknown.
/// `poses_bounds.npy` stores no distortion, but COLMAP estimated its poses. The photographs have
/// the lens of COLMAP's model next to the poses if the model has exactly one camera, with the focal
/// length of the poses (docs/design/005). Otherwise no distortion is assumed.
fn colmap_distortion(folder: &Path, rows: &[[f64; NUMBERS]]) -> (Distortion, Option<String>) {
    let without = |reason: String| {
        (Distortion::default(), Some(format!("lens distortion is unknown and ignored: {reason}")))
    };
    let camera = match colmap::read_cameras(folder) {
        Ok(cameras) if cameras.iter().all(|camera| camera.distortion.is_none()) => {
            return (Distortion::default(), None);
        }
        Ok(cameras) if cameras.len() > 1 => {
            return without(format!("the model in sparse has {} cameras", cameras.len()));
        }
        Ok(cameras) => cameras[0],
        Err(e) => return without(one_line(&e)),
    };
    if rows.iter().all(|row| has_focal_length_of(&camera, row)) {
        (camera.distortion, None)
    } else {
        without(format!(
            "the model in sparse has a different focal length ({} at a width of {} pixels); to use \
            that model, remove poses_bounds.npy",
            camera.fx, camera.width
        ))
    }
}

/// True if a photograph's focal length, relative to its width, equals the camera's to a thousandth;
/// the tolerance is chosen by hand.
fn has_focal_length_of(camera: &Intrinsics, row: &[f64; NUMBERS]) -> bool {
    let (width, focal) = (row[9], row[14]);
    (camera.fx * width / (f64::from(camera.width) * focal) - 1.0).abs() < 1e-3
}

fn read_frame(
    row: &[f64; NUMBERS],
    distortion: Distortion,
    name: &str,
    image: PathBuf,
) -> anyhow::Result<Frame> {
    let stored: ImageHeader = read_header(&image)?;
    let [down, right, back, centre, size_and_focal] =
        [0, 1, 2, 3, 4].map(|c| DVec3::new(row[c], row[5 + c], row[10 + c]));
    let [height, width, focal] = size_and_focal.to_array();
    let (width, height) = (side_length(width, "width")?, side_length(height, "height")?);
    let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
    let intrinsics = Intrinsics { width, height, fx: focal, fy: focal, cx, cy, distortion };
    let fitted = fit_camera(intrinsics, stored)?;
    let (near, far) = (row[15], row[16]);
    ensure!(
        near.is_finite() && far.is_finite() && 0.0 < near && near < far,
        "bounds {} and {}, expected 0 < near < far; LLFF's imgs2poses confuses views if COLMAP \
        registered them in another order than that of their names: rerun COLMAP on images sorted \
        by name, or use COLMAP's model without poses_bounds.npy",
        format_number(near),
        format_number(far)
    );
    let camera_to_world = pose_of(DMat3::from_cols(right, -down, back), centre);
    let mut frame = Frame::new(image, fitted, camera_to_world);
    frame.name = name.to_owned();
    frame.depth_range = Some([near, far]);
    frame.check()?;
    Ok(frame)
}

/// Photographs in the order of the poses.
struct Photographs {
    images: Vec<PathBuf>,
    /// Paths inside the data set's folder that name the views.
    labels: Vec<PathBuf>,
    notes: Vec<String>,
}

impl Photographs {
    fn new(images: Vec<PathBuf>, labels: Vec<PathBuf>, from: &str) -> Self {
        let count = format_count(images.len(), "photograph");
        let notes = vec![format!("LLFF (poses_bounds.npy): {count} from {from}")];
        Self { images, labels, notes }
    }
}

/// Finds the folder with one image per pose: `images`, or the first of `images_2`, `images_3` and
/// so on, up to 64, chosen by hand. Without such a folder, a list may name the images that have
/// poses.
fn find_photographs(folder: &Path, path: &Path, poses: usize) -> anyhow::Result<Photographs> {
    let mut names = vec!["images".to_owned()];
    names.extend((2..=64).map(|n| format!("images_{n}")));
    names.retain(|name| folder.join(name).is_dir());
    let mut found = Vec::new();
    for name in names {
        let (files, remark) = list_images(&folder.join(&name));
        if files.len() == poses {
            let relative = files.iter().filter_map(|p| p.strip_prefix(folder).ok());
            let labels = relative.map(Path::to_path_buf).collect();
            return Ok(Photographs::new(files, labels, &name));
        }
        found.push(format!("{} in {name}/{remark}", format_count(files.len(), "image")));
    }
    find_listed_photographs(folder, path, poses)?.with_context(|| {
        let path = path_text(path);
        if found.is_empty() {
            return format!(
                "{path}: {poses} poses and no folder images/ next to this file; put the \
                photographs there"
            );
        }
        format!(
            "{path}: {poses} poses for {}; counts must match, or view_imgs.txt must list the \
            images that have poses",
            found.join(" and ")
        )
    })
}

/// Lists a folder's images by name. Also returns a remark, for an error message, on images that
/// can't be read or aren't supported. Hidden files and instant-ngp's masks are not images.
fn list_images(folder: &Path) -> (Vec<PathBuf>, String) {
    let entries = visible_entries(folder);
    let unsupported = unsupported_summary(&entries);
    let images = entries.into_iter().filter(|path| is_image_name(path)).collect();
    let (mut files, mut problem) = (Vec::new(), None);
    for path in without_dynamic_masks(images) {
        match check_file(&path, "an image") {
            Ok(()) => files.push(path),
            Err(found) => problem = problem.or(Some(found.to_string())),
        }
    }
    let remark = problem.or(unsupported).map(|remark| format!(" ({remark})"));
    (files, remark.unwrap_or_default())
}

/// Finds the images listed by `view_imgs.txt` (imgs2poses) or by COLMAP's model next to the poses,
/// if one of the lists has one name per pose. Poses are in the order of names.
fn find_listed_photographs(
    folder: &Path,
    path: &Path,
    poses: usize,
) -> anyhow::Result<Option<Photographs>> {
    let list = folder.join("view_imgs.txt");
    let mut lists = Vec::new();
    if is_file(&list)? {
        let text = read_text(&list)?;
        let names = text.lines().map(|line| line.trim().to_owned());
        lists.push(("view_imgs.txt", names.filter(|name| !name.is_empty()).collect()));
    }
    // A model that can't be read counts as an empty list.
    lists.push(("COLMAP's model in sparse", colmap::image_names(folder).unwrap_or_default()));
    let Some((source, mut names)) = lists.into_iter().find(|(_, names)| names.len() == poses)
    else {
        return Ok(None);
    };
    names.sort();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut lookup = Lookup::in_images(folder, &names);
    let (mut images, mut labels) = (Vec::new(), Vec::new());
    for (index, name) in names.iter().enumerate() {
        let file = lookup.find(name).with_context(|| frame_label(path, index, name))?;
        images.push(folder.join(&file.path));
        labels.push(file.label);
    }
    let from = lookup.base().strip_prefix(folder).map(path_text).unwrap_or_default();
    let mut found = Photographs::new(images, labels, &from);
    found.notes.push(format!("photographs with poses are listed by {source}"));
    found.notes.extend(lookup.notes());
    Ok(Some(found))
}

/// Reads the array's rows.
fn read_numbers(path: &Path) -> anyhow::Result<Vec<[f64; NUMBERS]>> {
    let bytes = std::fs::read(path).with_context(|| path_text(path))?;
    let array_error = || format!("{}: not a NumPy array of N×{NUMBERS} numbers", path_text(path));
    let matrix = read_matrix(&bytes).with_context(array_error)?;
    ensure!(
        matrix.columns == NUMBERS && !matrix.numbers.is_empty(),
        "{}: unsupported shape [{}, {}]",
        array_error(),
        matrix.rows,
        matrix.columns
    );
    Ok(matrix.numbers.as_chunks().0.to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photograph::tests::write_png;

    /// Row of a camera at (1, 2, 3) with axes right = x, up = y, back = z.
    const ROW: [f64; NUMBERS] =
        [0., 1., 0., 1., 60., -1., 0., 0., 2., 80., 0., 0., 1., 3., 70., 1.5, 9.];

    fn npy(rows: &[[f64; NUMBERS]]) -> Vec<u8> {
        let header = format!(
            "{{'descr': '<f8', 'fortran_order': False, 'shape': ({}, {NUMBERS}), }}",
            rows.len()
        );
        let padded = format!("{header:<117}\n");
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((padded.len() as u16).to_le_bytes());
        bytes.extend(padded.as_bytes());
        bytes.extend(rows.iter().flatten().flat_map(|v| v.to_le_bytes()));
        bytes
    }

    fn folder(bytes: &[u8], images: &[(&str, u32)]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("poses_bounds.npy"), bytes).unwrap();
        for (folder, count) in images {
            std::fs::create_dir(dir.path().join(folder)).unwrap();
            for i in 0..*count {
                write_png(&dir.path().join(folder).join(format!("IMG_{i}.png")), 40, 30);
            }
        }
        dir
    }

    #[test]
    fn axes_and_sizes_are_converted() {
        let dir = folder(&npy(&[ROW, ROW]), &[("images", 3), ("images_4", 2)]);
        let set = Dataset::read(dir.path()).unwrap();
        assert_eq!((set.format, set.frames.len()), (Format::Llff, 2));
        assert!(set.notes[0].contains("images_4"), "{:?}", set.notes);
        let frame = &set.frames[1];
        assert_eq!(frame.name, "IMG_1");
        assert_eq!(frame.camera_to_world, [[1., 0., 0., 1.], [0., 1., 0., 2.], [0., 0., 1., 3.]]);
        assert_eq!(
            frame.lens_intrinsics,
            Intrinsics {
                width: 40,
                height: 30,
                fx: 35.0,
                fy: 35.0,
                cx: 20.0,
                cy: 15.0,
                distortion: Default::default()
            }
        );
        assert_eq!(frame.depth_range, Some([1.5, 9.0]));
    }

    fn distortion_and_notes(folder: &Path) -> (f64, String) {
        let set = Dataset::read(folder).unwrap();
        (set.frames[0].lens_intrinsics.distortion.radial[0], set.notes.join("; "))
    }

    /// `poses_bounds.npy` has no lens distortion; the COLMAP model next to it has.
    #[test]
    fn distortion_is_that_of_the_colmap_model() {
        let dir = folder(&npy(&[ROW]), &[("images", 1)]);
        assert_eq!(distortion_and_notes(dir.path()).0, 0.0);
        std::fs::create_dir_all(dir.path().join("sparse/0")).unwrap();
        let cameras =
            |text: &str| std::fs::write(dir.path().join("sparse/0/cameras.txt"), text).unwrap();
        // The model's images are twice as large.
        cameras("1 SIMPLE_RADIAL 160 120 140 80 60 0.02\n");
        assert_eq!(
            distortion_and_notes(dir.path()),
            (
                0.02,
                "LLFF (poses_bounds.npy): 1 photograph from images; 1 photograph has lens \
                distortion"
                    .into()
            )
        );
        for (text, expected) in [
            ("1 SIMPLE_RADIAL 160 120 150 80 60 0.02\n", "a different focal length"),
            ("1 SIMPLE_RADIAL 160 120 nothing\n", "distortion is unknown"),
            (
                "1 SIMPLE_RADIAL 160 120 140 80 60 0.02\n2 PINHOLE 160 120 140 140 80 60\n",
                "2 cameras",
            ),
            ("1 SIMPLE_PINHOLE 160 120 140 80 60\n", "LLFF"),
        ] {
            cameras(text);
            let (found, notes) = distortion_and_notes(dir.path());
            assert!(found == 0.0 && notes.contains(expected), "{text}: {found} {notes}");
        }
    }

    #[test]
    fn mistakes_are_named() {
        let mut bad_pose = ROW;
        bad_pose[0] = f64::NAN;
        let mut bad_range = ROW;
        bad_range[15] = 10.0;
        let mut bad_width = ROW;
        bad_width[9] = -3.0;
        for (bytes, images, expected) in [
            (npy(&[ROW, ROW]), 3, "2 poses for 3 images in images/; counts must match"),
            (npy(&[ROW, ROW])[..200].to_vec(), 2, "not a NumPy array"),
            (b"nothing of the kind".to_vec(), 2, "not a NumPy array"),
            (npy(&[ROW, bad_pose]), 2, "frame 1 (IMG_1): camera_to_world[0][1] is NaN"),
            (npy(&[bad_range, ROW]), 2, "frame 0 (IMG_0): bounds 10 and 9, expected"),
            (npy(&[bad_width, ROW]), 2, "width is -3"),
        ] {
            let message = Dataset::read(folder(&bytes, &[("images", images)]).path())
                .unwrap_err()
                .to_string();
            assert!(
                message.contains(expected) && message.contains("poses_bounds.npy"),
                "{message}"
            );
        }
        let dir = folder(&npy(&[ROW, ROW]), &[("images", 1)]);
        std::fs::create_dir(dir.path().join("images/IMG_9.png")).unwrap();
        let message = Dataset::read(dir.path()).unwrap_err().to_string();
        assert!(
            message.contains("2 poses for 1 image in images/ (")
                && message.contains("IMG_9.png is a folder, not an image)"),
            "{message}"
        );
        // A header that claims more rows than the file has.
        let mut claimed = npy(&[ROW]);
        let position = claimed.windows(7).position(|w| w == b"(1, 17)").unwrap();
        claimed[position + 1] = b'9';
        let message =
            Dataset::read(folder(&claimed, &[("images", 9)]).path()).unwrap_err().to_string();
        assert!(message.contains("not a NumPy array"), "{message}");
        // A header nested so deeply that parsing it would take years, or all of the stack.
        for version in [1, 2] {
            let mut nested = b"\x93NUMPY".to_vec();
            nested.extend([version, 0]);
            let header = [
                &b"{'descr': '<f8', 'fortran_order': False, 'shape': (3, 17), "[..],
                &[b'{'; 30_000],
                b"}\n",
            ]
            .concat();
            let length = (header.len() as u32).to_le_bytes();
            nested.extend(if version == 1 { &length[..2] } else { &length });
            nested.extend(header);
            let message =
                Dataset::read(folder(&nested, &[("images", 3)]).path()).unwrap_err().to_string();
            assert!(message.contains("not a NumPy array"), "{message}");
        }
    }

    #[test]
    fn truncated_files_are_errors() {
        let bytes = npy(&[ROW]);
        for end in 0..bytes.len() {
            assert!(
                Dataset::read(folder(&bytes[..end], &[("images", 1)]).path()).is_err(),
                "{end}"
            );
        }
    }
}
