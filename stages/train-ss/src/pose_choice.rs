use std::path::Path;

use anyhow::Context as _;
use pixels::{Image, psnr_of};
use poses::{PosedPhotograph, photometric_error};
use scene::Camera;

use crate::field_trainer::read;
use crate::member::{Member, TrainingData};
use crate::packed::{PackedPhotograph, PixelMemory};
use crate::photographs::Photographs;
use crate::training_log::TrainingLog;

/// Trains a member. Where poses are to be refined it is trained twice, with refined poses and with
/// the given ones, and the given ones stay unless photographs are met better with the refined.
///
/// Each set of poses needs a field of its own: one that was trained with refined poses has grown
/// around them, however crooked. How well each field renders the photographs that it learnt from
/// doesn't say which is right, either: few photographs are learnt by heart with any poses (17 of 32
/// pixels, poses off by a pixel: 23.7 dB with the given poses and 23.1 dB with refined ones, by
/// which test views gain 2.2 dB). So photographs are compared with their neighbours, brought over
/// by each field's depth: what was learnt by heart has no depth to do that (there 14.5 and 15.2
/// dB). The field that is kept is the one that such a training alone would have given.
pub(crate) fn train(member: &Member<'_>, data: &TrainingData<'_>) -> anyhow::Result<TrainingLog> {
    if !member.params().pose_refinement {
        return member.run(data);
    }
    let weights = member.output();
    let aside = weights.with_extension("refined");
    let refined = member.variant(true, "refined", aside.clone(), 0).run(data)?;
    let mut given =
        member.variant(false, "given", weights.to_path_buf(), refined.rays).run(data)?;
    given.poses = data.views.views.iter().map(|view| view.camera.camera_to_world).collect();
    let judge = Judge::new(member, data)?;
    let (with_refined, with_given) =
        (judge.error(&aside, &refined)?, judge.error(weights, &given)?);
    let [better, worse] = [with_refined, with_given]
        .map(|error| error.map_or_else(|| "?".to_owned(), |e| format!("{:.2}", psnr_of(e))));
    // Where nothing can be compared, nothing speaks for refined poses.
    if with_refined.zip(with_given).is_some_and(|(refined, given)| refined < given) {
        member.context().say(format!(
            "refined poses are kept: photographs meet their neighbours with {better} \
                dB, for {worse} dB"
        ));
        std::fs::rename(&aside, weights).context("cannot keep the field with refined poses")?;
        return Ok(refined);
    }
    std::fs::remove_file(&aside).context("cannot remove the field with refined poses")?;
    given.warnings.push(format!(
        "the given poses stay: photographs meet their neighbours no better with refined poses \
        ({better} dB) than with those ({worse} dB)"
    ));
    Ok(given)
}

/// Photographs, by which poses are judged.
struct Judge<'a> {
    member: &'a Member<'a>,
    data: &'a TrainingData<'a>,
    photographs: Vec<Image>,
    background: f32,
}

impl<'a> Judge<'a> {
    fn new(member: &'a Member<'a>, data: &'a TrainingData<'a>) -> anyhow::Result<Self> {
        let photographs = Photographs::read(data.input, usize::MAX, &mut PixelMemory::unlimited())?
            .over_background();
        let background = photographs.views.background.shown();
        Ok(Self {
            member,
            data,
            photographs: photographs.images.iter().map(PackedPhotograph::known).collect(),
            background,
        })
    }

    /// How far photographs are from their neighbours by what a training found; none where there is
    /// nothing to compare.
    fn error(&self, weights: &Path, log: &TrainingLog) -> anyhow::Result<Option<f64>> {
        let field = read(
            self.member.model(),
            self.data.views.bounds,
            weights,
            &self.member.context().device,
        )?;
        let cameras: Vec<Camera> = (self.data.views.views.iter().zip(&log.poses))
            .map(|(view, pose)| Camera { camera_to_world: *pose, ..view.camera.clone() })
            .collect();
        let exposure =
            |i: usize| log.exposures.get(i).map_or([1.0; 3], |exposure| exposure.map(f32::recip));
        let shots = cameras.iter().zip(&self.photographs).enumerate();
        let shots: Vec<PosedPhotograph<'_>> = shots
            .map(|(i, (camera, photograph))| PosedPhotograph {
                camera,
                photograph,
                exposure: exposure(i),
            })
            .collect();
        photometric_error(&*field, &shots, self.background).map_err(fields::rendering_failure)
    }
}
