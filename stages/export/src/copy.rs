use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use artifact::{
    FailureExt as _, MANIFEST_FILE, Manifest, RunNode, RunRecord, bail_bad_input, sink_folders,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Progress, SUMMARY_FILE, Stage};

/// Parameters of `copy`: none.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CopyParams {}

/// Number of bytes copied between two reports of progress; chosen by hand.
const CHUNK_BYTES: u64 = 1 << 20;

/// Stage `copy`: a sink that copies a run's artifacts to a folder next to its pages, for other
/// programs. Each point of a sweep has its own folder.
pub struct CopyFiles;

impl Stage for CopyFiles {
    type Params = CopyParams;
    const NAME: &'static str = "copy";
    const SUMMARY: &'static str = "Copies artifacts to the folder of pages, for other programs.";
    const SINK: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        Input::of_sink(
            "in pipeline.yaml: a block whose artifact is copied; nerf-sr passes a folder with its \
            record, run.json",
        )
    }

    fn output() -> Output {
        Output::kind("files")
    }

    fn run(context: &Context, _: &CopyParams) -> anyhow::Result<()> {
        let run = RunRecord::read(context.input("run")?)?;
        let shown: Vec<&RunNode> = run.nodes.iter().filter(|node| node.is_shown).collect();
        let mut files: Vec<(PathBuf, String)> = Vec::new();
        let mut bytes = 0;
        for (node, prefix) in shown.iter().zip(sink_folders(&shown)) {
            let manifest = Manifest::read(&node.folder)
                .bad_input(node.folder.join(MANIFEST_FILE).display())?;
            for file in manifest.files.iter().filter(|file| file.path != SUMMARY_FILE) {
                bytes += file.size;
                files.push((node.folder.join(&file.path), format!("{prefix}{}", file.path)));
            }
        }
        if files.is_empty() {
            bail_bad_input!("run.json has no artifact with files");
        }
        let progress = context.progress("copying", bytes);
        for (source, name) in files {
            let target = context.output_path(&name)?;
            copy_file(context, &source, &target, &progress)
                .with_context(|| format!("cannot copy {}", source.display()))?;
        }
        Ok(())
    }
}

/// Copies a file's content.
fn copy_file(
    context: &Context,
    source: &Path,
    target: &Path,
    progress: &Progress,
) -> anyhow::Result<()> {
    let (mut from, mut to) = (std::fs::File::open(source)?, std::fs::File::create(target)?);
    loop {
        context.check_interrupt()?;
        let count = io::copy(&mut from.by_ref().take(CHUNK_BYTES), &mut to)?;
        if count == 0 {
            return Ok(());
        }
        progress.add(count);
    }
}
