use artifact::{bail_bad_input, bail_usage};
use pixels::psnr_of;
use refinement::{
    Refiner, RefinerArchitecture, RefinerTrainer, TrainingOptions, WEIGHTS_FILE, WarpOptions,
};
use stage::Context;

use crate::examples::{leave_out, lr_photographs, read_examples};
use crate::params::CompactParams;
use crate::steps::{ExampleTraining, training_failure};
use crate::write_refiner_file;

/// Trains our network by internal learning.
pub(crate) fn run(context: &Context, net: &CompactParams, seed: u64) -> anyhow::Result<()> {
    if net.patch_size % 2 == 1 {
        bail_usage!("parameter patch_size: expected an even number, found {}", net.patch_size);
    }
    let photographs = lr_photographs(context)?;
    let (views, truth) = (context.input("views")?, context.input("truth")?);
    let all = read_examples(views, truth, photographs.as_ref())?;
    let (examples, left_out) = leave_out(all);
    if net.references_per_view > 0 && examples.len() < 2 {
        bail_bad_input!(
            "input views: references_per_view needs at least three views with an image in input \
            truth"
        );
    }
    let architecture = RefinerArchitecture {
        channels: net.features,
        blocks: net.blocks,
        guidance: (net.references_per_view > 0).then_some(WarpOptions::default()),
    };
    let refiner = Refiner::new(architecture, seed);
    let options = TrainingOptions {
        steps: net.steps,
        batch_size: net.batch_size as usize,
        patch_size: net.patch_size as usize,
        references: net.references_per_view as usize,
        learning_rate: net.learning_rate,
        seed,
    };
    let trainer = RefinerTrainer::new(refiner, options);
    let mut training = ExampleTraining { trainer, examples: &examples };
    context.train(options.steps, &mut training, |loss| {
        format!("PSNR of training patches {:.2} dB", psnr_of(loss))
    })?;
    let trainer = training.trainer;
    let file = trainer.score(&left_out, &examples, photographs.is_some())?;
    trainer.refiner().write(&context.output_path(WEIGHTS_FILE)?).map_err(training_failure)?;
    write_refiner_file(context, "views left out of training", &file)
}
