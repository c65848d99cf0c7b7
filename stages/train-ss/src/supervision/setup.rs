use std::path::Path;

use anyhow::Context as _;
use artifact::{Failure, GivenInput};
use pixels::{DEGRADATION_FILE, Degradation, Kernel};
use scene::{Background, Views};
use stage::available_memory;

use super::Supersampling;
use super::memory::{memory_text, pixel_memory, training_memory};
use super::options::SupersamplingOptions;
use crate::params::{Exposure, Resolved, Supervision};
use crate::photographs::{NO_SPACE, PackedPhotograph, Photographs, check_references};

/// Returns the error message for a parameter that conflicts with background `alpha`.
pub(crate) fn alpha_background_error(parameter: &str) -> String {
    let problem = match parameter {
        "supervision" => {
            "kernel cannot be used with prep.background alpha; choose average, or a \
            prep.background other than alpha"
        }
        "exposure" => {
            "exposure cannot be estimated with prep.background alpha; choose a prep.background \
            other than alpha"
        }
        _ => {
            "with prep.background alpha, renders cannot be compared with photographs; choose a \
            prep.background other than alpha"
        }
    };
    format!("parameter {parameter}: {problem}")
}

/// Reads and checks photographs and references, and sets up the supervision of training. Pixels
/// beyond the memory budget go into a file in `folder`. `log` reports the memory need, and
/// references that are corrected or dropped.
pub fn set_up_supervision(
    scene: &GivenInput,
    params: &Resolved,
    references_input: Option<&GivenInput>,
    folder: &Path,
    has_checkpoints: bool,
    log: &dyn Fn(String),
) -> anyhow::Result<Supersampling> {
    let views = Views::read(scene)?;
    let mut reference_views = Vec::new();
    if let Some(references) = references_input.map(Views::read).transpose()? {
        if references.background != views.background {
            let message = "input references: the background differs from the scene's; create both \
                in one run of prep";
            return Err(Failure::BadInput(message.to_owned()).into());
        }
        reference_views = references.views;
        reference_views.truncate(params.max_references);
    }
    let kernel = kernel(scene, params, views.background)?;
    let options = SupersamplingOptions { params: params.clone(), filter: kernel.filter() };
    let need = training_memory(&options, &views, &reference_views, has_checkpoints);
    let mut memory = pixel_memory(&need, available_memory()?, folder.to_path_buf())?;
    log(memory_text(&need, memory.left()));
    let photographs = Photographs::read(scene, usize::MAX, &mut memory)?;
    if !photographs.images.iter().any(PackedPhotograph::has_unmasked_pixels) {
        let message = "scene: masks exclude every pixel of every photograph; a mask's black pixels \
            are excluded, so check whether the masks are inverted";
        return Err(Failure::BadInput(message.to_owned()).into());
    }
    let reference_photographs = match references_input {
        Some(input) => {
            let given = Photographs::read(input, params.max_references, &mut memory)?;
            let checked = check_references(given, &photographs, kernel, &mut memory, log)?;
            Some(checked.over_background())
        }
        None => None,
    };
    Supersampling::new(photographs.over_background(), reference_photographs, &options, memory)
        .context(NO_SPACE)
}

/// Returns the kernel of the LR images. If the scene states none, only references are compared by
/// the kernel: by Lanczos, `prep`'s default for downscaled images. Fails if parameters require a
/// kernel or a background that the scene lacks.
fn kernel(scene: &GivenInput, params: &Resolved, background: Background) -> anyhow::Result<Kernel> {
    let needs_kernel = params.supervision == Supervision::Kernel;
    let degradation: Option<Degradation> = scene.read_optional_json(DEGRADATION_FILE)?;
    if needs_kernel && degradation.is_none() {
        let message = format!(
            "parameter supervision: kernel needs {DEGRADATION_FILE} in the scene, which states \
            the kernel of the LR images; choose average"
        );
        return Err(Failure::Usage(message).into());
    }
    let enabled = [
        ("supervision", needs_kernel),
        ("pose_refinement", params.pose_refinement),
        ("exposure", params.exposure == Exposure::On),
    ];
    if background == Background::Alpha
        && let Some((parameter, _)) = enabled.iter().find(|(_, is_enabled)| *is_enabled)
    {
        return Err(Failure::Usage(alpha_background_error(parameter)).into());
    }
    Ok(degradation.map_or(Kernel::Lanczos, |degradation| degradation.kernel))
}
