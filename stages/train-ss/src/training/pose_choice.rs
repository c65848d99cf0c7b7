use std::path::Path;

use anyhow::Context as _;
use fields::{FieldModel, read_field};
use pixels::{Image, psnr_of};
use poses::{PosedPhotograph, photometric_error};
use radiance::TrainingLog;
use scene::Camera;

use super::member::{Member, TrainingData};
use crate::photographs::{PackedPhotograph, Photographs, PixelMemory};

/// Trains a member. With pose refinement, trains it twice, with refined and with given poses, and
/// keeps the given ones unless photographs fit better with the refined ones.
///
/// Each set of poses needs a field of its own, because a field trained with refined poses adapts to
/// these poses, however wrong. The training PSNR can't decide, because a field over-fits few
/// photographs with any poses. For example, with 17 photographs of 32 pixels and poses off by a
/// pixel, the training PSNR is 23.7 dB with given and 23.1 dB with refined poses, although refined
/// poses gain 2.2 dB in test views.
///
/// Photographs are therefore compared with their neighbours, warped by each field's depth:
/// over-fitting doesn't improve depth (14.5 dB with given and 15.2 dB with refined poses in the
/// example). The result equals that of a single training run with the chosen poses.
pub(crate) fn train_with_best_poses(
    member: &Member<'_>,
    data: &TrainingData<'_>,
) -> anyhow::Result<TrainingLog> {
    if !member.params.pose_refinement {
        return member.run(data);
    }
    let weights = &member.output;
    let refined_weights = weights.with_extension("refined");
    let refined = member.variant(true, "refined", refined_weights.clone(), 0).run(data)?;
    let mut given = member.variant(false, "given", weights.clone(), refined.rays).run(data)?;
    given.poses = data.views.views.iter().map(|view| view.camera.camera_to_world).collect();
    let photographs = Photographs::read(data.input, usize::MAX, &mut PixelMemory::unlimited())?;
    let photographs = photographs.over_background();
    let photographs = photographs.images.iter().map(PackedPhotograph::masked).collect();
    let judge = PoseJudge { member, data, photographs };
    let refined_error = judge.error(&refined_weights, &refined)?;
    let given_error = judge.error(weights, &given)?;
    let [refined_psnr, given_psnr] = [refined_error, given_error].map(|error| {
        error.map_or_else(|| "unknown".to_owned(), |e| format!("{:.2} dB", psnr_of(e)))
    });
    // Without comparable photographs, the given poses are kept.
    if refined_error.zip(given_error).is_some_and(|(refined, given)| refined < given) {
        member.context.log_line(format!(
            "refined poses are used: photographs match their neighbours better ({refined_psnr}) \
            than with the given poses ({given_psnr})"
        ));
        std::fs::rename(&refined_weights, weights)
            .context("cannot rename the field with refined poses")?;
        return Ok(refined);
    }
    std::fs::remove_file(&refined_weights).context("cannot remove the field with refined poses")?;
    given.warnings.push(format!(
        "given poses are used: photographs match their neighbours no better with refined poses \
        ({refined_psnr}) than with the given ones ({given_psnr})"
    ));
    Ok(given)
}

/// Comparison of poses by the photographs.
struct PoseJudge<'a> {
    member: &'a Member<'a>,
    data: &'a TrainingData<'a>,
    /// Photographs over the background.
    photographs: Vec<Image>,
}

impl PoseJudge<'_> {
    /// Returns the mean squared error between photographs and their neighbours, warped by a trained
    /// field's depth; `None` if no pixels are comparable.
    fn error(&self, weights: &Path, log: &TrainingLog) -> anyhow::Result<Option<f64>> {
        let (model, bounds) = (self.member.model, self.data.views.bounds);
        // Grids are compared on the CPU, so that all devices choose the same poses.
        let is_grid = matches!(model, FieldModel::Grid(_));
        let device = if is_grid { "cpu" } else { &self.member.context.device };
        let field = read_field(model, bounds, weights, device)?;
        let cameras: Vec<Camera> = (self.data.views.views.iter().zip(&log.poses))
            .map(|(view, pose)| Camera { camera_to_world: *pose, ..view.camera.clone() })
            .collect();
        let mut posed = Vec::with_capacity(cameras.len());
        for (i, camera) in cameras.iter().enumerate() {
            let exposure = log.exposures.get(i).map_or([1.0; 3], |gain| gain.map(f32::recip));
            posed.push(PosedPhotograph { camera, image: &self.photographs[i], exposure });
        }
        let background = self.data.views.background.grey_level();
        photometric_error(&*field, &posed, background).map_err(fields::rendering_failure)
    }
}
