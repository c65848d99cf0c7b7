//! Estimates a scene's background from the borders of its images (docs/design/035).

use std::fmt::{self, Display, Formatter};

use artifact::{WARNING, format_count};
use dataset::{Border, plain_background};
use pixels::{are_similar, medians};
use scene::Background;

use crate::inspection::ViewBorder;
use crate::strips::Strips;

/// Minimum percentage of the colour in the borders of half of the views.
const FLAT_PERCENT: usize = 90;

/// Evidence in the images' borders for the scene's background.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BorderEvidence {
    /// Images have alpha.
    Alpha,
    /// Borders are one flat colour.
    Flat([u8; 3]),
    /// Borders show more of the scene.
    Scene,
}

/// Combined borders of the sampled views.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Borders {
    pub(crate) evidence: BorderEvidence,
    /// Number of views whose borders are the flat colour.
    flat: usize,
    /// Background that half of the views suggest: white or black.
    suggested: Option<Background>,
    /// Number of sampled views.
    views: usize,
    strips: Option<CommonStrips>,
}

/// Strips that views have in common.
#[derive(Clone, Debug, PartialEq, Eq)]
struct CommonStrips {
    strips: Strips,
    /// Number of views with these strips.
    views: usize,
    /// True if the masks of all these views exclude the strips.
    are_masked: bool,
}

impl Borders {
    /// Combines the borders of sampled views. One image with alpha is evidence of alpha. A flat
    /// colour has 60 % of the border in nine of ten views, and 90 % in half of the views.
    pub(crate) fn new(borders: &[Border]) -> Self {
        let views = borders.len();
        let mut found =
            Self { evidence: BorderEvidence::Scene, flat: 0, suggested: None, views, strips: None };
        if borders.contains(&Border::Alpha) {
            found.evidence = BorderEvidence::Alpha;
            return found;
        }
        let mut coloured: Vec<([u8; 3], usize)> = Vec::new();
        for border in borders {
            if let Border::Colour { median, percent } = border {
                coloured.push((*median, *percent));
            }
        }
        let colours: Vec<[u8; 3]> = coloured.iter().map(|(colour, _)| *colour).collect();
        let common = medians(&colours);
        coloured.retain(|(colour, _)| are_similar(*colour, common, Border::MAX_NOISE));
        found.flat = coloured.iter().filter(|(_, percent)| *percent >= FLAT_PERCENT).count();
        if views > 0 && 10 * coloured.len() >= 9 * views && 2 * found.flat >= views {
            found.evidence = BorderEvidence::Flat(common);
        } else if 2 * coloured.len() >= views {
            found.suggested = plain_background(common);
        }
        found
    }

    /// Adds the strips that the views have in common. If all four sides have strips, their flat
    /// colour is no evidence for a background.
    pub(crate) fn with_strips(mut self, views: &[ViewBorder]) -> Self {
        let strips: Vec<Option<Strips>> = views.iter().map(|view| view.strips).collect();
        let common = Strips::common(&strips).filter(|_| self.evidence != BorderEvidence::Alpha);
        if let Some((strips, count)) = common {
            let are_masked =
                views.iter().all(|view| view.strips.is_none() || view.has_masked_strips);
            self.strips = Some(CommonStrips { strips, views: count, are_masked });
            if strips.is_frame() {
                self.evidence = BorderEvidence::Scene;
            }
        }
        self
    }

    /// Returns the evidence for the background, unless the background is given, and the remedy for
    /// strips.
    pub(crate) fn notes(&self, is_background_given: bool) -> Vec<String> {
        let mut notes = Vec::new();
        let is_frame = self.strips.as_ref().is_some_and(|common| common.strips.is_frame());
        if !is_background_given && self.evidence != BorderEvidence::Alpha && !is_frame {
            notes.push(self.to_string());
        }
        if let Some(CommonStrips { strips, views, are_masked }) = &self.strips {
            let found = format!("{strips} in {views} of {} sampled views", self.views);
            notes.push(if *are_masked {
                format!("{found} are masked out; they are not a background")
            } else {
                format!(
                    "{WARNING}{found} seem to come from undistortion or letterboxing, not from a \
                    background: mask them out (masks/NAME.png, mask_path) or crop the photographs"
                )
            });
        }
        notes
    }

    /// Returns the background that rays see behind the scene. A flat colour that is neither white
    /// nor black is a wall: part of the scene.
    pub(crate) fn background(&self) -> Background {
        match self.evidence {
            // Alpha is composited over white.
            BorderEvidence::Alpha => Background::White,
            BorderEvidence::Flat(colour) => plain_background(colour).unwrap_or(Background::Opaque),
            BorderEvidence::Scene => Background::Opaque,
        }
    }
}

/// Formats the evidence for the log.
impl Display for Borders {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let colour = match self.evidence {
            BorderEvidence::Alpha => return f.write_str("images have alpha"),
            BorderEvidence::Flat([r, g, b]) => format!(" ({r} {g} {b})"),
            BorderEvidence::Scene => String::new(),
        };
        let (flat, views) = (self.flat, format_count(self.views, "sampled view"));
        write!(
            f,
            "images have no alpha; borders are one flat colour{colour} in {flat} of {views}"
        )?;
        if self.evidence == BorderEvidence::Scene {
            f.write_str(": too few for a plain background, so background is opaque")?;
        }
        let Some(suggested) = self.suggested else { return Ok(()) };
        let name = if suggested == Background::White { "white" } else { "black" };
        write!(f, "; if only {name} is behind the object, give -p background={name}")
    }
}

#[cfg(test)]
mod tests {
    use pixels::Rgba8;

    use super::*;

    fn image_pixel(border: [u8; 3], noise: u8, touching: usize, index: usize) -> [u8; 4] {
        let (x, y) = (index % 20, index / 20);
        let inside = (5..15).contains(&x) && (3..7).contains(&y) || y == 0 && x < touching;
        let [r, g, b] = if inside {
            [90, 40, 200]
        } else {
            border.map(|v| v.saturating_sub(index as u8 % (noise + 1)))
        };
        [r, g, b, u8::MAX]
    }

    /// Creates an image of 20×10 pixels: a noisy flat background with an object in the middle, and
    /// `touching` pixels of the object on the border.
    fn test_image(border: [u8; 3], noise: u8, touching: usize) -> Rgba8 {
        Rgba8::new(
            20,
            10,
            (0..200).flat_map(|index| image_pixel(border, noise, touching, index)).collect(),
        )
    }

    /// Creates an image of 20×10 pixels: a white sky above ground of many colours.
    fn sky_image() -> Rgba8 {
        let pixel = |index: usize| {
            let level = if index < 100 { u8::MAX } else { (index % 10 * 20) as u8 };
            [level, level, level, u8::MAX]
        };
        Rgba8::new(20, 10, (0..200).flat_map(pixel).collect())
    }

    fn borders_of(images: &[Rgba8]) -> Borders {
        Borders::new(&images.iter().map(Border::of).collect::<Vec<_>>())
    }

    #[test]
    fn flat_borders_are_distinguished_from_scenes() {
        let views = |image: &Rgba8, count| vec![image.clone(); count];
        let white = borders_of(&views(&test_image([255; 3], 6, 4), 3));
        assert_eq!(white.background(), Background::White);
        assert_eq!(
            white.to_string(),
            "images have no alpha; borders are one flat colour (251 251 251) in 3 of 3 \
            sampled views"
        );
        assert_eq!(
            borders_of(&views(&test_image([3; 3], 3, 0), 1)).background(),
            Background::Black
        );
        // An object may cover a fifth of some borders, but not of most.
        let covered = test_image([255; 3], 0, 12);
        let mut filled = views(&test_image([255; 3], 0, 0), 4);
        filled.extend(views(&covered, 4));
        assert_eq!(borders_of(&filled).background(), Background::White);
        filled.push(covered);
        let ambiguous = borders_of(&filled);
        assert_eq!(ambiguous.background(), Background::Opaque);
        assert_eq!(
            ambiguous.to_string(),
            "images have no alpha; borders are one flat colour in 4 of 9 sampled views: too few \
            for a plain background, so background is opaque; if only white is behind the object, \
            give -p background=white"
        );
        // A bright sky covers about half of the border.
        let skies = borders_of(&views(&sky_image(), 5));
        assert_eq!(skies.background(), Background::Opaque);
        assert!(!skies.to_string().contains("-p background"), "{skies}");
        // At most a tenth of the views may have another border.
        let mut mostly_white = views(&test_image([255; 3], 0, 0), 9);
        mostly_white.push(test_image([120; 3], 60, 0));
        assert_eq!(borders_of(&mostly_white).background(), Background::White);
        mostly_white.push(test_image([120; 3], 60, 0));
        assert_eq!(borders_of(&mostly_white).background(), Background::Opaque);
        // Walls: each view has its own flat colour, or all have the same grey.
        let walls: Vec<Rgba8> = (0..5).map(|i| test_image([50 * i; 3], 0, 0)).collect();
        assert_eq!(borders_of(&walls).evidence, BorderEvidence::Scene);
        let grey = borders_of(&views(&test_image([128; 3], 0, 0), 5));
        assert_eq!(
            (grey.evidence, grey.background()),
            (BorderEvidence::Flat([128; 3]), Background::Opaque)
        );
        assert_eq!(borders_of(&[]).background(), Background::Opaque);
    }

    #[test]
    fn one_image_with_alpha_is_evidence_of_alpha() {
        let mut image = test_image([10, 200, 30], 90, 0);
        image.data[7] = 254;
        let borders = borders_of(&[test_image([0; 3], 0, 0), image]);
        assert_eq!(
            (borders.evidence, borders.background()),
            (BorderEvidence::Alpha, Background::White)
        );
    }
}
