use artifact::{Failure, FailureExt as _, GivenInput};
use refinement::paper::{PaperRefiner, PaperTrainer, PerceptualLoss};
use refinement::{Network, RefinerFile, TrainingOptions, WEIGHTS_FILE};
use serde_json::json;
use stage::{Context, Rule};

use crate::examples::read_examples;
use crate::params::PaperParams;
use crate::steps::{ExampleTraining, training_failure};
use crate::write_refiner_file;

/// File names of VGG-19's weights: all layers with torchvision's names, or the first blocks in
/// Caffe's scaling.
const VGG_FILES: [&str; 2] = ["vgg19.safetensors", "vgg19_conv1to3_oihw.safetensors"];

/// Trains the published network on all given views; the publication uses one.
pub(crate) fn run(context: &Context, params: &PaperParams, seed: u64) -> anyhow::Result<()> {
    let known = read_examples(context.input("views")?, context.input("truth")?, None)?;
    let options = TrainingOptions {
        steps: params.steps,
        batch_size: params.batch_size as usize,
        patch_size: params.patch_size as usize,
        references: params.patches as usize,
        learning_rate: params.learning_rate,
        seed,
    };
    PaperTrainer::check(&options, &known).bad_input("cannot train on input truth")?;
    let perceptual = context.optional_input("weights").map(read_perceptual_loss).transpose()?;
    context.log_line(match &perceptual {
        Some(loss) => {
            format!("loss: L1 and perceptual, by {} of VGG-19's 5 blocks", loss.blocks())
        }
        None => "loss: L1 alone; give input weights for the perceptual loss".to_owned(),
    });
    let width = params.features;
    let network = PaperRefiner::new(width, seed)?;
    let trainer = PaperTrainer::new(network, options, perceptual)?;
    let mut training = ExampleTraining { trainer, examples: &known };
    context
        .train(options.steps, &mut training, |loss| format!("L1 of training patches {loss:.4}"))?;
    let trainer = training.trainer;
    trainer.network().write(&context.output_path(WEIGHTS_FILE)?).map_err(training_failure)?;
    let (mut rendered, mut refined) = (0.0, 0.0);
    let share = 1.0 / known.len() as f64;
    for view in &known {
        let redrawn = trainer.network().refine(&view.rendered, &[view], options.references)?;
        rendered += share * view.psnr(&view.rendered.colours());
        refined += share * view.psnr(&redrawn);
    }
    let file = RefinerFile {
        network: Network::Paper { width, patches: params.patches },
        residual_weight: 1.0,
        rendered_psnr: rendered,
        refined_psnr: refined,
        confidence: None,
        data_consistent: false,
    };
    write_refiner_file(context, "training references", &file)
}

/// Returns the rule that the folder of weights must contain VGG-19.
pub(crate) fn weights_rule() -> Rule {
    let rule = Rule::new(&format!("no file {}", VGG_FILES.join(" or ")));
    let rule = rule.when("net", json!({"const": "paper"}));
    VGG_FILES.iter().fold(rule, |rule, file| rule.or_files("weights", &[file]))
}

/// Reads the first existing file of VGG-19's weights.
fn read_perceptual_loss(input: &GivenInput) -> Result<PerceptualLoss, Failure> {
    let file = VGG_FILES.iter().map(|name| input.path(name)).find(|path| path.is_file());
    let file = file.unwrap_or_else(|| input.path(VGG_FILES[0]));
    PerceptualLoss::read(&file).bad_input("input weights")
}
