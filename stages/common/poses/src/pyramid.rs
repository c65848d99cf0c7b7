use pixels::{Filter, Image, Resampling};

/// A photograph at several sizes.
#[derive(Clone, Debug)]
pub struct Pyramid {
    pub(crate) levels: Vec<PyramidLevel>,
}

#[derive(Clone, Debug)]
pub(crate) struct PyramidLevel {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) telling: Vec<Telling>,
}

/// A pixel that says where it was taken from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Telling {
    pub(crate) x: usize,
    pub(crate) y: usize,
    pub(crate) colour: [f32; 3],
    /// Change of each channel a pixel to the right, and a pixel down.
    pub(crate) gradient: [[f32; 2]; 3],
}

impl Telling {
    /// Its centre in the image.
    pub(crate) fn centre(&self) -> [f64; 2] {
        [self.x as f64 + 0.5, self.y as f64 + 0.5]
    }
}

/// Smaller levels have too little to go by.
const LEAST_LEVEL_SIDE: usize = 12;
/// At most so many pixels of a level are rendered, spread over all that tell something.
const MOST_PIXELS: usize = 4096;
/// A pixel tells something where a channel changes by more, from a pixel to the next.
const LEAST_SLOPE: f32 = 3.0 / 255.0;

impl Pyramid {
    /// Of an RGB image over its background; NaN where nothing is known. Each level has half the
    /// width of the one before it; there are at most `smaller` below the image itself.
    ///
    /// # Panics
    /// When the image has other than three channels.
    pub fn new(photograph: &Image, smaller: u32) -> Self {
        assert_eq!(photograph.channels, 3, "a photograph over its background");
        let size =
            |level: u32| [photograph.width, photograph.height].map(|n| n.div_ceil(1 << level));
        let is_large =
            |level: &u32| *level == 0 || size(*level).into_iter().all(|n| n >= LEAST_LEVEL_SIDE);
        let levels = (0..=smaller).take_while(is_large).map(|level| {
            let [width, height] = size(level);
            let shrink = Resampling::new(
                Filter::Box,
                (photograph.width, photograph.height),
                (width, height),
            );
            PyramidLevel::new(&shrink.apply(photograph))
        });
        Self { levels: levels.collect() }
    }

    /// How many levels lie below the image itself.
    pub fn smaller(&self) -> u32 {
        self.levels.len() as u32 - 1
    }
}

impl PyramidLevel {
    pub(crate) fn new(image: &Image) -> Self {
        let (width, height) = (image.width, image.height);
        let inner = |n: usize| 1..n.saturating_sub(1);
        let all: Vec<Telling> = inner(height)
            .flat_map(|y| inner(width).map(move |x| (x, y)))
            .filter_map(|(x, y)| telling(image, x, y))
            .collect();
        let every = all.len().div_ceil(MOST_PIXELS).max(1);
        Self { width, height, telling: all.into_iter().step_by(every).collect() }
    }
}

/// A pixel within the border, where it tells something.
fn telling(image: &Image, x: usize, y: usize) -> Option<Telling> {
    let colour = |x: usize, y: usize| [0, 1, 2].map(|c| image.data[(y * image.width + x) * 3 + c]);
    let [left, right, up, down] =
        [colour(x - 1, y), colour(x + 1, y), colour(x, y - 1), colour(x, y + 1)];
    let gradient = [0, 1, 2].map(|c| [0.5 * (right[c] - left[c]), 0.5 * (down[c] - up[c])]);
    let pixel = Telling { x, y, colour: colour(x, y), gradient };
    let numbers = gradient.as_flattened();
    let is_known = numbers.iter().chain(&pixel.colour).all(|v| v.is_finite());
    (is_known && numbers.iter().any(|g| g.abs() > LEAST_SLOPE)).then_some(pixel)
}
