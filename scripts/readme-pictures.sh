#!/usr/bin/env bash
# Writes the README's pictures of the demo scene: docs/demo.png, docs/page.png and docs/viewer.png.
# Needs `make build`, Pillow (`make goldens` installs it), and Chromium with scripts/setup-browser.sh.
set -euo pipefail
cd "$(dirname "$0")/.."
target/release/nerf-sr run
target/release/nerf-sr run viewer
"${PYTHON:-.venv/bin/python}" scripts/readme-picture.py
export NERF_SR_BROWSER=$PWD/target/browser NERF_SR_CHROMIUM=${NERF_SR_CHROMIUM:-$(command -v chromium)}
node tests/browser/picture.mjs docs/page.png out/report/index.html
node tests/browser/picture.mjs docs/viewer.png out/viewer/index.html Cameras
