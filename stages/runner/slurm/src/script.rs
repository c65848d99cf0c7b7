//! The script of a submission's jobs. A job's argument is the index of its task.

use std::ffi::OsStr;

use crate::site::Site;

/// Returns the script: the site's set-up lines, then `exec` of the command, so that Slurm's signals
/// reach the command.
pub(crate) fn script(site: &Site, command: &[&OsStr]) -> Vec<u8> {
    let mut text =
        b"#!/bin/bash\n# Runs one task of a submission; $1 is its index.\nset -e\n".to_vec();
    for line in &site.setup {
        text.extend_from_slice(line.as_bytes());
        text.push(b'\n');
    }
    text.extend_from_slice(b"exec");
    for word in command {
        text.push(b' ');
        text.extend(shell_quoted(word.as_encoded_bytes()));
    }
    text.extend_from_slice(b" \"$1\"\n");
    text
}

/// Returns a word in single quotes for a POSIX shell.
fn shell_quoted(word: &[u8]) -> Vec<u8> {
    let parts: Vec<&[u8]> = word.split(|&byte| byte == b'\'').collect();
    [b"'", &parts.join(&br"'\''"[..])[..], b"'"].concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    /// The shell itself prints the arguments that it read.
    #[test]
    fn a_shell_passes_on_equal_arguments() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("job.sh");
        let site = Site { setup: vec!["export GREETING='good day'".to_owned()], ..Site::default() };
        let awkward = "a b'c\"$HOME`x`\\*";
        let print = "printf '[%s]' \"$GREETING\" \"$@\"";
        let arguments = ["sh", "-c", print, "sh", awkward].map(OsStr::new);
        std::fs::write(&path, script(&site, &arguments)).unwrap();
        let output = Command::new("bash").arg(&path).arg("17").output().unwrap();
        assert_eq!(String::from_utf8_lossy(&output.stdout), format!("[good day][{awkward}][17]"));
        let failing = Site { setup: vec!["false".to_owned()], ..Site::default() };
        std::fs::write(&path, script(&failing, &[OsStr::new("true")])).unwrap();
        assert!(
            !Command::new("bash").arg(&path).status().unwrap().success(),
            "a set-up line that fails must end the job"
        );
    }
}
