use artifact::GivenInput;
use metrics::{Score, ScoreFormat, Scores};
use pixels::Image;
use stage::Rule;

#[cfg(feature = "torch")]
use super::lpips::Lpips;
use super::lpips_network::LpipsNetwork;
use crate::metric::{Measurement, Metric, value};
use crate::scored_view::{ScoredScene, ScoredView};

/// LPIPS of every network whose weights are given.
pub(crate) struct Perceptual {
    given: Vec<LpipsNetwork>,
    /// Smallest side of a view with HR truth, in pixels.
    min_side: usize,
    #[cfg(feature = "torch")]
    pools: Vec<LpipsPool>,
}

/// Pool of copies of a network, one per thread at a time, since libtorch's tensors can't be shared.
/// A thread that finds the pool empty reads another copy.
#[cfg(feature = "torch")]
struct LpipsPool {
    folder: std::path::PathBuf,
    network: LpipsNetwork,
    free: std::sync::Mutex<Vec<Lpips>>,
}

#[cfg(feature = "torch")]
impl LpipsPool {
    fn new(folder: &std::path::Path, network: LpipsNetwork) -> anyhow::Result<Self> {
        let pool =
            Self { folder: folder.to_path_buf(), network, free: std::sync::Mutex::default() };
        let first = pool.take()?;
        pool.free().push(first);
        Ok(pool)
    }

    fn free(&self) -> std::sync::MutexGuard<'_, Vec<Lpips>> {
        self.free.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn take(&self) -> Result<Lpips, artifact::Failure> {
        use artifact::FailureExt as _;
        let free = self.free().pop();
        free.map_or_else(|| Lpips::read(&self.folder, self.network).bad_input("weights"), Ok)
    }
}

#[cfg(feature = "torch")]
impl Perceptual {
    /// Reads all complete networks of a folder; fails if there is none.
    pub(crate) fn new(weights: Option<&GivenInput>, min_side: usize) -> anyhow::Result<Self> {
        let Some(folder) = weights.map(GivenInput::folder) else {
            return Ok(Self { given: Vec::new(), min_side, pools: Vec::new() });
        };
        let mut given = LpipsNetwork::ALL.to_vec();
        given.retain(|network| network.files().iter().all(|file| folder.join(file).is_file()));
        if given.is_empty() {
            artifact::bail_bad_input!(
                "input weights: {}: no LPIPS network found; {}",
                folder.display(),
                required_files(&LpipsNetwork::ALL)
            );
        }
        let pools = given.iter().map(|network| LpipsPool::new(folder, *network));
        let pools = pools.collect::<anyhow::Result<_>>()?;
        Ok(Self { given, min_side, pools })
    }

    /// Returns the distance by each network for which the images are large enough, in the order of
    /// [`LpipsNetwork::ALL`].
    fn distances(&self, render: &Image, truth: &Image) -> anyhow::Result<[Option<f64>; 3]> {
        let mut distances = [None; 3];
        let side = render.width.min(render.height);
        for pool in self.pools.iter().filter(|pool| side >= pool.network.min_size()) {
            let lpips = pool.take()?;
            distances[pool.network as usize] = Some(lpips.distance(render, truth)?);
            pool.free().push(lpips);
        }
        Ok(distances)
    }
}

#[cfg(not(feature = "torch"))]
#[allow(
    clippy::unused_self,
    clippy::unnecessary_wraps,
    reason = "the same signatures with and without libtorch"
)]
impl Perceptual {
    pub(crate) fn new(weights: Option<&GivenInput>, min_side: usize) -> anyhow::Result<Self> {
        if weights.is_some() {
            artifact::bail_usage!(
                "input weights: LPIPS needs libtorch, and eval was built without it; run \
                `make build`"
            );
        }
        Ok(Self { given: Vec::new(), min_side })
    }

    fn distances(&self, _: &Image, _: &Image) -> anyhow::Result<[Option<f64>; 3]> {
        Ok([None; 3])
    }
}

impl Perceptual {
    /// Returns a log line for each given network that is left out for small views.
    pub(crate) fn notes(&self) -> Vec<String> {
        let too_small = self.given.iter().filter(|network| self.is_too_small(**network));
        let note = |network: &LpipsNetwork| {
            let (name, size) = (network.labels().summary, network.min_size());
            format!(
                "{name} needs views of at least {size}×{size} pixels; smaller views have no score"
            )
        };
        too_small.map(note).collect()
    }

    /// True if a view is too small for a given network.
    fn is_too_small(&self, network: LpipsNetwork) -> bool {
        self.given.contains(&network) && self.min_side < network.min_size()
    }

    /// Returns the text in place of an unknown LPIPS.
    fn missing(&self) -> &'static str {
        if self.is_too_small(LpipsNetwork::Squeeze) { "views too small" } else { MISSING }
    }
}

/// Returns the rule that the folder of weights must contain a complete network.
pub(crate) fn weights_rule() -> Rule {
    let message = format!("no LPIPS network found; {}", required_files(&LpipsNetwork::ALL));
    let rule = Rule::new(&message);
    LpipsNetwork::ALL.iter().fold(rule, |rule, network| rule.or_files("weights", &network.files()))
}

/// Text in place of an LPIPS without weights.
const MISSING: &str = "weights not given";

impl Metric for Perceptual {
    fn name(&self) -> &'static str {
        "lpips"
    }

    fn figures(&self) -> Vec<ScoreFormat> {
        let mut figures = LpipsNetwork::ALL
            .map(LpipsNetwork::labels)
            .map(|labels| ScoreFormat::new(labels.key, labels.table, 4, false))
            .to_vec();
        figures[0].missing = Some(self.missing().to_owned());
        figures
    }

    fn convention(&self, _: &ScoredScene<'_>) -> String {
        let mut lacking = LpipsNetwork::ALL.to_vec();
        lacking.retain(|network| !self.given.contains(network));
        if self.given.is_empty() {
            return format!("{MISSING}: {}", required_files(&lacking));
        }
        let given: Vec<&str> =
            self.given.iter().map(|network| network.labels().convention).collect();
        let mut text = format!("v0.1, inputs in [-1, 1], by {}", given.join(", "));
        if !lacking.is_empty() {
            text += &format!("; {MISSING} for others: {}", required_files(&lacking));
        }
        text
    }

    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measurement> {
        let mut measurement = Measurement::default();
        let Some(truth) = &view.truth else { return Ok(measurement) };
        for (i, distance) in self.distances(&view.render, truth)?.into_iter().enumerate() {
            if let Some(distance) = distance {
                let key = LpipsNetwork::ALL[i].labels().key;
                measurement.scores.insert(key.to_owned(), Score::One(distance));
            }
        }
        Ok(measurement)
    }

    fn summary(&self, mean: &Scores) -> Option<String> {
        value(mean, "psnr")?;
        let labels = LpipsNetwork::ALL.map(LpipsNetwork::labels).into_iter();
        let known: Vec<String> = labels
            .filter_map(|own| Some(format!("{} {:.4}", own.summary, value(mean, own.key)?)))
            .collect();
        Some(if known.is_empty() {
            format!("LPIPS {}", self.missing())
        } else {
            known.join(" · ")
        })
    }
}

/// Describes the files that networks need.
fn required_files(networks: &[LpipsNetwork]) -> String {
    let pairs: Vec<String> = networks
        .iter()
        .map(|network| network.files())
        .map(|[weights, heads]| format!("{weights} and {heads}"))
        .collect();
    format!(
        "-i eval.weights=FOLDER needs a folder with one of these pairs of files: {} \
        (torchvision's and richzhang/PerceptualSimilarity's, as safetensors)",
        pairs.join("; ")
    )
}

#[cfg(all(test, feature = "torch"))]
mod tests {
    use super::*;

    /// A network that needs larger views isn't applied: here, its weights don't even exist.
    #[test]
    fn small_views_have_no_distance() {
        let given = vec![LpipsNetwork::Squeeze, LpipsNetwork::Alex];
        let pool = |&network: &LpipsNetwork| LpipsPool {
            folder: "nowhere".into(),
            network,
            free: std::sync::Mutex::default(),
        };
        for (side, note_count, missing) in
            [(16, 2, "views too small"), (17, 1, MISSING), (31, 0, MISSING)]
        {
            let pools = given.iter().map(pool).collect();
            let perceptual = Perceptual { given: given.clone(), min_side: side, pools };
            let image = Image::new(side, 40, 3, vec![0.5; side * 40 * 3]);
            assert_eq!(perceptual.distances(&image, &image).is_ok(), side == 16, "{side}");
            assert_eq!(perceptual.notes().len(), note_count, "{side}");
            assert_eq!(perceptual.figures()[0].missing.as_deref(), Some(missing), "{side}");
        }
        let message = "LPIPS (AlexNet) needs views of at least 31×31 pixels; smaller views have no \
            score";
        let perceptual = Perceptual { given, min_side: 20, pools: Vec::new() };
        assert_eq!(perceptual.notes(), [message]);
    }
}
