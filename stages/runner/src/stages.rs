use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::UNIX_EPOCH;

use artifact::{Description, Store, write_atomically};
use serde::{Deserialize, Serialize};

use crate::pipeline::Pipeline;

/// A stage's executable and what it says of itself.
#[derive(Clone, Debug)]
pub(crate) struct StageProgram {
    pub(crate) path: PathBuf,
    pub(crate) description: Description,
}

/// Answers of `describe`, kept by path, size and modification time.
#[derive(Default, Serialize, Deserialize)]
struct Cache(BTreeMap<String, (u64, u128, Description)>);

/// Asks every stage of the pipeline to describe itself; each error names the block.
pub(crate) fn describe_all(pipeline: &Pipeline, store: &Store) -> Result<BTreeMap<String, StageProgram>, crate::PipelineError> {
    pipeline.check_likeness()?;
    let cache_file = store.root().join("cache/describe.json");
    // A cache that can't be read is an empty one.
    let mut cache: Cache = std::fs::read(&cache_file).ok().and_then(|b| serde_json::from_slice(&b).ok()).unwrap_or_default();
    let mut changed = false;
    let mut programs = BTreeMap::new();
    for name in pipeline.stages.keys() {
        let path = executable(pipeline, name);
        let fail = |problem: String| pipeline.error(name, Some("run"), problem);
        let meta = std::fs::metadata(&path).map_err(|e| {
            fail(format!("{}: {e}; build it (make build) or set `run:` to the stage's executable", path.display()))
        })?;
        let modified = meta.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok()).map_or(0, |d| d.as_nanos());
        let id = path.display().to_string();
        let known = cache.0.get(&id).filter(|(size, time, _)| (*size, *time) == (meta.len(), modified));
        let description = match known {
            Some((_, _, description)) => description.clone(),
            None => {
                let description = describe(&path).map_err(fail)?;
                cache.0.insert(id, (meta.len(), modified, description.clone()));
                changed = true;
                description
            }
        };
        programs.insert(name.clone(), StageProgram { path, description });
    }
    if changed && let Ok(bytes) = serde_json::to_vec(&cache) {
        // Only a cache: without it the next start is slower.
        write_atomically(&cache_file, &bytes).ok();
    }
    Ok(programs)
}

pub(crate) fn executable(pipeline: &Pipeline, stage: &str) -> PathBuf {
    let origin = pipeline.stages[stage].like.as_deref().unwrap_or(stage);
    let run = pipeline.stages[origin].run.as_deref().unwrap_or(origin);
    if run.contains('/') {
        let path = pipeline.folder().join(run);
        return path.canonicalize().unwrap_or(path);
    }
    let beside = std::env::current_exe().ok().and_then(|exe| exe.parent().map(Path::to_path_buf));
    beside.unwrap_or_default().join(run)
}

fn describe(path: &Path) -> Result<Description, String> {
    let output = Command::new(path).arg("describe").output().map_err(|e| format!("{}: {e}", path.display()))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        return Err(format!("`{} describe` failed ({}): {}", path.display(), output.status, said.trim()));
    }
    serde_json::from_slice(&output.stdout).map_err(|e| format!("`{} describe` gave no description: {e}", path.display()))
}
