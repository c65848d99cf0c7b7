#!/usr/bin/env python3
"""Copies the licences of all code in the archive of `make dist`: licences.py FOLDER LIBTORCH.

FOLDER/crates gets the licence files of each linked crate, from the sources that cargo has downloaded, and FOLDER/crates.txt the
licences by name. FOLDER/rust gets the licences of Rust's standard library, FOLDER/libtorch those of LIBTORCH.
"""

import json
import pathlib
import re
import shutil
import subprocess
import sys

ROOT = pathlib.Path(__file__).parent.parent
LICENCE_FILE = re.compile(r"(un)?licen[cs]e|copying|copyright|notice|authors", re.IGNORECASE)


def output(*command: str) -> str:
    """Runs a command in the repository; returns its output."""
    return subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True).stdout


def linked_crates() -> list[dict]:
    """Returns the crates outside the workspace that its programs link, sorted by name; build scripts and tests are excluded."""
    host = re.search(r"^host: (.*)$", output("rustc", "-vV"), re.MULTILINE)[1]
    metadata = json.loads(output("cargo", "metadata", "--format-version=1", "--locked", f"--filter-platform={host}"))
    packages = {package["id"]: package for package in metadata["packages"]}
    edges = {node["id"]: node["deps"] for node in metadata["resolve"]["nodes"]}
    found, waiting = set(), list(metadata["workspace_members"])
    while waiting:
        crate = waiting.pop()
        if crate not in found:
            found.add(crate)
            waiting += [edge["pkg"] for edge in edges[crate] if any(kind["kind"] is None for kind in edge["dep_kinds"])]
    return sorted((packages[crate] for crate in found if packages[crate]["source"]), key=lambda p: (p["name"], p["version"]))


def offered_text(package: dict) -> tuple[str, str]:
    """Returns name and text of a licence that a crate offers without a file of its own: MIT or Apache-2.0."""
    offered = re.split(r" OR |/", package["license"] or "")
    if "MIT" in offered:
        owners = ", ".join(package["authors"]) or f"the authors of {package['name']}"
        text = (ROOT / "LICENSE-MIT").read_text()
        return "LICENSE-MIT", re.sub(r"^Copyright .*$", lambda _: f"Copyright (c) {owners}", text, count=1, flags=re.MULTILINE)
    if "Apache-2.0" in offered:
        return "LICENSE-APACHE", (ROOT / "LICENSE-APACHE").read_text()
    sys.exit(f"licences: {package['name']} {package['version']} has no licence file ({package['license']}); add its text to licences.py")


def copy_crate(package: dict, target: pathlib.Path) -> None:
    """Copies a crate's licence files, or the text of the licence that it offers."""
    source = pathlib.Path(package["manifest_path"]).parent
    target.mkdir(parents=True)
    for path in sorted(source.iterdir()):
        if LICENCE_FILE.match(path.name) and path.suffix != ".rs":
            (shutil.copytree if path.is_dir() else shutil.copyfile)(path, target / path.name)
    if not any(target.iterdir()):
        name, text = offered_text(package)
        (target / name).write_text(text)


def copy_folder(source: pathlib.Path, target: pathlib.Path, remedy: str) -> None:
    """Copies a folder of licences."""
    if not source.is_dir():
        sys.exit(f"licences: {source} not found; {remedy}")
    shutil.copytree(source, target)


def main() -> None:
    """Copies all licences."""
    folder, libtorch = map(pathlib.Path, sys.argv[1:])
    crates = linked_crates()
    for package in crates:
        copy_crate(package, folder / "crates" / f"{package['name']}-{package['version']}")
    lines = [f"{package['name']} {package['version']}: {package['license'] or 'see its files'}\n" for package in crates]
    (folder / "crates.txt").write_text("".join(lines))
    rust = pathlib.Path(output("rustc", "--print", "sysroot").strip()) / "share/doc/rust"
    copy_folder(rust / "licenses", folder / "rust", "install Rust by rustup")
    # Notices of the compiler, in COPYRIGHT.html, don't concern programs.
    shutil.copyfile(rust / "COPYRIGHT-library.html", folder / "rust/COPYRIGHT-library.html")
    copy_folder(libtorch / "licenses", folder / "libtorch", "put libtorch's licences there, or delete .libtorch and run `make setup`")


if __name__ == "__main__":
    main()
