use artifact::{Context, FailureExt as _, GivenInput};
use paper_refiner::{OVERLAP, PaperRefiner, PaperTrainer, PaperTraining, PerceptualLoss};
use pixels::psnr_of;
use refinement::{Network, REFINER_FILE, RefinerFile, WEIGHTS_FILE};

use crate::{PaperParams, examples, say, train};

/// Files with VGG-19's weights: all of them as torchvision names them, or the first blocks in
/// Caffe's scaling.
const VGG: [&str; 2] = ["vgg19.safetensors", "vgg19_conv1to3_oihw.safetensors"];

/// Trains the published network. It learns from all views there are, as published: from one.
pub(crate) fn run(context: &Context, params: &PaperParams, seed: u64) -> anyhow::Result<()> {
    let (mut known, left_out) = examples(context.input("views")?, context.input("truth")?, None)?;
    if known.len() > 1 {
        known.extend(left_out);
    }
    let options = PaperTraining {
        steps: params.steps,
        batch: params.batch as usize,
        patch: params.patch_size as usize,
        references: params.patches as usize,
        rate: params.rate,
        seed,
    };
    options.check(&known).bad_input("input truth")?;
    let perceptual = context.optional_input("weights").map(perceptual).transpose()?;
    context.say(match &perceptual {
        Some(loss) => {
            format!("L1 and the perceptual loss of {} of VGG-19's 5 blocks", loss.blocks())
        }
        None => "L1 alone: give input weights for the perceptual loss".to_owned(),
    });
    let width = params.features;
    let network = PaperRefiner::new(width, seed)?;
    let mut trainer = PaperTrainer::new(network, options, perceptual)?;
    train(context, options.steps, &mut trainer, &known, |error| format!("L1 {error:.4}"))?;
    trainer.network().write(&context.output_path(WEIGHTS_FILE)?)?;
    let (mut rendered, mut refined) = (0.0, 0.0);
    let mean = |errors: &mut dyn Iterator<Item = f32>, count: usize| {
        psnr_of(errors.map(|e| f64::from(e).powi(2)).sum::<f64>() / count as f64)
    };
    for view in &known {
        let drawn =
            trainer.network().refine(&view.rendered, &[view], options.references, OVERLAP)?;
        let (truth, own) =
            (&view.truth.data, view.rendered.view.data.chunks_exact(4).flat_map(|p| &p[..3]));
        rendered += mean(&mut own.zip(truth).map(|(a, b)| a - b), truth.len()) / known.len() as f64;
        refined += mean(&mut drawn.data.iter().zip(truth).map(|(a, b)| a - b), truth.len())
            / known.len() as f64;
    }
    let network = Network::Paper { width, patches: params.patches };
    let file = RefinerFile {
        network,
        strength: 1.0,
        rendered_psnr: rendered,
        refined_psnr: refined,
        trusted: None,
        agreeing: false,
    };
    context.write_json(REFINER_FILE, &file)?;
    say(context, "the references that it learnt from", &file)
}

fn perceptual(input: &GivenInput) -> anyhow::Result<PerceptualLoss> {
    let file = VGG.iter().map(|name| input.path(name)).find(|path| path.is_file());
    let file = file.unwrap_or_else(|| input.path(VGG[0]));
    PerceptualLoss::read(&file).bad_input("input weights")
}
