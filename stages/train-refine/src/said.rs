use refinement::RefinerFile;
use stage::Context;

/// What training brought to some views.
pub(crate) fn say(context: &Context, views: &str, file: &RefinerFile) -> anyhow::Result<()> {
    let RefinerFile { rendered_psnr, refined_psnr, residual_weight, .. } = file;
    let summary = format!(
        "{views}: {rendered_psnr:.2} dB rendered, {refined_psnr:.2} dB refined (residual weight \
        {residual_weight:.2})"
    );
    context.say(&summary);
    context.write_summary(&summary)
}
