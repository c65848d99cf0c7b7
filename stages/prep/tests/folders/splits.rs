//! Lists of training, validation and test views.

use std::path::Path;

use serde_json::{Value, json};

use super::kit::{
    Case, Expected, Scene, case, held_out, transforms, views, write_photographs, write_transforms,
};

const NOTE: &str = "transforms.json (instant-ngp, nerfstudio): 10 photographs";

fn names(numbers: impl IntoIterator<Item = usize>) -> Value {
    numbers.into_iter().map(|number| format!("images/a_{number}.png")).collect()
}

/// Writes ten photographs, and lists for training, validation and testing. `null` omits a list.
fn write_lists(folder: &Path, train: Value, val: Value, test: Value) {
    write_photographs(folder, "images/a_#.png", 10);
    let mut list = transforms("images/a_#.png", 10);
    for (key, names) in
        [("train_filenames", train), ("val_filenames", val), ("test_filenames", test)]
    {
        if !names.is_null() {
            list[key] = names;
        }
    }
    write_transforms(folder, &list);
}

fn split(
    train: impl IntoIterator<Item = usize>,
    test: impl IntoIterator<Item = usize>,
    notes: &[&'static str],
) -> Expected {
    let mut all_notes = vec![NOTE];
    all_notes.extend(notes);
    let (train, test) = (views("a_#", train), views("a_#", test));
    Expected::Scene(Scene { train, test, notes: all_notes, ..Scene::default() })
}

pub(crate) fn cases() -> Vec<Case> {
    vec![
        case(
            "ns#2933, ns PR#3054: an empty test list",
            |folder| write_lists(folder, names(2..10), names(0..2), json!([])),
            split(2..10, 0..2, &[]),
        ),
        case(
            "views for validation next to test views",
            |folder| write_lists(folder, names(3..10), names(1..3), names([0])),
            split(3..10, [0], &["2 of 10 frames are listed for neither training nor testing"]),
        ),
        case(
            "names of frames as other steps of the lookup find them",
            |folder| {
                let train = json!([r"images\a_4.png", "/x/images/a_5.png", "images/A_6"]);
                write_lists(folder, train, Value::Null, json!(["./images/a_0.png"]));
            },
            split(
                4..7,
                [0],
                &[
                    r"1 file name found with slashes instead of backslashes (first: images\a_4.png is images/a_4.png)",
                    "1 file name found without the first part of their paths (first: /x/images/a_5.png is images/a_5.png)",
                    "1 file name found with a different extension (first: images/A_6 is images/a_6.png)",
                    "1 file name found in a different case (first: images/A_6 is images/a_6.png)",
                    "6 of 10 frames are listed for neither training nor testing",
                ],
            ),
        ),
        case(
            "names without a frame",
            |folder| {
                let train = json!(["images/a_3.png", "images/b.png", "images/c.png"]);
                write_lists(folder, train, Value::Null, names([0]));
            },
            split(
                [3],
                [0],
                &[
                    "2 of 3 names in train_filenames have no frame (first: images/b.png)",
                    "8 of 10 frames are listed for neither training nor testing",
                ],
            ),
        ),
        case(
            "ns PR#3054: a list without frames",
            |folder| write_lists(folder, json!(["x/1.png", "x/2.png"]), names([0]), json!([])),
            Expected::Refused(
                "dataset: DIR/transforms.json: no name in train_filenames is that of a frame (first of 2: x/1.png); correct the names, or remove train_filenames",
            ),
        ),
        case(
            "a validation list without frames",
            |folder| write_lists(folder, names([1]), json!(["x/1.png"]), names([0])),
            Expected::Refused(
                "dataset: DIR/transforms.json: no name in val_filenames is that of a frame (first of 1: x/1.png); correct the names, or remove val_filenames",
            ),
        ),
        case(
            "empty lists",
            |folder| write_lists(folder, json!([]), json!([]), json!([])),
            Expected::Scene(held_out("a_#", 10, &[NOTE])),
        ),
        case(
            "test views alone",
            |folder| write_lists(folder, Value::Null, json!([]), names([3, 5])),
            split([0, 1, 2, 4, 6, 7, 8, 9], [3, 5], &["8 training views: all unlisted frames"]),
        ),
        case(
            "training views alone",
            |folder| write_lists(folder, names(0..9), json!([]), Value::Null),
            split(0..9, [9], &["1 test view: all unlisted frames"]),
        ),
        case(
            "all views for training",
            |folder| write_lists(folder, names(0..10), Value::Null, Value::Null),
            Expected::Scene(held_out("a_#", 10, &[NOTE])),
        ),
    ]
}
