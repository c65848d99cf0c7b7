use std::path::Path;

use anyhow::Context as _;
use artifact::{Failure, GivenInput};
use pixels::{DEGRADATION_FILE, Degradation, Kernel};
use scene::{Background, Views};
use stage::available_memory;

use crate::memory::MemoryNeed;
use crate::packed::PackedPhotograph;
use crate::photographs::{NO_PLACE, Photographs};
use crate::references;
use crate::resolve::Resolved;
use crate::supersampling_options::SupersamplingOptions;
use crate::supervision::{Supersampling, Supervision};

/// What to say to a parameter that an open background leaves no meaning.
pub(crate) fn open_background(parameter: &str) -> String {
    let problem = match parameter {
        "supervision" => {
            "kernel needs a background to render on; choose average, or prep.background white"
        }
        "exposure" => {
            "what shines through an open background has none; choose prep.background white or \
            opaque"
        }
        _ => {
            "photographs with an open background can't be compared with renderings; choose \
            prep.background white or opaque"
        }
    };
    format!("parameter {parameter}: {problem}")
}

/// What the field is compared with, by the parameters and by what the input says of its own making.
/// The memory for it is said; where pixels need more, they go into a file in `folder`.
/// `has_checkpoints` says whether the training writes any. What is wrong with a reference is said.
pub fn supervision(
    input: &GivenInput,
    params: &Resolved,
    references: Option<&GivenInput>,
    folder: &Path,
    has_checkpoints: bool,
    say: &dyn Fn(String),
) -> anyhow::Result<Supersampling> {
    let views = Views::read(input)?;
    let hr_views = references.map(Views::read).transpose()?;
    if hr_views.as_ref().is_some_and(|references| references.background != views.background) {
        let message =
            "input references: another background than the scene's; have one prep make both";
        return Err(Failure::BadInput(message.to_owned()).into());
    }
    let kernel = kernel(input, params, views.background)?;
    let options = SupersamplingOptions {
        supervision: params.supervision,
        scale: [params.supersample; 2],
        filter: kernel.filter(),
        supersample_warmup: params.supersample_warmup,
        order: params.order,
        precrop_bundles: params.precrop_bundles(),
        pixel_importance: params.pixel_importance,
        exposure: params.exposure,
        pose_refinement: params.pose_refinement,
        seed: params.seed,
    };
    let hr_views = hr_views
        .map_or(Vec::new(), |views| views.views.into_iter().take(params.max_references).collect());
    let need = MemoryNeed::of(params, &options, &views, &hr_views, has_checkpoints);
    let mut memory = need.plan(available_memory()?, folder.to_path_buf())?;
    say(need.in_words(memory.left()));
    let photographs = Photographs::read(input, usize::MAX, &mut memory)?;
    if !photographs.images.iter().any(PackedPhotograph::is_known) {
        return Err(Failure::BadInput(
            "scene: masks leave no pixel of any photograph; white is what counts".to_owned(),
        )
        .into());
    }
    let references = references
        .map(|input| Photographs::read(input, params.max_references, &mut memory))
        .transpose()?;
    let references = match references {
        Some(references) => {
            Some(references::checked(references, &photographs, kernel, &mut memory, say)?)
        }
        None => None,
    };
    let (photographs, references) =
        (photographs.over_background(), references.map(Photographs::over_background));
    Supersampling::new(photographs, references, &options, memory).context(NO_PLACE)
}

/// The kernel that made LR images, where parameters and background allow what they ask for.
fn kernel(input: &GivenInput, params: &Resolved, background: Background) -> anyhow::Result<Kernel> {
    let is_kernel = params.supervision == Supervision::Kernel;
    let known = input.path(DEGRADATION_FILE).exists();
    let made: Option<Degradation> =
        if known { Some(input.read_json(DEGRADATION_FILE)?) } else { None };
    if is_kernel && made.is_none() {
        let message = format!(
            "parameter supervision: the scene has no {DEGRADATION_FILE} that names its kernel; \
            choose average"
        );
        return Err(Failure::Usage(message).into());
    }
    let closed = [
        ("supervision", is_kernel),
        ("pose_refinement", params.pose_refinement),
        ("exposure", params.exposure),
    ];
    let is_open = background == Background::Alpha;
    if let Some((parameter, _)) = closed.iter().find(|(_, asked)| is_open && *asked) {
        return Err(Failure::Usage(open_background(parameter)).into());
    }
    Ok(made.map_or(Kernel::Lanczos, |made| made.kernel))
}
