//! The browser for tests of pages must report problems of a page and draw WebGL.

mod common;

use common::browser::run_in_browser;

/// Returns the problems that the browser reports for a page; `None` without a browser.
fn problems(body: &str) -> Option<Vec<String>> {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("page.html");
    std::fs::write(&page, format!("<!doctype html><html lang=en><title>A</title>{body}")).unwrap();
    let found = run_in_browser("problems.mjs", [&page])?;
    Some(serde_json::from_value(found).unwrap())
}

#[test]
fn a_plain_page_has_no_problem() {
    let Some(found) = problems("<main><h1>A page</h1></main>") else { return };
    assert!(found.is_empty(), "{found:?}");
}

#[test]
fn errors_requests_and_missing_labels_are_reported() {
    let body = "<main><h1>A page</h1><img src=https://example.invalid/a.png><select></select></main>\
                <script>console.error('said'); throw new Error('thrown')</script>";
    let Some(found) = problems(body) else { return };
    for text in [
        "console: said",
        "error: thrown",
        "request: https://example.invalid",
        "image-alt",
        "select-name",
    ] {
        assert!(found.iter().any(|problem| problem.contains(text)), "{text}: {found:?}");
    }
}

#[test]
fn software_webgl_draws() {
    let Some(drawn) = run_in_browser("webgl.mjs", [""; 0]) else { return };
    assert_eq!(drawn, serde_json::json!([255, 127, 0, 255]));
}
