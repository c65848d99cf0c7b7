use super::*;

/// Creates a folder with empty files.
fn folder(files: &[&str]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for file in files {
        let path = dir.path().join(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "").unwrap();
    }
    dir
}

/// Returns the path of the file with the given name, or the error message.
fn find(lookup: &mut Lookup, name: &str) -> String {
    match lookup.find(name) {
        Ok(file) => path_text(&file.path),
        Err(error) => error.to_string(),
    }
}

#[test]
fn steps_are_tried_in_order_and_combine() {
    let dir = folder(&[
        "images/a.png",
        r"images\b.png",
        "images/b.png",
        "images/c.JPG",
        "images/d.png.png",
        "Images2/E.Jpeg",
        "images/f.png",
        "images/f.exr",
        "images/g.png",
        "images/G.png",
        "images/.h.png",
        "images/i.jpg",
        "images/k.webp",
        "j.png",
        "e\u{301}te\u{301}/o\u{308}.PNG",
        "e\u{301}te\u{301}/\u{fc}.png",
    ]);
    for (name, file) in [
        ("images/a.png", "images/a.png"),
        ("./images/a", "images/a.png"),
        (r"images\a.png", "images/a.png"),
        (r"images\b.png", r"images\b.png"),
        (r".\images\A", "images/a.png"),
        ("images/c", "images/c.JPG"),
        ("images/c.jpg", "images/c.JPG"),
        ("images/c.jpg.jpg", "images/c.JPG"),
        ("images/d.png", "images/d.png.png"),
        ("images/a.png.png", "images/a.png"),
        ("images2/e.jpeg", "Images2/E.Jpeg"),
        ("images2/e", "Images2/E.Jpeg"),
        ("images/i.heic", "images/i.jpg"),
        (r"C:\x\images\a.png", "images/a.png"),
        ("/home/y/images/A.PNG", "images/a.png"),
        ("/j.png", "j.png"),
        ("images/g.png", "images/g.png"),
        ("images/f.png", "images/f.png"),
        ("\u{e9}t\u{e9}/\u{f6}.PNG", "e\u{301}te\u{301}/o\u{308}.PNG"),
        ("\u{e9}t\u{e9}/\u{f6}", "e\u{301}te\u{301}/o\u{308}.PNG"),
        ("\u{c9}t\u{e9}/\u{d6}.png", "e\u{301}te\u{301}/o\u{308}.PNG"),
        ("e\u{301}te\u{301}/u\u{308}.png", "e\u{301}te\u{301}/\u{fc}.png"),
    ] {
        let mut lookup = Lookup::in_folder(dir.path(), &[name], &[]);
        assert_eq!(find(&mut lookup, name), file, "{name}");
        assert_eq!(lookup.notes().is_empty(), name == file || name == "./images/a", "{name}");
    }
    for (name, expected) in [
        ("images/f", r#"images/f.exr and images/f.png both match "images/f"; remove one"#),
        ("images/G.PNG", r#"images/G.png and images/g.png both match "images/G.PNG""#),
        ("images/h.png", "images/h.png not found"),
        ("images/i.png", "images/i.png not found"),
        ("images/x", "images/x.png not found"),
        // The error of reading this file names the remedy.
        ("images/k", "images/k.webp"),
        ("../images/a.png", "\"../images/a.png\" is not a path inside the folder"),
        (r"..\images\a.png", r"..\images\a.png not found"),
        ("/home/x.png", "no file in the data set matches the end of the absolute path"),
        ("", "\"\" is not a path inside the folder"),
    ] {
        let message = find(&mut Lookup::in_folder(dir.path(), &[name], &[]), name);
        assert!(message.contains(expected), "{message}");
    }
    // A file that one name matches literally is not found for another name: depth next to a
    // photograph, or two names that differ in case.
    for (name, other, file) in [
        ("images/f", "images/f.exr", "images/f.png"),
        ("images/i", "images/i.jpg", "images/i.png not found"),
        ("images/A.png", "images/a.png", "images/A.png not found"),
    ] {
        let mut lookup = Lookup::in_folder(dir.path(), &[name, other], &[]);
        assert!(find(&mut lookup, name).contains(file), "{name}");
        assert_eq!(find(&mut lookup, other), other);
    }
}

#[test]
fn names_in_another_normal_form_are_noted() {
    let dir = folder(&["e\u{301}.png"]);
    for (name, notes) in [
        ("\u{e9}.png", &["Unicode normal form"][..]),
        ("\u{e9}", &["extension", "Unicode normal form"]),
        ("E\u{301}.png", &["case"]),
        ("\u{c9}.png", &["Unicode normal form", "case"]),
    ] {
        let mut lookup = Lookup::in_folder(dir.path(), &[name], &[]);
        assert_eq!(find(&mut lookup, name), "e\u{301}.png");
        let expected = notes.iter().map(|step| format!("in a different {step} (first: {name} is "));
        let expected =
            expected.map(|note| note.replace("in a different ext", "with a different ext"));
        let found = lookup.notes();
        assert_eq!(found.len(), notes.len(), "{found:?}");
        assert!(found.iter().zip(expected).all(|(note, text)| note.contains(&text)), "{found:?}");
    }
}

/// All names lose equally many leading parts: the smallest number that finds the most files.
#[test]
fn absolute_names_lose_equally_many_parts() {
    let dir = folder(&["scene/images/a.png", "images/a.png", "images/b.png", "b.png"]);
    let names = ["/x/scene/images/a.png", "/x/scene/images/b.png", "/x/scene/images/c.png"];
    let mut lookup = Lookup::in_folder(dir.path(), &names, &[]);
    assert_eq!(find(&mut lookup, names[0]), "images/a.png");
    assert_eq!(find(&mut lookup, names[1]), "images/b.png");
    assert!(find(&mut lookup, names[2]).contains("no file in the data set"));
    assert_eq!(
        lookup.notes(),
        ["2 file names found without the first 2 parts of their paths (first: \
            /x/scene/images/a.png is images/a.png)"]
    );
    let mut lookup = Lookup::in_folder(dir.path(), &names[..1], &[]);
    assert_eq!(find(&mut lookup, names[0]), "scene/images/a.png");
}

/// Relative names and URLs lose leading folders only if none is found as written.
#[test]
fn relative_names_lose_leading_folders_where_none_is_found() {
    let dir = folder(&["images/a.png", "images/b.png", "b.png"]);
    for (names, removed) in [
        (["./data/fox/images/a.png", "./data/fox/images/b"], 2),
        (["file:///home/x/images/a.png", "file:///home/x/images/b.png"], 3),
        ([r"data\images\a.png", r"data\images\b.png"], 1),
    ] {
        let mut lookup = Lookup::in_folder(dir.path(), &names, &[]);
        assert_eq!(names.map(|name| find(&mut lookup, name)), ["images/a.png", "images/b.png"]);
        let notes = lookup.notes().join("; ");
        let parts = if removed == 1 { "part".to_owned() } else { format!("{removed} parts") };
        let first = format!("without the first {parts} of their paths (first: {} is", names[0]);
        assert!(notes.contains(&first), "{notes}");
    }
    let mut lookup = Lookup::in_folder(dir.path(), &["images/a.png", "new/b.png"], &[]);
    assert!(find(&mut lookup, "new/b.png").contains("new/b.png not found"));
    let mut lookup = Lookup::in_images(dir.path(), &["DCIM/100/a.png", "DCIM/100/b.png"]);
    assert_eq!(find(&mut lookup, "DCIM/100/b.png"), "images/b.png");
    let mut lookup = Lookup::in_folder(dir.path(), &["../images/a.png"], &[]);
    assert!(find(&mut lookup, "../images/a.png").contains("not a path inside"));
}

/// Reduced copies may have another format. Among the folders that contain the most names, the one
/// with the largest images is read.
#[test]
fn reduced_copies_replace_missing_images() {
    let files =
        ["images_8/a.png", "images_8/b.png", "images_4/a.PNG", "images_4/b.png", "images_2/a.png"];
    let dir = folder(&files);
    for (base, mut lookup) in [
        ("", Lookup::in_images(dir.path(), &["a.jpg", "b.jpg"])),
        ("images/", Lookup::in_folder(dir.path(), &["images/a.jpg", "images/b.jpg"], &[])),
    ] {
        assert_eq!(find(&mut lookup, &format!("{base}a.jpg")), "images_4/a.PNG");
        assert_eq!(find(&mut lookup, &format!("{base}b.jpg")), "images_4/b.png");
        let note = format!(
            "2 file names found in images_4, because images is missing or empty (first: \
            {base}a.jpg is images_4/a.PNG)"
        );
        assert_eq!(lookup.notes(), [note]);
        assert_eq!(
            lookup.without_base(Path::new("images_4/x/a.png")),
            match base {
                "" => Path::new("x/a.png"),
                _ => Path::new("images_4/x/a.png"),
            }
        );
    }
    std::fs::create_dir(dir.path().join("images")).unwrap();
    let mut lookup = Lookup::in_images(dir.path(), &["a.jpg"]);
    assert_eq!(find(&mut lookup, "a.jpg"), "images_2/a.png");
    std::fs::write(dir.path().join("images/b.jpg"), "").unwrap();
    let mut lookup = Lookup::in_images(dir.path(), &["a.jpg"]);
    assert!(find(&mut lookup, "a.jpg").contains("images/a.jpg not found"));
}

#[test]
fn colmap_names_are_relative_to_images_or_the_folder() {
    let dir = folder(&["images/x/a  b.png", "c.png"]);
    for (name, file) in [
        ("x/a  b.png", "images/x/a  b.png"),
        ("images/x/a  b.png", "images/x/a  b.png"),
        ("c.png", "c.png"),
    ] {
        assert_eq!(find(&mut Lookup::in_images(dir.path(), &[name]), name), file);
    }
    assert!(Lookup::in_images(dir.path(), &["d.png"]).base().ends_with("images"));
}
