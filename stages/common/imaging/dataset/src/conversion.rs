//! Files and exports of applications that other programs convert to a data set.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use crate::file_status::{name_text, parent_folder, path_text, sub_folders, visible_entries};
use crate::photograph::{has_extension, is_image_name};
use crate::unsupported::is_unsupported_name;

const VIDEOS: [&str; 6] = ["mp4", "mov", "m4v", "avi", "mkv", "webm"];
/// Extensions of archives, with the commands that unpack them; `{file}` and `{folder}` stand for
/// quoted paths.
const ARCHIVES: [(&str, &str); 7] = [
    ("zip", "unzip {file} -d {folder}"),
    ("tar", TAR),
    ("tgz", TAR),
    ("gz", TAR),
    ("xz", TAR),
    ("7z", "7z x {file} -o{folder}"),
    ("rar", "unrar x {file} {folder}/"),
];
const TAR: &str = "mkdir -p {folder} && tar -xf {file} -C {folder}";
/// Number of bytes at a file's start that identify an application's file.
const HEAD_BYTES: u64 = 4096;

/// Describes a video or an archive, with the command that makes a folder of it.
pub(crate) fn packed_text(file: &Path) -> Option<String> {
    let mut folder = file.with_extension("");
    if has_extension(&folder, "tar") {
        folder = folder.with_extension("");
    }
    let [quoted_file, quoted_folder] = [file, &folder].map(shell_quoted);
    if VIDEOS.iter().any(|extension| has_extension(file, extension)) {
        let images = shell_quoted(&folder.join("images"));
        let frames = shell_quoted(&folder.join("images/%04d.jpg"));
        return Some(format!(
            "found a video; extract two photographs a second and give the folder {quoted_folder}: \
            mkdir -p {images} && ffmpeg -i {quoted_file} -vf fps=2 -q:v 2 {frames}"
        ));
    }
    let (_, command) = ARCHIVES.iter().find(|(extension, _)| has_extension(file, extension))?;
    let command = command.replace("{file}", &quoted_file).replace("{folder}", &quoted_folder);
    Some(format!("found an archive; unpack it and give the folder {quoted_folder}: {command}"))
}

/// Finds a video or an archive in a folder without folders and images.
pub(crate) fn find_packed(folder: &Path) -> Option<String> {
    let entries = visible_entries(folder);
    let has_images = entries
        .iter()
        .any(|path| path.is_dir() || is_image_name(path) || is_unsupported_name(path));
    if has_images { None } else { entries.iter().find_map(|path| packed_text(path)) }
}

/// Describes an export of an application, identified by the file or folder `sign`; `remedy`
/// converts the export.
fn export_text(application: &str, sign: &Path, remedy: &str) -> String {
    let sign = path_text(sign);
    format!("found a {application} export ({sign}), which is not supported; {remedy}")
}

/// Recognises exports of Polycam, Record3D, Metashape and RealityCapture, also in a folder's only
/// sub-folder, as in an archive.
pub(crate) fn find_export(folder: &Path) -> Option<String> {
    let mut candidates = vec![folder.to_path_buf()];
    if let [only] = &sub_folders(folder)[..] {
        candidates.push(only.clone());
    }
    candidates.iter().find_map(|folder| {
        find_polycam(folder)
            .or_else(|| find_record3d(folder))
            .or_else(|| find_reconstruction(folder))
    })
}

fn find_polycam(folder: &Path) -> Option<String> {
    let (data, keyframes) = if name_text(folder) == "keyframes" {
        (parent_folder(folder), folder.to_path_buf())
    } else {
        (folder.to_path_buf(), folder.join("keyframes"))
    };
    let mut cameras = ["corrected_cameras", "cameras"].map(|name| keyframes.join(name)).into_iter();
    let sign =
        cameras.find(|path| visible_entries(path).iter().any(|e| has_extension(e, "json")))?;
    Some(export_text("Polycam", &sign, &conversion("polycam", &data, &data)))
}

fn find_record3d(folder: &Path) -> Option<String> {
    let has = |name: &str| folder.join(name).exists();
    let (sign, is_video) = if has("EXR_RGBD") {
        (folder.join("EXR_RGBD"), false)
    } else if has("rgbd") && has("metadata") {
        (folder.join("rgbd"), true)
    } else if has("rgb") && has("depth") && (has("metadata.json") || has("metadata")) {
        (folder.join("rgb"), false)
    } else {
        (visible_entries(folder).into_iter().find(|path| has_extension(path, "r3d"))?, true)
    };
    let data = if has("EXR_RGBD") { &sign } else { folder };
    let command = conversion("record3d", data, data);
    let remedy = if is_video {
        format!("export it from Record3D as EXR + JPG sequence, then {command}")
    } else {
        command
    };
    Some(export_text("Record3D", &sign, &remedy))
}

/// Recognises Metashape's XML and RealityCapture's CSV file of cameras.
fn find_reconstruction(folder: &Path) -> Option<String> {
    visible_entries(folder).iter().find_map(|file| {
        let head = head_text(file)?;
        let (application, name, option) = if head.contains("<document") && head.contains("<chunk") {
            ("Metashape", "metashape", "xml")
        } else if head.contains("#name,x,y,alt,") {
            ("RealityCapture", "realitycapture", "csv")
        } else {
            return None;
        };
        let images = folder.join("images");
        let data = if images.is_dir() { &images } else { folder };
        let options = format!("{name} --{option} {}", shell_quoted(file));
        Some(export_text(application, file, &conversion(&options, data, folder)))
    })
}

/// Reads the start of an XML or CSV file.
fn head_text(file: &Path) -> Option<String> {
    let is_text = has_extension(file, "xml") || has_extension(file, "csv");
    let mut bytes = Vec::new();
    let file = File::open(file).ok().filter(|_| is_text && file.is_file())?;
    file.take(HEAD_BYTES).read_to_end(&mut bytes).ok()?;
    Some(String::from_utf8_lossy(&bytes).into_owned())
}

/// Returns nerfstudio's command that converts an application's export to a data set next to the
/// folder `source`.
fn conversion(application: &str, data: &Path, source: &Path) -> String {
    let mut output = source.as_os_str().to_owned();
    output.push("-nerfstudio");
    format!(
        "convert: ns-process-data {application} --data {} --output-dir {}",
        shell_quoted(data),
        shell_quoted(Path::new(&output))
    )
}

fn shell_quoted(path: &Path) -> String {
    format!("'{}'", path_text(path).replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn videos_and_archives_come_with_their_command() {
        for (name, expected) in [
            (
                "x/IMG 1.MOV",
                "mkdir -p 'x/IMG 1/images' && ffmpeg -i 'x/IMG 1.MOV' -vf fps=2 -q:v 2 'x/IMG 1/images/%04d.jpg'",
            ),
            ("a.zip", "give the folder 'a': unzip 'a.zip' -d 'a'"),
            ("a.tar.gz", "give the folder 'a': mkdir -p 'a' && tar -xf 'a.tar.gz' -C 'a'"),
        ] {
            let text = packed_text(Path::new(name)).unwrap();
            assert!(text.ends_with(expected), "{text}");
        }
        assert_eq!(packed_text(Path::new("a.png")), None);
    }

    #[test]
    fn only_folders_with_nothing_else_are_packed() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("a.mp4"), "").unwrap();
        assert!(find_packed(dir.path()).unwrap().contains("ffmpeg -i"));
        std::fs::write(dir.path().join("a.heic"), "").unwrap();
        assert_eq!(find_packed(dir.path()), None);
    }
}
