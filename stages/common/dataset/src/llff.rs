use std::path::{Path, PathBuf};

use artifact::counted;
use glam::{DMat3, DVec3};
use scene::{Distortion, Intrinsics, pose_of};

use crate::colmap;
use crate::dataset::Dataset;
use crate::error::DatasetError;
use crate::file_reason::{FileReason, ImageFolder};
use crate::format::Format;
use crate::found::{Found, check_link, find, is_file, is_hidden};
use crate::frame::{Frame, names};
use crate::frame_reason::FrameReason;
use crate::lookup::{Located, Lookup};
use crate::masks::without_dynamic_masks;
use crate::misplaced::shown;
use crate::npy::{ArrayReason, read_matrix};
use crate::photograph::{Stored, fitted, is_image_name, look};
use crate::text::read_text;
use crate::unread::unread_images;

/// Numbers a photograph: a 3×5 matrix (axes down, right and back, centre, and height, width, focal
/// length), near and far.
const NUMBERS: usize = 17;

/// Reads `poses_bounds.npy` (Mildenhall et al. 2019) and the images beside it, sorted by name.
pub(crate) fn read(folder: &Path) -> Result<Dataset, DatasetError> {
    let path = folder.join("poses_bounds.npy");
    let rows = read_numbers(&path)?;
    check_link(&folder.join("images"))?;
    let Photographs { images, labels, notes } = photographs(folder, &path, rows.len())?;
    let names = names(&path, &labels)?;
    let (distortion, note) = distortion(folder, &rows);
    let mut frames = Vec::with_capacity(rows.len());
    for (index, ((row, image), name)) in rows.iter().zip(images).zip(names).enumerate() {
        let file = name.clone();
        let of_frame = |reason| DatasetError::frame(&path, index, &file, reason);
        let frame = look(&image)
            .map_err(FrameReason::from)
            .and_then(|stored| frame(row, distortion, stored, name, image));
        frames.push(frame.map_err(of_frame)?);
    }
    let mut notes = notes;
    notes.extend(note);
    Ok(Dataset { format: Format::Llff, frames, split: None, notes })
}

/// The lens's distortion, which the file doesn't have: the poses come from COLMAP, and hold for the
/// lens that it found. Where its model lies beside them, with one camera of their focal length,
/// that says it.
fn distortion(folder: &Path, rows: &[[f64; NUMBERS]]) -> (Distortion, Option<String>) {
    let camera = match colmap::only_camera(folder) {
        Ok(Some(camera)) if !camera.distortion.is_none() => camera,
        Ok(_) => return (Distortion::default(), None),
        Err(e) => {
            return (Distortion::default(), Some(format!("lens distortion is not known: {e}")));
        }
    };
    if rows.iter().all(|row| has_focal_length_of(&camera, row)) {
        (camera.distortion, None)
    } else {
        let note = format!(
            "lens distortion is not known: the model in sparse has another focal length ({} of {} \
            pixels)",
            camera.fx, camera.width
        );
        (Distortion::default(), Some(note))
    }
}

/// Whether a photograph has a camera's focal length, each in parts of its width.
fn has_focal_length_of(camera: &Intrinsics, row: &[f64; NUMBERS]) -> bool {
    let (width, focal) = (row[9], row[14]);
    (camera.fx * width / (f64::from(camera.width) * focal) - 1.0).abs() < 1e-3
}

fn frame(
    row: &[f64; NUMBERS],
    distortion: Distortion,
    stored: Stored,
    name: String,
    image: PathBuf,
) -> Result<Frame, FrameReason> {
    let column = |c: usize| DVec3::new(row[c], row[5 + c], row[10 + c]);
    let (down, right, back, centre, inside) =
        (column(0), column(1), column(2), column(3), column(4));
    let [height, width, focal] = inside.to_array();
    let (width, height) = (whole(width, "width")?, whole(height, "height")?);
    let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
    let (taken_with, turn) =
        fitted(Intrinsics { width, height, fx: focal, fy: focal, cx, cy, distortion }, stored)?;
    let (near, far) = (row[15], row[16]);
    if !(near.is_finite() && far.is_finite() && 0.0 < near && near < far) {
        return Err(FrameReason::Depths { near, far });
    }
    let camera_to_world = pose_of(DMat3::from_cols(right, -down, back), centre);
    let frame = Frame {
        name,
        image,
        turn,
        mask: None,
        depth: None,
        taken_with,
        pinhole: None,
        camera_to_world,
        depths: Some([near, far]),
    };
    frame.check()?;
    Ok(frame)
}

fn whole(value: f64, name: &'static str) -> Result<u32, FrameReason> {
    if (1.0..=f64::from(u32::MAX)).contains(&value) {
        Ok(value.round() as u32)
    } else {
        Err(FrameReason::Empty { name, value })
    }
}

/// Photographs of the poses, in the poses' order.
struct Photographs {
    images: Vec<PathBuf>,
    /// Paths whose stems name the views, inside the data set's folder.
    labels: Vec<PathBuf>,
    notes: Vec<String>,
}

impl Photographs {
    fn new(images: Vec<PathBuf>, labels: Vec<PathBuf>, from: &str) -> Self {
        let count = counted(images.len(), "photograph");
        let notes = vec![format!("LLFF (poses_bounds.npy): {count} from {from}")];
        Self { images, labels, notes }
    }
}

/// Returns all images of `images`, or of the largest of `images_2`, `images_4` … that has one for
/// every pose. Where none has, a list may name the images with poses.
fn photographs(folder: &Path, path: &Path, poses: usize) -> Result<Photographs, DatasetError> {
    let mut names = vec!["images".to_owned()];
    names.extend((2..=64).map(|n| format!("images_{n}")));
    let mut folders = Vec::new();
    for name in names {
        let Some((files, mut folder_of_images)) = images_of(folder, &name) else { continue };
        if files.len() == poses {
            let inside = files.iter().filter_map(|p| p.strip_prefix(folder).ok());
            let labels = inside.map(Path::to_path_buf).collect();
            return Ok(Photographs::new(files, labels, &name));
        }
        folder_of_images.images = files.len();
        folders.push(folder_of_images);
    }
    match listed_photographs(folder, path, poses)? {
        Some(found) => Ok(found),
        None => Err(DatasetError::format(path, FileReason::Counts { poses, folders })),
    }
}

/// Returns a folder's images by name, and what else is named like an image. Names that begin with a
/// dot and instant-ngp's masks are no images.
fn images_of(folder: &Path, name: &str) -> Option<(Vec<PathBuf>, ImageFolder)> {
    let path = folder.join(name);
    let entries = std::fs::read_dir(&path).ok()?.flatten().map(|entry| entry.path());
    let mut named: Vec<PathBuf> = entries.filter(|path| !is_hidden(path)).collect();
    named.sort();
    let unread = unread_images(&named);
    named.retain(|path| is_image_name(path));
    let mut named = without_dynamic_masks(named);
    let mut odd = None;
    named.retain(|path| match find(path, "an image") {
        Found::File => true,
        Found::Nothing(found) | Found::Other(found) => {
            odd.get_or_insert(found);
            false
        }
    });
    Some((named, ImageFolder { name: name.to_owned(), images: 0, odd, unread }))
}

/// Returns the images that `view_imgs.txt` (imgs2poses) or COLMAP's model next to the poses names,
/// if one of them has a name for every pose. Poses are in the order of names.
fn listed_photographs(
    folder: &Path,
    path: &Path,
    poses: usize,
) -> Result<Option<Photographs>, DatasetError> {
    let list = folder.join("view_imgs.txt");
    let mut lists = Vec::new();
    if is_file(&list)? {
        let text = read_text(&list)?;
        let names = text.lines().map(|line| line.trim().to_owned());
        lists.push(("view_imgs.txt", names.filter(|name| !name.is_empty()).collect()));
    }
    // A model that can't be read names no images.
    lists.push(("sparse", colmap::image_names(folder).unwrap_or_default()));
    let Some((source, mut names)) = lists.into_iter().find(|(_, names)| names.len() == poses)
    else {
        return Ok(None);
    };
    names.sort();
    let named: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut lookup = Lookup::in_images(folder, &named);
    let (mut images, mut labels) = (Vec::new(), Vec::new());
    for (index, name) in named.iter().enumerate() {
        let of_frame = |reason| DatasetError::frame(path, index, name, reason);
        match lookup.find(name).map_err(|e| of_frame(e.into()))? {
            Located::File(file) => {
                images.push(folder.join(&file.path));
                labels.push(file.label);
            }
            Located::Nothing(found) | Located::Other(found) => {
                let remedy = "restore the photograph";
                return Err(of_frame(FrameReason::Place { found, remedy }));
            }
        }
    }
    let from = lookup.base().strip_prefix(folder).map(shown).unwrap_or_default();
    let mut found = Photographs::new(images, labels, &from);
    found.notes.push(format!("{source} names the photographs with poses"));
    found.notes.extend(lookup.notes());
    Ok(Some(found))
}

/// The array's rows.
fn read_numbers(path: &Path) -> Result<Vec<[f64; NUMBERS]>, DatasetError> {
    let bytes = std::fs::read(path)
        .map_err(|source| DatasetError::Io { path: path.to_path_buf(), source })?;
    let matrix = read_matrix(&bytes).map_err(|reason| no_array(path, reason))?;
    if matrix.columns != NUMBERS || matrix.numbers.is_empty() {
        return Err(no_array(path, ArrayReason::Shape(vec![matrix.rows, matrix.columns])));
    }
    Ok(matrix.numbers.as_chunks().0.to_vec())
}

fn no_array(path: &Path, reason: ArrayReason) -> DatasetError {
    DatasetError::format(path, FileReason::Array { columns: NUMBERS, reason })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photograph::tests::write_png;

    /// A camera at (1, 2, 3) with axes right = x, up = y, back = z.
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
    fn axes_and_sizes_are_turned_into_ours() {
        let dir = folder(&npy(&[ROW, ROW]), &[("images", 3), ("images_4", 2)]);
        let set = Dataset::read(dir.path()).unwrap();
        assert_eq!((set.format, set.frames.len()), (Format::Llff, 2));
        assert!(set.notes[0].contains("images_4"), "{:?}", set.notes);
        let frame = &set.frames[1];
        assert_eq!(frame.name, "IMG_1");
        assert_eq!(frame.camera_to_world, [[1., 0., 0., 1.], [0., 1., 0., 2.], [0., 0., 1., 3.]]);
        assert_eq!(
            frame.taken_with,
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
        assert_eq!(frame.depths, Some([1.5, 9.0]));
    }

    fn distortion_and_notes(folder: &Path) -> (f64, String) {
        let set = Dataset::read(folder).unwrap();
        (set.frames[0].taken_with.distortion.radial[0], set.notes.join("; "))
    }

    /// The file can't say what its poses' lens does to lines; the model that they come from can.
    #[test]
    fn distortion_is_that_of_the_model_beside_them() {
        let dir = folder(&npy(&[ROW]), &[("images", 1)]);
        assert_eq!(distortion_and_notes(dir.path()).0, 0.0);
        std::fs::create_dir_all(dir.path().join("sparse/0")).unwrap();
        let cameras =
            |text: &str| std::fs::write(dir.path().join("sparse/0/cameras.txt"), text).unwrap();
        // Its images are twice as large.
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
        for (text, words) in [
            ("1 SIMPLE_RADIAL 160 120 150 80 60 0.02\n", "another focal length"),
            ("1 SIMPLE_RADIAL 160 120 nothing\n", "distortion is not known"),
            ("1 SIMPLE_RADIAL 160 120 140 80 60 0.02\n2 PINHOLE 160 120 140 140 80 60\n", "LLFF"),
            ("1 SIMPLE_PINHOLE 160 120 140 80 60\n", "LLFF"),
        ] {
            cameras(text);
            let (found, notes) = distortion_and_notes(dir.path());
            assert!(found == 0.0 && notes.contains(words), "{text}: {found} {notes}");
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
        for (bytes, images, words) in [
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
            assert!(message.contains(words) && message.contains("poses_bounds.npy"), "{message}");
        }
        let dir = folder(&npy(&[ROW, ROW]), &[("images", 1)]);
        std::fs::create_dir(dir.path().join("images/IMG_9.png")).unwrap();
        let message = Dataset::read(dir.path()).unwrap_err().to_string();
        assert!(
            message.contains("2 poses for 1 image in images/ (")
                && message.contains("IMG_9.png is a folder, not an image)"),
            "{message}"
        );
        // A header that claims more than there is.
        let mut claimed = npy(&[ROW]);
        let place = claimed.windows(7).position(|w| w == b"(1, 17)").unwrap();
        claimed[place + 1] = b'9';
        let message =
            Dataset::read(folder(&claimed, &[("images", 9)]).path()).unwrap_err().to_string();
        assert!(message.contains("not a NumPy array"), "{message}");
        // One nested so deep that reading it would take years, or all of the stack.
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
    fn any_bytes_are_an_error_and_no_panic() {
        let whole = npy(&[ROW]);
        for end in 0..whole.len() {
            assert!(
                Dataset::read(folder(&whole[..end], &[("images", 1)]).path()).is_err(),
                "{end}"
            );
        }
    }
}
