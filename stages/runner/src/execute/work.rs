use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;

use planning::Plan;
use store::RunFile;

use crate::session::Session;

/// Carries out plans.
pub(crate) trait Executor {
    /// Makes what isn't there and shows it, or sees to it that this is done; the run's exit code.
    fn carry_out(&self, work: &Work<'_>) -> anyhow::Result<ExitCode>;
}

/// What is to be carried out.
pub(crate) struct Work<'a> {
    pub(crate) session: &'a Session,
    pub(crate) plan: &'a Plan,
    /// Where it stands what the run needs.
    pub(crate) run: &'a RunFile,
    /// Where pages go.
    pub(crate) out: &'a Path,
    pub(crate) stop: &'a AtomicBool,
}
