use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use artifact::RunRecord;
use maud::{Markup, html};
use pixels::{Rgba8, read_png};
use scene::Views;

use crate::Params;
use crate::images::{colour, uri_of};
use crate::page::{Point, label};

/// A square of an image.
#[derive(Clone, Copy)]
struct Crop {
    x: usize,
    y: usize,
    side: usize,
}

/// Squares along an image's shorter side, where nobody says which to show.
const SQUARES: usize = 4;

/// What all methods make of one view: a crop of each beside its error map, as the figures of papers
/// have it.
pub(crate) fn compare(
    run: &RunRecord,
    points: &[Point<'_>],
    params: &Params,
) -> anyhow::Result<Markup> {
    // Points that were scored on the same truth.
    let mut groups: BTreeMap<PathBuf, Vec<&Point<'_>>> = BTreeMap::new();
    for point in points {
        if let Some(truth) = point.node.inputs.get("truth") {
            groups.entry(run.folder_of(truth)).or_default().push(point);
        }
    }
    let shown = groups.iter().filter(|(_, group)| group.len() > 1);
    let rows = shown
        .map(|(truth, group)| row(run, points, truth, group, params))
        .collect::<anyhow::Result<Vec<_>>>()?;
    Ok(html! {
        @if rows.iter().any(Option::is_some) {
            h2 id="compare" { "Side by side" }
            @for row in rows.iter().flatten() { (row) }
        }
    })
}

fn row(
    run: &RunRecord,
    all: &[Point<'_>],
    folder: &Path,
    group: &[&Point<'_>],
    params: &Params,
) -> anyhow::Result<Option<Markup>> {
    let truths = Views::of_folder(folder)?;
    let wanted = |name: &str| params.compare.as_ref().is_none_or(|compare| compare == name);
    let view = truths.views.iter().find(|v| v.image.is_some() && wanted(&v.camera.name));
    let Some((view, image)) = view.and_then(|v| Some((v, v.image.as_ref()?))) else {
        return Ok(None);
    };
    let name = &view.camera.name;
    let truth = colour(folder, image, truths.background)?;
    let crop =
        params.crop.map_or_else(|| busiest(&truth), |[x, y, side]| within(&truth, x, y, side));
    let mut methods = Vec::new();
    for point in group {
        let Some(folder) = point.node.inputs.get("views").map(|input| run.folder_of(input)) else {
            continue;
        };
        let views = Views::of_folder(&folder)?;
        let scores = point.metrics["views"]
            .as_array()
            .into_iter()
            .flatten()
            .find(|scores| scores["name"] == name.as_str());
        let found =
            views.views.iter().find(|v| v.camera.name == *name).and_then(|v| v.image.as_ref());
        let (Some(found), Some(scores)) = (found, scores) else { continue };
        let image = colour(&folder, found, views.background)?;
        let error = scores["error_map"]
            .as_str()
            .map(|file| read_png(&point.node.folder.join(file)))
            .transpose()?;
        let psnr = scores["scores"]["psnr"]
            .as_f64()
            .map(|psnr| format!(", {psnr:.2} dB"))
            .unwrap_or_default();
        methods.push((label(all, point), psnr, image, error));
    }
    let Crop { x, y, side } = crop;
    let figure = |image: &Rgba8, caption: &str| {
        let same_size = (image.width, image.height) == (truth.width, truth.height);
        html! {
            @if same_size {
                figure {
                    img class="px" src=(uri_of(&cut(image, crop))) alt=(caption);
                    figcaption { (caption) }
                }
            }
        }
    };
    Ok(Some(html! {
        p {
            "View " (name) ", the " (side) "×" (side) " pixels from " (x) ", " (y) " on; the figures \
            are the whole view's."
        }
        div class="row compare" {
            (figure(&truth, "ground truth"))
            @for (name, psnr, image, _) in &methods { (figure(image, &format!("{name}{psnr}"))) }
        }
        div class="row compare" {
            figure { figcaption { "error" } }
            @for (name, _, _, error) in &methods {
                @if let Some(error) = error { (figure(error, name)) }
            }
        }
    }))
}

/// The square of an image in which neighbours differ most.
fn busiest(image: &Rgba8) -> Crop {
    let side = (image.width.min(image.height) / SQUARES).max(1);
    let detail = |crop: &Crop| -> u64 {
        let at =
            |x: usize, y: usize, c: usize| i64::from(image.data[4 * (y * image.width + x) + c]);
        let places = (crop.y..crop.y + side - 1)
            .flat_map(|y| (crop.x..crop.x + side - 1).map(move |x| (x, y)));
        let differs = |(x, y)| {
            (0..3)
                .map(|c| {
                    at(x, y, c).abs_diff(at(x + 1, y, c)) + at(x, y, c).abs_diff(at(x, y + 1, c))
                })
                .sum::<u64>()
        };
        places.map(differs).sum()
    };
    // Half a square apart; of equals the first.
    let starts = |size: usize| (0..=size - side).step_by((side / 2).max(1));
    let crops =
        starts(image.height).flat_map(|y| starts(image.width).map(move |x| Crop { x, y, side }));
    let first = Crop { x: 0, y: 0, side };
    crops
        .map(|crop| (detail(&crop), crop))
        .fold((0, first), |best, next| if next.0 > best.0 { next } else { best })
        .1
}

/// A square as it was asked for, moved and made smaller where it would leave the image.
fn within(image: &Rgba8, x: u32, y: u32, side: u32) -> Crop {
    let side = (side as usize).clamp(1, image.width.min(image.height).max(1));
    Crop { x: (x as usize).min(image.width - side), y: (y as usize).min(image.height - side), side }
}

fn cut(image: &Rgba8, Crop { x, y, side }: Crop) -> Rgba8 {
    let row =
        |row: usize| &image.data[4 * (row * image.width + x)..4 * (row * image.width + x + side)];
    Rgba8::new(side, side, (y..y + side).flat_map(row).copied().collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: usize, height: usize, busy: impl Fn(usize, usize) -> bool) -> Rgba8 {
        let pixel = |i: usize| {
            let (x, y) = (i % width, i / width);
            [if busy(x, y) && (x + y) % 2 == 0 { 255 } else { 0 }; 4]
        };
        Rgba8::new(width, height, (0..width * height).flat_map(pixel).collect())
    }

    #[test]
    fn the_square_with_most_detail_is_shown() {
        let shown = busiest(&image(40, 24, |x, y| x >= 30 && (9..15).contains(&y)));
        assert_eq!((shown.side, shown.y), (6, 9));
        assert!(shown.x >= 30, "{}", shown.x);
        // Images without any, and the smallest.
        for (width, height) in [(1, 1), (2, 1), (3, 9)] {
            let flat = image(width, height, |_, _| false);
            let crop = busiest(&flat);
            assert_eq!(cut(&flat, crop).width, crop.side);
        }
    }

    #[test]
    fn a_square_stays_in_the_image() {
        let whole = image(10, 6, |_, _| true);
        for (x, y, side) in [(0, 0, 6), (9, 5, 4), (99, 99, 99), (2, 3, 0)] {
            let crop = within(&whole, x, y, side);
            assert!(crop.x + crop.side <= 10 && crop.y + crop.side <= 6 && crop.side > 0);
            assert_eq!(cut(&whole, crop).height, crop.side);
        }
    }
}
