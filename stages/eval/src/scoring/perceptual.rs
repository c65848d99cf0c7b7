use artifact::{Failure, GivenInput};
use metrics::{Figure, Score, Scores};
use pixels::Image;

#[cfg(feature = "torch")]
use super::lpips::Lpips;
use super::lpips_network::LpipsNetwork;
use crate::metric::{Measured, Metric, value};
use crate::scored_view::{ScoredScene, ScoredView};

/// LPIPS by every network whose weights are given.
pub(crate) struct Perceptual {
    given: Vec<LpipsNetwork>,
    #[cfg(feature = "torch")]
    readers: Vec<LpipsPool>,
}

/// A network's files, and copies of it that are free; a thread that finds none reads another, since
/// libtorch's tensors can't be shared.
#[cfg(feature = "torch")]
struct LpipsPool {
    folder: std::path::PathBuf,
    network: LpipsNetwork,
    free: std::sync::Mutex<Vec<Lpips>>,
}

#[cfg(feature = "torch")]
impl LpipsPool {
    fn new(folder: &std::path::Path, network: LpipsNetwork) -> anyhow::Result<Self> {
        let reader =
            Self { folder: folder.to_path_buf(), network, free: std::sync::Mutex::default() };
        reader.keep(reader.take()?);
        Ok(reader)
    }

    fn pool(&self) -> std::sync::MutexGuard<'_, Vec<Lpips>> {
        self.free.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn take(&self) -> Result<Lpips, Failure> {
        use artifact::FailureExt as _;
        let free = self.pool().pop();
        free.map_or_else(|| Lpips::read(&self.folder, self.network).bad_input("weights"), Ok)
    }

    fn keep(&self, lpips: Lpips) {
        self.pool().push(lpips);
    }
}

#[cfg(feature = "torch")]
impl Perceptual {
    /// Those of a folder. One that has no whole network is refused.
    pub(crate) fn new(weights: Option<&GivenInput>) -> anyhow::Result<Self> {
        let Some(folder) = weights.map(GivenInput::folder) else {
            return Ok(Self { given: Vec::new(), readers: Vec::new() });
        };
        let is_there =
            |network: &LpipsNetwork| network.files().iter().all(|file| folder.join(file).is_file());
        let given: Vec<LpipsNetwork> = LpipsNetwork::ALL.into_iter().filter(is_there).collect();
        if given.is_empty() {
            let message = format!(
                "input weights: {}: no network is there; {}",
                folder.display(),
                wanted(&LpipsNetwork::ALL)
            );
            return Err(Failure::BadInput(message).into());
        }
        let readers = given
            .iter()
            .map(|&network| LpipsPool::new(folder, network))
            .collect::<anyhow::Result<_>>()?;
        Ok(Self { given, readers })
    }

    /// Distances by each network, in the order of [`LpipsNetwork::ALL`].
    fn distances(&self, found: &Image, expected: &Image) -> anyhow::Result<[Option<f64>; 3]> {
        let mut distances = [None; 3];
        for reader in &self.readers {
            let lpips = reader.take()?;
            distances[reader.network as usize] = Some(lpips.distance(found, expected)?);
            reader.keep(lpips);
        }
        Ok(distances)
    }
}

#[cfg(not(feature = "torch"))]
#[allow(
    clippy::unused_self,
    clippy::unnecessary_wraps,
    reason = "the same face with and without libtorch"
)]
impl Perceptual {
    pub(crate) fn new(weights: Option<&GivenInput>) -> anyhow::Result<Self> {
        if weights.is_some() {
            let message = "input weights: LPIPS needs libtorch, and eval was built without it; run \
                `make build`";
            return Err(Failure::Usage(message.to_owned()).into());
        }
        Ok(Self { given: Vec::new() })
    }

    fn distances(&self, _: &Image, _: &Image) -> anyhow::Result<[Option<f64>; 3]> {
        Ok([None; 3])
    }
}

/// What stands where LPIPS would.
const MISSING: &str = "weights not given";

impl Metric for Perceptual {
    fn name(&self) -> &'static str {
        "lpips"
    }

    fn figures(&self) -> Vec<Figure> {
        let of = |network: LpipsNetwork| Figure::new(network.key(), network.label(), 4, false);
        let mut figures = LpipsNetwork::ALL.map(of).to_vec();
        figures[0].missing = Some(MISSING.to_owned());
        figures
    }

    /// Which networks there are, and what is lacking for the others.
    fn convention(&self, _: &ScoredScene<'_>) -> String {
        let lacking: Vec<LpipsNetwork> =
            LpipsNetwork::ALL.into_iter().filter(|network| !self.given.contains(network)).collect();
        if self.given.is_empty() {
            return format!("{MISSING}: {}", wanted(&lacking));
        }
        let by: Vec<&str> = self.given.iter().map(|network| network.title()).collect();
        let missing = if lacking.is_empty() {
            String::new()
        } else {
            format!("; {MISSING} for others: {}", wanted(&lacking))
        };
        format!("v0.1, inputs in [-1, 1], by {}{missing}", by.join(", "))
    }

    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measured> {
        let Some(expected) = &view.expected else { return Ok(Measured::default()) };
        let distances = self.distances(&view.found, expected)?;
        let known = LpipsNetwork::ALL.into_iter().zip(distances);
        let known = known.filter_map(|(network, distance)| {
            Some((network.key().to_owned(), Score::One(distance?)))
        });
        Ok(Measured { scores: known.collect(), picture: None })
    }

    fn in_words(&self, mean: &Scores) -> Option<String> {
        value(mean, "psnr")?;
        let known: Vec<String> = LpipsNetwork::ALL
            .iter()
            .filter_map(|network| {
                Some(format!("{} {:.4}", network.short(), value(mean, network.key())?))
            })
            .collect();
        Some(if known.is_empty() { format!("LPIPS {MISSING}") } else { known.join(" · ") })
    }
}

/// The files that would be needed.
fn wanted(networks: &[LpipsNetwork]) -> String {
    let pairs = networks.iter().map(|network| {
        let [net, heads] = network.files();
        format!("{net} with {heads}")
    });
    let pairs: Vec<String> = pairs.collect();
    format!(
        "-i eval.weights=FOLDER with {} (torchvision's and richzhang/PerceptualSimilarity's, as \
        safetensors)",
        pairs.join(", or ")
    )
}
