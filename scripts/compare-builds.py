#!/usr/bin/env python3
"""Compares what two builds make of one experiment, file by file: after a change that mustn't change behaviour.

compare-builds.py OLD NEW [--rename OLD=NEW ...]

OLD and NEW are folders, each with a pipeline.yaml, a file `runner` that names its build's nerf-sr, and perhaps a file `arguments` with one
line of the command's arguments. So names may differ between the two. Artifacts are matched in the order of `status`. Tensors, EXR, PNG and
text files are compared byte by byte, JSON by value. --rename says how a folder or a JSON key is called now.
"""

import argparse
import json
import pathlib
import subprocess
import sys

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("old", type=pathlib.Path)
parser.add_argument("new", type=pathlib.Path)
parser.add_argument("--rename", action="append", default=[], metavar="OLD=NEW")
options = parser.parse_args()
renames = dict(pair.split("=", 1) for pair in options.rename)


def artifacts(folder: pathlib.Path) -> list[pathlib.Path]:
    """The artifacts of a run, in the order of its stages; what isn't made yet is made."""
    runner = (folder / "runner").read_text().strip()
    arguments = (folder / "arguments").read_text().split() if (folder / "arguments").exists() else []
    subprocess.run([runner, "run", *arguments], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    status = subprocess.run([runner, "status", *arguments], cwd=folder, check=True, text=True, stdout=subprocess.PIPE).stdout
    starts = [line.split(" cached ", 1)[1].split()[0] for line in status.splitlines() if " cached " in line]
    return [next((folder / ".nerf-sr/objects").glob(f"{start}*")) for start in starts]


def renamed(value):
    """A JSON value with its keys as they are called now."""
    if isinstance(value, dict):
        return {renames.get(key, key): renamed(entry) for key, entry in value.items()}
    return [renamed(entry) for entry in value] if isinstance(value, list) else value


def content(file: pathlib.Path, is_old: bool):
    if file.suffix != ".json":
        return file.read_bytes()
    value = json.loads(file.read_text())
    return renamed(value) if is_old else value


def files(artifact: pathlib.Path, is_old: bool) -> dict:
    """Contents by path, the manifest left out: it follows from them."""
    found = {}
    for file in sorted(p for p in artifact.rglob("*") if p.is_file() and p.name != "artifact.json"):
        parts = file.relative_to(artifact).parts
        name = "/".join(renames.get(part, part) if is_old else part for part in parts)
        found[name] = content(file, is_old)
    return found


def main() -> int:
    old, new = artifacts(options.old), artifacts(options.new)
    if len(old) != len(new):
        sys.exit(f"{len(old)} artifacts in {options.old}, {len(new)} in {options.new}")
    differences, compared = [], 0
    for one, other in zip(old, new):
        kind = json.loads((other / "artifact.json").read_text())["kind"]
        before, after = files(one, True), files(other, False)
        compared += len(after)
        differences += [f"{kind}: {name}" for name in sorted(before.keys() | after.keys()) if before.get(name) != after.get(name)]
    print("\n".join(differences) or f"{compared} files of {len(new)} artifacts are equal")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
