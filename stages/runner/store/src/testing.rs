//! Actions for tests.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;

use serde_json::json;

use crate::action::{Record, Unfinished};
use crate::attempt::Attempt;
use crate::folder::Store;
use crate::lock::{Entered, Locked};

/// Functions that replace a file by something that not even root can read: a folder, or a link to
/// itself.
pub(crate) const UNREADABLE: [fn(&Path); 2] = [
    |path| {
        fs::remove_file(path).ok();
        fs::create_dir(path).unwrap();
    },
    |path| {
        fs::remove_file(path).ok();
        symlink(path.file_name().unwrap(), path).unwrap();
    },
];

pub(crate) fn entered(store: &Store) -> Entered {
    match store.try_enter().unwrap() {
        Locked::Acquired(entered) => entered,
        Locked::HeldBy(_) => panic!("closed"),
    }
}

fn unfinished(name: &str) -> Unfinished {
    Unfinished {
        stage: name.to_owned(),
        key_parts: json!({ "stage": name }).as_object().unwrap().clone(),
        ..Default::default()
    }
}

/// Begins an action and creates its output, if `content` is given.
pub(crate) fn begin(store: &Store, name: &str, content: Option<&str>) -> Attempt {
    let attempt = store.begin(&entered(store), &unfinished(name), &json!({})).unwrap();
    if let Some(content) = content {
        fs::create_dir(&attempt.output).unwrap();
        fs::write(attempt.output.join("x"), content).unwrap();
    }
    attempt
}

/// Finishes an action whose output is `content`.
pub(crate) fn finish_action(store: &Store, name: &str, content: &str) -> Record {
    let checked = store.check(begin(store, name, Some(content)), "text").unwrap();
    let Unfinished { stage, key_parts, .. } = unfinished(name);
    let record = Record { stage, key_parts, threads: 1, ..Record::default() };
    store.publish(&entered(store), checked, record).unwrap()
}
