//! The page: one HTML file that needs neither other files nor a network.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use maud::{DOCTYPE, Markup, PreEscaped, html};
use scene::{Bounds, Intrinsics};
use serde::Serialize;

use crate::atlas::Atlas;

const STYLE: &str = include_str!("page/viewer.css");
const VERTEX_SHADER: &str = include_str!("page/shader.vert");
const FRAGMENT_SHADER: &str = include_str!("page/shader.frag");
const SCRIPTS: [&str; 4] = [
    include_str!("page/volume.js"),
    include_str!("page/camera.js"),
    include_str!("page/recorder.js"),
    include_str!("page/viewer.js"),
];
/// Content security policy: the page's own scripts and styles, and embedded images.
const POLICY: &str =
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:";

/// Description of the scene for the page's script, in addition to the volume's bytes.
#[derive(Debug, Serialize)]
pub(crate) struct PageScene {
    /// Name of the data set.
    pub(crate) name: String,
    /// Voxels along each side of the unit cube.
    pub(crate) resolution: usize,
    /// Number of bricks.
    pub(crate) bricks: usize,
    /// Red, green and blue of nine spherical harmonics for each component.
    pub(crate) components: Vec<f32>,
    /// Grey level behind the scene.
    pub(crate) background: f32,
    pub(crate) bounds: Bounds,
    /// Centre of rotation, in world coordinates.
    pub(crate) centre: [f64; 3],
    /// Extent of the scene, in scene units.
    pub(crate) size: f64,
    /// Width in pixels of a film along a recorded path.
    pub(crate) film_width: u32,
    /// Depth at which the training cameras' frusta are drawn, in scene units.
    pub(crate) frustum_depth: f64,
    /// Up direction, unit length.
    pub(crate) up: [f64; 3],
    /// Index of the camera that is shown first.
    pub(crate) start: usize,
    pub(crate) cameras: Vec<PageCamera>,
}

/// A training camera.
#[derive(Debug, Serialize)]
pub(crate) struct PageCamera {
    pub(crate) name: String,
    pub(crate) camera_to_world: [[f64; 4]; 3],
    pub(crate) intrinsics: Intrinsics,
    /// Data URL of the LR photograph.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) photograph: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) photograph_size: Option<ImageSize>,
}

/// Pixels of an image.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct ImageSize {
    pub(crate) width: usize,
    pub(crate) height: usize,
}

/// Renders the page of a scene.
pub(crate) fn page(scene: &PageScene, atlas: &Atlas) -> anyhow::Result<Markup> {
    // Only `<` could end a script element.
    let scene_json = serde_json::to_string(scene)?.replace('<', "\\u003c");
    Ok(html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta http-equiv="Content-Security-Policy" content=(POLICY);
                title { (scene.name) " – nerf-sr viewer" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                header { h1 { (scene.name) } span id="distance" {} }
                main {
                    div id="stage" {
                        canvas id="view" tabindex="0" role="application" aria-label=(LABEL) {}
                        canvas id="frusta" aria-hidden="true" {}
                        div id="depth-scale" hidden { span id="nearest" {} i {} span id="farthest" {} }
                        p id="message" role="status" { "Loading the scene …" }
                    }
                    figure id="photograph" hidden {
                        img id="photo" alt="";
                        figcaption id="photo-name" {}
                    }
                }
                (controls(scene))
                (help())
                noscript { p { "The view needs JavaScript." } }
                script id="scene" type="application/json" { (PreEscaped(scene_json)) }
                script id="vertex-shader" type="text/plain" { (PreEscaped(VERTEX_SHADER)) }
                script id="fragment-shader" type="text/plain" { (PreEscaped(FRAGMENT_SHADER)) }
                script id="volume" type="text/plain" { (STANDARD.encode(&atlas.bytes)) }
                script type="module" { (PreEscaped(SCRIPTS.join("\n"))) }
            }
        }
    })
}

const LABEL: &str = "View of the scene. Arrow keys turn it, with Shift they move it; plus and \
    minus zoom; N and P go to the next and previous training camera; question mark lists all keys.";

/// Keys and their effects.
const KEYS: [(&str, &str); 14] = [
    ("drag, arrow keys", "orbit"),
    ("Shift and drag or arrow keys", "pan"),
    ("wheel, + and -", "zoom"),
    ("[ and ]", "narrower or wider angle of view"),
    ("n, p", "next or previous training camera"),
    ("Home", "first camera"),
    ("1, 2, 3", "colour, depth, opacity"),
    ("c", "show training cameras; click one to fly to it"),
    ("v", "show the photograph"),
    ("t", "turntable"),
    ("f", "full screen"),
    ("s", "save the image"),
    ("k", "add a key to the camera path"),
    ("?", "this list"),
];

/// List of keys, in a dialog.
fn help() -> Markup {
    html! {
        dialog id="help" aria-labelledby="help-heading" {
            h2 id="help-heading" { "Mouse and keys" }
            dl { @for (keys, effect) in KEYS { dt { (keys) } dd { (effect) } } }
            form method="dialog" { button { "Close" } }
        }
    }
}

/// Contents of the view, with their labels.
const MODES: [(&str, &str); 3] = [("colour", "Colour"), ("depth", "Depth"), ("opacity", "Opacity")];

/// Controls below the view.
fn controls(scene: &PageScene) -> Markup {
    html! {
        nav aria-label="View" {
            fieldset aria-label="Shows" {
                @for (mode, label) in MODES {
                    label {
                        input type="radio" name="mode" value=(mode) checked[mode == "colour"];
                        (label)
                    }
                }
            }
            span class="cameras" {
                button id="previous" type="button" aria-label="Previous training camera" { "‹" }
                select id="camera" aria-label="Training camera" {
                    option value="" { "free view" }
                    @for (i, camera) in scene.cameras.iter().enumerate() {
                        option value=(i) { (camera.name) }
                    }
                }
                button id="next" type="button" aria-label="Next training camera" { "›" }
                button id="reset" type="button" { "Reset" }
            }
            label { input id="with-frusta" type="checkbox"; "Cameras" }
            label { input id="compare" type="checkbox" checked; "Photograph" }
            label {
                "Angle of view" input id="angle" type="range" min="10" max="110" step="1";
                output id="angle-value" {}
            }
            span class="buttons" {
                button id="turntable" type="button" aria-pressed="false" { "Turntable" }
                button id="full-screen" type="button" { "Full screen" }
                button id="save-image" type="button" { "Save image" }
                button id="show-help" type="button" { "Keys" }
            }
            span class="buttons" role="group" aria-label="Camera path" {
                button id="add-key" type="button" { "Add key" }
                button id="save-path" type="button" disabled { "Save path" }
                button id="clear-path" type="button" disabled { "Clear" }
                span id="path-length" role="status" {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::Components;

    #[test]
    fn markup_in_names_is_escaped() {
        let name = "</script><b onclick=\"x\">";
        let scene = PageScene {
            name: name.to_owned(),
            film_width: 64,
            frustum_depth: 0.1,
            resolution: 64,
            bricks: 0,
            components: Vec::new(),
            background: 1.0,
            bounds: Bounds::default(),
            centre: [0.0; 3],
            size: 1.0,
            up: [0.0, 0.0, 1.0],
            start: 0,
            cameras: vec![PageCamera {
                name: name.to_owned(),
                camera_to_world: [[0.0; 4]; 3],
                intrinsics: Intrinsics::from_angle_x(4, 4, 0.5),
                photograph: None,
                photograph_size: None,
            }],
        };
        let atlas = Atlas { bricks: 0, components: Components::default(), bytes: vec![1, 2, 3] };
        let text = page(&scene, &atlas).unwrap().into_string();
        assert!(!text.contains("<b onclick") && text.contains("&lt;b onclick"));
        let scene_start = text.find("id=\"scene\"").unwrap();
        let json = &text[scene_start..scene_start + text[scene_start..].find("</script>").unwrap()];
        let json: serde_json::Value =
            serde_json::from_str(&json[json.find('>').unwrap() + 1..]).unwrap();
        assert_eq!(json["cameras"][0]["name"], name);
        assert!(text.contains(">AQID</script>"));
    }
}
