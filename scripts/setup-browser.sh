#!/usr/bin/env bash
# Installs the npm packages of tests/browser into target/browser, with the hashes of their lock file. The browser is Debian's chromium.
set -euo pipefail
cd "$(dirname "$0")/.."
home=target/browser
if cmp -s tests/browser/package-lock.json "$home/complete"; then exit 0; fi
command -v npm >/dev/null || { echo "setup-browser: npm is missing; apt-get install nodejs npm" >&2; exit 1; }
mkdir -p "$home"
rm -f "$home/complete"
cp tests/browser/package.json tests/browser/package-lock.json tests/browser/.npmrc "$home"
(cd "$home" && npm ci --silent --ignore-scripts)
cp tests/browser/package-lock.json "$home/complete"
