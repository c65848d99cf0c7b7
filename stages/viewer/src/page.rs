//! The page: one HTML file that needs neither other files nor a network.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use maud::{DOCTYPE, Markup, PreEscaped, html};
use scene::{Bounds, Intrinsics};
use serde::Serialize;

use crate::atlas::Atlas;

const STYLE: &str = include_str!("page/viewer.css");
const VERTEX_SHADER: &str = include_str!("page/shader.vert");
const FRAGMENT_SHADER: &str = include_str!("page/shader.frag");
const SCRIPTS: [&str; 3] = [
    include_str!("page/volume.js"),
    include_str!("page/camera.js"),
    include_str!("page/viewer.js"),
];
/// Content security policy: the page's own scripts and styles, and embedded images.
const POLICY: &str =
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:";

/// Description of the scene for the page's script, in addition to the volume's bytes.
#[derive(Debug, Serialize)]
pub(crate) struct PageScene {
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
                title { "nerf-sr viewer" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main {
                    div id="stage" {
                        canvas id="view" tabindex="0" role="application" aria-label=(LABEL) {}
                        canvas id="frusta" aria-hidden="true" {}
                        p id="message" role="status" { "Loading the scene …" }
                    }
                    figure id="photograph" hidden {
                        img id="photo" alt="";
                        figcaption id="photo-name" {}
                    }
                }
                (controls(scene))
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
    minus zoom; N and P go to the next and previous training camera.";

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
            span class="help" { "Drag to turn, Shift-drag to move, wheel to zoom" }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::Components;

    #[test]
    fn names_cannot_leave_their_place() {
        let name = "</script><b onclick=\"x\">";
        let scene = PageScene {
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
        let atlas = Atlas {
            resolution: 64,
            bricks: 0,
            components: Components::default(),
            bytes: vec![1, 2, 3],
        };
        let text = page(&scene, &atlas).unwrap().into_string();
        assert!(!text.contains("<b onclick") && text.contains("&lt;b onclick"));
        let from = text.find("id=\"scene\"").unwrap();
        let json = &text[from..from + text[from..].find("</script>").unwrap()];
        let json: serde_json::Value =
            serde_json::from_str(&json[json.find('>').unwrap() + 1..]).unwrap();
        assert_eq!(json["cameras"][0]["name"], name);
        assert!(text.contains(">AQID</script>"));
    }
}
