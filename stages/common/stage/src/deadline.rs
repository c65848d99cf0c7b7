use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use artifact::Failure;

use crate::panics::end_process;

/// Time from a signal to the end of the process, in which a stage may write a checkpoint and end by
/// itself. People wait two seconds; freeing many gigabytes of memory takes part of them.
const GRACE: Duration = Duration::from_secs(1);
/// Time between two checks of the flag that signals set.
const INTERVAL: Duration = Duration::from_millis(50);

/// End of a stage: by the stage itself or by its deadline, whichever comes first.
///
/// No loop can be trusted to check for signals often enough: one call of libtorch, a decoder or the
/// file system may take minutes. Ending the process is always safe, since outputs, parts and
/// checkpoints only appear by renaming.
#[derive(Clone, Default)]
pub(crate) struct End {
    is_claimed: Arc<AtomicBool>,
}

impl End {
    /// Claims the end for the calling thread. If another thread has claimed the end, the calling
    /// thread waits for the process to end.
    pub(crate) fn claim(&self) {
        if self.is_claimed.swap(true, Ordering::SeqCst) {
            loop {
                std::thread::park();
            }
        }
    }

    /// Starts a thread that ends the process, unless the stage has ended by itself within
    /// [`GRACE`] after `interrupted` is set. The unpublished `output` is removed.
    pub(crate) fn enforce(
        &self,
        stage: &'static str,
        interrupted: &Arc<AtomicBool>,
        output: &Path,
    ) -> std::io::Result<()> {
        let (end, interrupted) = (self.clone(), Arc::clone(interrupted));
        let output = output.to_path_buf();
        let watch = move || {
            while !interrupted.load(Ordering::Relaxed) {
                std::thread::sleep(INTERVAL);
            }
            std::thread::sleep(GRACE);
            end.claim();
            fs::remove_dir_all(&output).ok();
            let failure = Failure::Interrupted;
            end_process(stage, &failure.to_string(), i32::from(failure.exit_code()))
        };
        std::thread::Builder::new().name("deadline".to_owned()).spawn(watch)?;
        Ok(())
    }
}
