#!/usr/bin/env python3
"""Compares what two builds make of the same experiments, file by file: after a change that mustn't change behaviour.

compare-builds.py OLD NEW [--data DIR] [--only NAME ...] [--before-renames] [--added FILE:KEY ...]

OLD and NEW are work trees, each built by `make build`. The experiments are small: the demo scene, lego 100x2 by both kinds of supervision,
fern 252x2, and a refined run. Tensors, EXR, PNG and text files are compared byte by byte, JSON by value. --before-renames says that OLD
is older than the glossary: its names are translated. --added names JSON keys that OLD hasn't.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

# Targets and arguments, by today's names. Budgets are small: bytes are compared, not images.
SMALL = "-p lr_width=100 -p prep.test_views=2 -p train-ss.rays=400000 -p train-ss.precrop_steps=20"
EXPERIMENTS = {
    "demo": "-p demo-scene.size=64 -p demo-scene.train=12 -p demo-scene.test=2 -p train-ss.rays=300000",
    "lego": f"-i dataset=DATA/nerf_synthetic/lego {SMALL} -p supervision=kernel,average -i weights=DATA/weights",
    "ensemble": "-p demo-scene.size=64 -p demo-scene.train=12 -p demo-scene.test=2 -p train-ss.rays=200000 -p ensemble=2 -p train-ss.order=epochs",
    "mlp": "-p demo-scene.size=32 -p demo-scene.train=6 -p demo-scene.test=1 -p field=mlp -p layers=2 -p hidden_dim=16 -p train-ss.rays=4000 -p max_rays_per_step=256",
    "fern": "-i dataset=DATA/nerf_llff_data/fern -p lr_width=252 -p prep.test_views=1 -p train-ss.rays=300000 -p render-depth.samples_per_axis=1",
    "refined": "refined -p demo-scene.size=64 -p demo-scene.train=12 -p demo-scene.test=2 -p train-ss.rays=300000 -p downscaled-field.rays=200000 -p train-refine.steps=40",
}
# What folders and JSON keys were before the glossary.
KEYS = {"downscaled": "rehearsal"}
# What stages and parameters were.
RENAMES = KEYS | {
    "downscaled-field": "rehearsal-field",
    "downscaled-views": "rehearsal-views",
    "lr_width": "lr",
    "precrop_steps": "crop_steps",
    "ensemble": "members",
    "hidden_dim": "hidden",
    "max_rays_per_step": "batch",
    "samples_per_axis": "sub_rays",
}


def older(word: str) -> str:
    """A word of a command line as it was before the glossary: targets, stages and parameters."""
    name, equals, value = word.partition("=")
    return ".".join(RENAMES.get(part, part) for part in name.split(".")) + equals + value


def newer(name: str, renames: dict[str, str]) -> str:
    return next((new for new, old in renames.items() if old == name), name)


def printed(command: list) -> str:
    return subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE).stdout


def has_json(runner: pathlib.Path) -> bool:
    """Whether a runner has `status --json`: builds before 5fe62be, such as those before the glossary, have words alone."""
    return "--json" in printed([runner, "status", "--help"])


def artifacts(tree: pathlib.Path, folder: pathlib.Path, words: list[str], has_old_names: bool) -> dict[str, pathlib.Path]:
    """The artifacts of a run, by stage and point; with today's names."""
    words = [older(word) for word in words] if has_old_names else words
    runner = [tree / "target/release/nerf-sr", "--pipeline", tree / "pipeline.yaml", "--store", folder / "store"]
    subprocess.run([*runner, "run", "--out", folder / "out", *words], check=True, stdout=subprocess.DEVNULL)
    if has_json(runner[0]):
        made = [node for node in json.loads(printed([*runner, "status", "--json", *words]))["nodes"] if node["state"] == "cached"]
        return {f"{node['stage']} [{node['point']}]".removesuffix(" []"): pathlib.Path(node["folder"]) for node in made}
    found = {}
    for line in printed([*runner, "status", *words]).splitlines():
        label, cached, rest = line.partition(" cached ")
        if cached:
            stage, _, point = label.strip().partition(" ")
            label = f"{newer(stage, RENAMES) if has_old_names else stage} {point}".strip()
            found[label] = next((folder / "store/objects").glob(f"{rest.split()[0]}*"))
    return found


def renamed(value):
    """A JSON value with its keys as they are called now."""
    if isinstance(value, dict):
        return {newer(key, KEYS): renamed(entry) for key, entry in value.items()}
    return [renamed(entry) for entry in value] if isinstance(value, list) else value


def files(artifact: pathlib.Path, options: argparse.Namespace, has_old_names: bool) -> dict:
    """Contents by path, the manifest left out: it follows from them."""
    has_renames, added = options.before_renames, options.added
    found = {}
    for file in sorted(p for p in artifact.rglob("*") if p.is_file() and p.name != "artifact.json"):
        parts = file.relative_to(artifact).parts
        name = "/".join(newer(part, KEYS) if has_old_names else part for part in parts)
        if has_renames and name == "summary.txt":
            continue  # Words for people, with the names in them.
        if file.suffix == ".json":
            value = json.loads(file.read_text())
            if isinstance(value, dict):
                value = {key: entry for key, entry in value.items() if f"{name}:{key}" not in added}
            found[name] = renamed(value) if has_old_names else value
        else:
            found[name] = file.read_bytes()
    return found


MISSING = object()


def unequal(before, after, path: str) -> list[str]:
    """Where two values differ, by path; of JSON with what they are."""
    if before is MISSING or after is MISSING:
        return [f"{path}: only {'now' if before is MISSING else 'before'}"]
    if isinstance(before, dict) and isinstance(after, dict):
        keys = sorted(before.keys() | after.keys())
        return [found for key in keys for found in unequal(before.get(key, MISSING), after.get(key, MISSING), f"{path} {key}")]
    if isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            return [f"{path}: {len(before)} entries, now {len(after)}"]
        return [found for i, pair in enumerate(zip(before, after)) for found in unequal(*pair, f"{path} {i}")]
    if before == after:
        return []
    return [path if isinstance(before, bytes) or isinstance(after, bytes) else f"{path}: {before!r}, now {after!r}"]


def compare(name: str, options: argparse.Namespace) -> bool:
    """Whether both builds make the same of an experiment; says what differs."""
    words = EXPERIMENTS[name].replace("DATA", str(options.data.resolve())).split()
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        old = artifacts(options.old, pathlib.Path(one), words, options.before_renames)
        new = artifacts(options.new, pathlib.Path(other), words, False)
        differences, compared = sorted(old.keys() ^ new.keys()), 0
        for label in sorted(old.keys() & new.keys()):
            before, after = files(old[label], options, options.before_renames), files(new[label], options, False)
            compared += len(after)
            differences += unequal(before, after, f"{label}:")
    what = f"{len(differences)} differences" if differences else "equal"
    print(f"{name}: {compared} files of {len(new)} artifacts: {what}", *differences, sep="\n  ", flush=True)
    return not differences


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=pathlib.Path)
    parser.add_argument("new", type=pathlib.Path)
    parser.add_argument("--data", type=pathlib.Path, default=pathlib.Path("../shared/data"))
    parser.add_argument("--only", nargs="+", choices=EXPERIMENTS, default=list(EXPERIMENTS))
    parser.add_argument("--before-renames", action="store_true")
    parser.add_argument("--added", nargs="*", default=[], metavar="FILE:KEY")
    options = parser.parse_args()
    return 0 if all([compare(name, options) for name in options.only]) else 1


if __name__ == "__main__":
    sys.exit(main())
