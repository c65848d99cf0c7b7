use std::collections::BTreeMap;

use maud::{Markup, html};

use crate::data::Data;
use crate::gather::Report;
use crate::pictures::Picture;

/// Number of views shown without scripts; chosen by hand.
const STATIC_VIEWS: usize = 4;
/// Maximum number of pictures per view shown without scripts; chosen by hand.
const STATIC_PICTURES: usize = 6;

/// Section with the comparison of pictures, filled in by a script.
pub(crate) fn comparison(data: Option<&Data>) -> Markup {
    html! {
        section id="compare" aria-labelledby="compare-heading" {
            h2 id="compare-heading" { "Compare" }
            noscript { (static_pictures(data)) }
            div id="comparison" hidden {
                div class="controls over" {
                    div class="field" {
                        label for="view" { "View" }
                        div class="stepper" {
                            button type="button" id="previous" aria-label="Previous view" { "‹" }
                            select id="view" {}
                            button type="button" id="next" aria-label="Next view" { "›" }
                        }
                    }
                    div class="field pair" { label for="left" { "Left" } select id="left" {} }
                    div class="field pair" { label for="right" { "Right" } select id="right" {} }
                    div class="field all" { label for="kind" { "Pictures" } select id="kind" {} }
                    div class="field modes" role="group" aria-label="Arrangement" {
                        button type="button" id="slider-mode" aria-pressed="true" { "Slider" }
                        button type="button" id="grid-mode" aria-pressed="false" { "Side by side" }
                    }
                }
                div id="panes" tabindex="0" role="group" aria-describedby="panes-help" {}
                div id="thumbnails" role="group" aria-label="Views" {}
                div class="controls under" {
                    label class="split" { span { "Divide" }
                        input type="range" id="split" min="0" max="100" step="0.5" value="50"
                            aria-label="Position of the divider between left and right, per cent";
                    }
                    div class="field modes" role="group" aria-label="Zoom" {
                        button type="button" id="zoom-out" aria-label="Zoom out" { "−" }
                        output id="zoom" { "" }
                        button type="button" id="zoom-in" aria-label="Zoom in" { "+" }
                        button type="button" id="fit" { "Fit" }
                        button type="button" id="one-to-one" { "1:1" }
                    }
                    div class="field" {
                        button type="button" id="link" { "Copy link" }
                    }
                }
                p id="panes-help" class="note" {
                    "Drag to move the divider, or to pan a zoomed view. To zoom, pinch, press + or "
                    "−, or turn the wheel with Ctrl pressed. 0 fits the view; 1 shows one image "
                    "pixel per screen pixel. A double click acts like 0 in a zoomed view, "
                    "otherwise like 1. N and P change the view."
                }
                div id="scales" {}
                div class="wide tall low" tabindex="0" role="region" aria-label="Numbers of this view" {
                    table id="numbers" aria-live="polite" {}
                }
                p id="originals" class="note" {}
            }
        }
    }
}

/// Originals of some views, for readers without scripts.
fn static_pictures(data: Option<&Data>) -> Markup {
    let mut by_view: BTreeMap<usize, Vec<&Picture>> = BTreeMap::new();
    for picture in data.into_iter().flat_map(|data| &data.pictures) {
        by_view.entry(picture.view).or_default().push(picture);
    }
    html! {
        p { "The comparison needs JavaScript. These are pictures from the folder views/:" }
        @for pictures in by_view.values().take(STATIC_VIEWS) {
            div class="static" {
                @for picture in pictures.iter().take(STATIC_PICTURES) {
                    figure {
                        img src=(picture.original) alt="" loading="lazy";
                        figcaption { (picture.original) }
                    }
                }
            }
        }
    }
}

/// Section with plots of scores, trade-offs and training, drawn by a script.
pub(crate) fn plots(report: &Report<'_>) -> Markup {
    if report.rows.is_empty() {
        return html! { section id="plots" hidden {} };
    }
    html! {
        section id="plots" aria-labelledby="plots-heading" hidden {
            h2 id="plots-heading" { "Plots" }
            div class="controls" {
                div class="field" { label for="figure" { "Figure" } select id="figure" {} }
                div class="field" {
                    label for="axis" { "Swept parameter" }
                    select id="axis" {}
                }
            }
            div id="charts" class="charts" {}
        }
    }
}
