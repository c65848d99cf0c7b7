#!/usr/bin/env python3
"""Compares the artifacts of two builds for the same experiments, file by file; for changes that must not affect results.

compare-builds.py OLD NEW [--data DIR] [--only NAME ...] [--ignored FILE:KEY ...]

OLD and NEW are work trees, each built by `make build`. The experiments are small: the demo scene, an ensemble, the paper's field, lego 100x2
with both kinds of supervision, fern 252x2, and a refined run. Tensors, EXR, PNG and text files are compared byte by byte, JSON files by value
after keys are renamed to today's names. --ignored lists JSON keys that are not compared, such as field.json:format.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

# Targets and arguments, with today's names. Budgets are small because bytes are compared, not quality.
SMALL = "-p lr_width=100 -p prep.test_views=2 -p train-ss.rays=400000"
EXPERIMENTS = {
    "demo": "-p demo-scene.size=64 -p demo-scene.train=12 -p demo-scene.test=2 -p train-ss.rays=300000",
    "lego": f"-i dataset=DATA/nerf_synthetic/lego {SMALL} -p supervision=kernel,average -i weights=DATA/weights",
    "ensemble": "-p demo-scene.size=64 -p demo-scene.train=12 -p demo-scene.test=2 -p train-ss.rays=200000 -p ensemble=2",
    "mlp": "-p demo-scene.size=32 -p demo-scene.train=6 -p demo-scene.test=1 -p field=mlp -p layers=2 -p hidden_dim=16 -p train-ss.rays=4000 -p max_rays_per_step=256",
    "fern": "-i dataset=DATA/nerf_llff_data/fern -p lr_width=252 -p prep.test_views=1 -p train-ss.rays=300000 -p render-depth.samples_per_axis=1",
    "refined": "refined -p demo-scene.size=64 -p demo-scene.train=12 -p demo-scene.test=2 -p train-ss.rays=300000 -p downscaled-field.rays=200000 -p train-refine.steps=40",
}
# Today's names of JSON keys that earlier builds named differently, by file.
NAMES = {
    "field.json": {
        "levels": "n_levels",
        "coarsest": "base_resolution",
        "finest": "max_resolution",
        "log2_entries": "log2_hashmap_size",
        "hidden": "hidden_dim",
        "steps": "march_steps",
        "position_octaves": "position_frequencies",
        "direction_octaves": "direction_frequencies",
        "depth": "layers",
        "width": "hidden_dim",
    },
    "refiner.json": {"strength": "residual_weight", "trusted": "confidence", "agreeing": "data_consistent"},
}


def printed(command: list) -> str:
    return subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE).stdout


def artifacts(tree: pathlib.Path, folder: pathlib.Path, words: list[str]) -> dict[str, pathlib.Path]:
    """Runs an experiment and returns the artifacts' folders by stage and point."""
    runner = [tree / "target/release/nerf-sr", "--pipeline", tree / "pipeline.yaml", "--store", folder / "store"]
    subprocess.run([*runner, "run", "--out", folder / "out", *words], check=True, stdout=subprocess.DEVNULL)
    made = [node for node in json.loads(printed([*runner, "status", "--json", *words]))["nodes"] if node["state"] == "cached"]
    return {f"{node['stage']} [{node['point']}]".removesuffix(" []"): pathlib.Path(node["folder"]) for node in made}


def renamed(value, names: dict[str, str]):
    """Returns a JSON value with today's keys."""
    if isinstance(value, dict):
        return {names.get(key, key): renamed(entry, names) for key, entry in value.items()}
    return [renamed(entry, names) for entry in value] if isinstance(value, list) else value


def files(artifact: pathlib.Path, options: argparse.Namespace) -> dict:
    """Returns an artifact's file contents by path, without the manifest (derived from the files) and the summary (its text may change)."""
    found = {}
    for file in sorted(p for p in artifact.rglob("*") if p.is_file() and p.name not in ("artifact.json", "summary.txt")):
        name = file.relative_to(artifact).as_posix()
        if file.suffix == ".json":
            value = renamed(json.loads(file.read_text()), NAMES.get(file.name, {}))
            if isinstance(value, dict):
                value = {key: entry for key, entry in value.items() if f"{name}:{key}" not in options.ignored}
            found[name] = value
        else:
            found[name] = file.read_bytes()
    return found


MISSING = object()


def unequal(before, after, path: str) -> list[str]:
    """Returns the paths at which two values differ; for JSON also both values."""
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
    """Returns whether both builds give equal artifacts for an experiment; prints the differences."""
    words = EXPERIMENTS[name].replace("DATA", str(options.data.resolve())).split()
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        old = artifacts(options.old, pathlib.Path(one), words)
        new = artifacts(options.new, pathlib.Path(other), words)
        differences, compared = sorted(old.keys() ^ new.keys()), 0
        for label in sorted(old.keys() & new.keys()):
            before, after = files(old[label], options), files(new[label], options)
            compared += len(after)
            differences += unequal(before, after, f"{label}:")
    what = f"{len(differences)} differences" if differences else "equal"
    print(f"{name}: {compared} files of {len(new)} artifacts: {what}", *differences, sep="\n  ", flush=True)
    return not differences


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=pathlib.Path, help="work tree of the old build")
    parser.add_argument("new", type=pathlib.Path, help="work tree of the new build")
    parser.add_argument("--data", type=pathlib.Path, default=pathlib.Path("../shared/data"), help="folder with the scenes (default ../shared/data)")
    parser.add_argument("--only", nargs="+", choices=EXPERIMENTS, default=list(EXPERIMENTS), help="experiments to compare (default all)")
    parser.add_argument("--ignored", nargs="*", default=[], metavar="FILE:KEY", help="JSON keys that are not compared")
    options = parser.parse_args()
    return 0 if all([compare(name, options) for name in options.only]) else 1


if __name__ == "__main__":
    sys.exit(main())
