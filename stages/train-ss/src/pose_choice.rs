use anyhow::Context as _;

use crate::member::Member;
use crate::{TrainingData, TrainingLog};

/// Share of a training over whose end the photographs' error is taken: cameras have stopped moving long before.
const LAST: f64 = 0.1;

/// Trains a member. Where poses are to be refined it is trained twice, with the given poses and with refined ones, and the given ones stay unless
/// photographs are met better with the refined.
///
/// No single field can say which poses are better: one that was trained with refined poses meets photographs better from those, even where
/// it has grown crooked around them. So each set of poses is judged by a field of its own. Both trainings draw the same pixels, cast as many rays and
/// have the same schedule, so that their errors over the last tenth of the rays, training's own loss, are of the same pixels and differ by the poses
/// alone. That costs a second training, but the field that is kept is then as good as without pose refinement, where that does harm.
pub(crate) fn train(member: &Member<'_>, data: &TrainingData<'_>) -> anyhow::Result<TrainingLog> {
    if !member.params().pose_refinement {
        return member.run(data);
    }
    let weights = member.output();
    let aside = weights.with_extension("refined");
    let refined = member.variant(true, "refined", aside.clone(), 0).run(data)?;
    let mut given = member.variant(false, "given", weights.to_path_buf(), refined.rays).run(data)?;
    let errors = [&given, &refined].map(last_error);
    if errors[1] < errors[0] {
        std::fs::rename(&aside, weights).context("cannot keep the field with refined poses")?;
        return Ok(refined);
    }
    std::fs::remove_file(&aside).context("cannot remove the field with refined poses")?;
    let [with_given, with_refined] = errors.map(pixels::psnr_of);
    given.poses = data.views.views.iter().map(|view| view.camera.camera_to_world).collect();
    given.warnings.push(format!(
        "the given poses stay: photographs are met no better with refined ones ({with_refined:.2} dB) than with those ({with_given:.2} dB)"
    ));
    Ok(given)
}

/// Mean squared error of training pixels over the end of a training; not a number where nothing is known of it, which is never smaller.
fn last_error(log: &TrainingLog) -> f64 {
    let since = ((1.0 - LAST) * log.rays as f64) as u64;
    let last: Vec<f64> = log.curve.iter().filter(|p| p.rays > since).map(|p| 10f64.powf(-0.1 * p.psnr)).collect();
    if last.is_empty() { f64::NAN } else { last.iter().sum::<f64>() / last.len() as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CurvePoint;

    #[test]
    fn the_error_is_that_of_the_end() {
        let point = |rays: u64, psnr: f64| CurvePoint { rays, psnr };
        let curve = vec![point(100, 10.0), point(900, 12.0), point(950, 20.0), point(1000, 30.0)];
        let log = TrainingLog { rays: 1000, curve, ..TrainingLog::default() };
        assert!((last_error(&log) - 0.5 * (0.01 + 0.001)).abs() < 1e-12);
        assert!(last_error(&TrainingLog::default()).is_nan());
    }
}
