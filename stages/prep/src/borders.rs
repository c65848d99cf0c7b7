//! What lies behind a scene, by the borders of its images.

use std::fmt::{self, Display, Formatter};

use artifact::{FailureExt as _, WARNING};
use dataset::Frame;
use pixels::Rgba8;
use rayon::prelude::*;
use scene::Background;

use crate::frame_name::frame_name;
use crate::strips::Strips;

/// Views that are looked at, spread evenly: enough to tell nine of ten.
pub(crate) const MOST_VIEWS: usize = 20;
/// Levels by which a flat colour may vary: JPEG's noise beside nothing else. A clear sky varies by
/// more from corner to corner.
const MOST_NOISE_LEVELS: u8 = 8;

/// What lies behind a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Behind {
    /// Images have alpha.
    Transparent,
    /// Borders are one flat colour.
    Flat([u8; 3]),
    /// More of the scene.
    Scene,
}

/// What one image shows behind the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Border {
    /// It has alpha.
    Transparent,
    /// Nine tenths of its border's pixels are like their median.
    Flat([u8; 3]),
    /// Anything else.
    Mixed,
}

impl Border {
    /// Looks at an image.
    pub(crate) fn of(image: &Rgba8) -> Self {
        if image.data.chunks_exact(4).any(|p| p[3] != u8::MAX) {
            return Self::Transparent;
        }
        let (width, height) = (image.width, image.height);
        let rows = (0..width).flat_map(|x| [(x, 0), (x, height - 1)]);
        let columns = (0..height).flat_map(|y| [(0, y), (width - 1, y)]);
        let border: Vec<[u8; 3]> =
            rows.chain(columns).map(|(x, y)| colour(image, y * width + x)).collect();
        let middle = median(&border);
        let alike = border.iter().filter(|colour| is_like(**colour, middle)).count();
        if 10 * alike >= 9 * border.len() { Self::Flat(middle) } else { Self::Mixed }
    }
}

/// What the borders of some images show.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Borders {
    pub(crate) behind: Behind,
    /// Views whose borders are the flat colour, and views looked at.
    flat: usize,
    views: usize,
    strips: Option<CommonStrips>,
}

/// Strips that views have in common.
#[derive(Clone, Debug, PartialEq, Eq)]
struct CommonStrips {
    strips: Strips,
    /// Number of views that have them.
    views: usize,
    /// True if all views' masks leave them out.
    are_masked: bool,
}

impl Borders {
    /// Of all that were looked at. One image with alpha makes all transparent. A flat colour must
    /// be that of nine in ten views.
    pub(crate) fn new(borders: &[Border]) -> Self {
        let views = borders.len();
        if borders.contains(&Border::Transparent) {
            return Self { behind: Behind::Transparent, flat: 0, views, strips: None };
        }
        let colour = |b: &Border| if let Border::Flat(c) = b { Some(*c) } else { None };
        let known: Vec<[u8; 3]> = borders.iter().filter_map(colour).collect();
        let common = median(&known);
        let flat = known.iter().filter(|colour| is_like(**colour, common)).count();
        let behind =
            if views > 0 && 10 * flat >= 9 * views { Behind::Flat(common) } else { Behind::Scene };
        Self { behind, flat, views, strips: None }
    }

    /// Takes in the strips of the views, and whether masks leave these out. A frame of strips is no
    /// background.
    fn with_strips(mut self, views: &[(Option<Strips>, bool)]) -> Self {
        let strips: Vec<Option<Strips>> = views.iter().map(|(strips, _)| *strips).collect();
        let common = Strips::common(&strips).filter(|_| self.behind != Behind::Transparent);
        if let Some((strips, count)) = common {
            let are_masked = views.iter().all(|(strips, is_masked)| strips.is_none() || *is_masked);
            self.strips = Some(CommonStrips { strips, views: count, are_masked });
            if strips.is_frame() {
                self.behind = Behind::Scene;
            }
        }
        self
    }

    /// Returns the signs by which the background is known, a line each, with what to do about
    /// strips.
    pub(crate) fn signs(&self) -> Vec<String> {
        let mut signs = Vec::new();
        let is_frame = self.strips.as_ref().is_some_and(|common| common.strips.is_frame());
        if self.behind != Behind::Transparent && !is_frame {
            signs.push(self.to_string());
        }
        if let Some(CommonStrips { strips, views, are_masked }) = &self.strips {
            let place = format!("{strips} in {views} of {} views looked at", self.views);
            signs.push(if *are_masked {
                format!("{place} are masked out and are not a background")
            } else {
                format!(
                    "{WARNING}{place}, as undistortion and letterboxing leave them, are not a \
                    background: mask them out (masks/NAME.png, mask_path) or crop the photographs"
                )
            });
        }
        signs
    }

    /// What rays see behind everything. A flat colour that is neither white nor black counts as a
    /// wall, a part of the scene.
    pub(crate) fn background(&self) -> Background {
        match self.behind {
            Behind::Transparent => Background::White,
            Behind::Flat(colour) if is_like(colour, [u8::MAX; 3]) => Background::White,
            Behind::Flat(colour) if is_like(colour, [0; 3]) => Background::Black,
            Behind::Flat(_) | Behind::Scene => Background::Opaque,
        }
    }
}

/// In words.
impl Display for Borders {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self { flat, views, .. } = self;
        let of = artifact::counted(*views, "view");
        match self.behind {
            Behind::Transparent => write!(f, "images have alpha"),
            Behind::Flat([r, g, b]) => {
                write!(
                    f,
                    "images have no alpha; borders are one flat colour ({r} {g} {b}) in {flat} of \
                    {of} looked at"
                )
            }
            Behind::Scene => {
                write!(
                    f,
                    "images have no alpha, and borders of one flat colour in {flat} of {of} \
                    looked at: the scene goes on behind"
                )
            }
        }
    }
}

fn colour(image: &Rgba8, pixel: usize) -> [u8; 3] {
    std::array::from_fn(|c| image.data[4 * pixel + c])
}

fn is_like(colour: [u8; 3], other: [u8; 3]) -> bool {
    colour.iter().zip(other).all(|(a, b)| a.abs_diff(b) <= MOST_NOISE_LEVELS)
}

/// The median of each channel; black where there is none.
fn median(colours: &[[u8; 3]]) -> [u8; 3] {
    std::array::from_fn(|c| {
        let mut values: Vec<u8> = colours.iter().map(|colour| colour[c]).collect();
        values.sort_unstable();
        values.get(values.len() / 2).copied().unwrap_or(0)
    })
}

/// Looks at the borders of training views, spread evenly; where the first has alpha, at no other.
/// No more images than threads are held at once.
pub(crate) fn borders(frames: &[&Frame]) -> anyhow::Result<Borders> {
    let count = frames.len().min(MOST_VIEWS);
    if count > 0 && look(frames[0])?.border == Border::Transparent {
        return Ok(Borders::new(&[Border::Transparent]));
    }
    let chosen = (0..count).into_par_iter().map(|i| look(frames[i * frames.len() / count]));
    let views = chosen.collect::<anyhow::Result<Vec<View>>>()?;
    let borders: Vec<Border> = views.iter().map(|view| view.border).collect();
    let strips: Vec<_> = views.iter().map(|view| (view.strips, view.are_masked)).collect();
    Ok(Borders::new(&borders).with_strips(&strips))
}

/// Border of a view's image.
struct View {
    border: Border,
    strips: Option<Strips>,
    /// True if the view's mask leaves the strips out.
    are_masked: bool,
}

fn look(frame: &Frame) -> anyhow::Result<View> {
    let image = frame.photograph().bad_input(frame_name(frame))?;
    let mut border = Border::of(&image);
    // Outside of its circle a fisheye photograph is black, whatever lies behind the scene.
    if matches!(border, Border::Flat(_)) && frame.intrinsics().has_cut_rays() {
        border = Border::Mixed;
    }
    let strips = if border == Border::Transparent { None } else { Strips::of(&image) };
    let mut are_masked = false;
    if let Some(strips) = &strips {
        let mask = frame.mask().bad_input(frame_name(frame))?;
        are_masked = mask.is_some_and(|mask| strips.are_masked(&mask));
    }
    Ok(View { border, strips, are_masked })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture_pixel(border: [u8; 3], noise: u8, touching: usize, at: usize) -> [u8; 4] {
        let (x, y) = (at % 20, at / 20);
        let inside = (5..15).contains(&x) && (3..7).contains(&y) || y == 0 && x < touching;
        let [r, g, b] = if inside {
            [90, 40, 200]
        } else {
            border.map(|v| v.saturating_sub(at as u8 % (noise + 1)))
        };
        [r, g, b, u8::MAX]
    }

    /// A picture of 20×10 pixels: a border of a colour with some noise, and something in the
    /// middle, which may touch the border.
    fn picture(border: [u8; 3], noise: u8, touching: usize) -> Rgba8 {
        Rgba8::new(
            20,
            10,
            (0..200).flat_map(|at| picture_pixel(border, noise, touching, at)).collect(),
        )
    }

    fn of(images: &[Rgba8]) -> Borders {
        Borders::new(&images.iter().map(Border::of).collect::<Vec<_>>())
    }

    #[test]
    fn a_flat_border_is_told_from_a_scene() {
        let views = |image: &Rgba8, count| vec![image.clone(); count];
        let white = of(&views(&picture([255; 3], 6, 4), 3));
        assert_eq!(white.background(), Background::White);
        assert_eq!(
            white.to_string(),
            "images have no alpha; borders are one flat colour (251 251 251) in 3 of 3 views \
            looked at"
        );
        assert_eq!(of(&views(&picture([3; 3], 3, 0), 1)).background(), Background::Black);
        // A tenth of a border may be something else, and a tenth of the views.
        let cut = views(&picture([255; 3], 0, 12), 3);
        assert_eq!(of(&cut).behind, Behind::Scene);
        let mut most = views(&picture([255; 3], 0, 0), 9);
        most.push(picture([120; 3], 60, 0));
        assert_eq!(of(&most).background(), Background::White);
        most.push(picture([120; 3], 60, 0));
        assert_eq!(of(&most).background(), Background::Opaque);
        // Walls: each view has another flat colour, or all the same grey.
        let walls: Vec<Rgba8> = (0..5).map(|i| picture([50 * i; 3], 0, 0)).collect();
        assert_eq!(of(&walls).behind, Behind::Scene);
        let grey = of(&views(&picture([128; 3], 0, 0), 5));
        assert_eq!((grey.behind, grey.background()), (Behind::Flat([128; 3]), Background::Opaque));
        assert_eq!(of(&[]).background(), Background::Opaque);
    }

    #[test]
    fn alpha_says_it_all() {
        let mut image = picture([10, 200, 30], 90, 0);
        image.data[7] = 254;
        let borders = of(&[picture([0; 3], 0, 0), image]);
        assert_eq!(
            (borders.behind, borders.background()),
            (Behind::Transparent, Background::White)
        );
    }
}
