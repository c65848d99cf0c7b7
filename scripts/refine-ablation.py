#!/usr/bin/env python3
"""What each part of refinement brings: `make refine-ablation`.

A refiner is trained for each row, and scored as its training ends, by views of the downscaled field that it left out: at LR size, where LR images are the
truth, so that choices made by this table look at no HR image and at no test view. References are other views of that field.

Rows of the paper's network follow, whose parts ours doesn't have: perceptual loss, several reference patches, patches that overlap. They are scored at HR on
the test views, by a network of a quarter of the published width and by few steps: what a part brings there, not what the published training reaches.

What is in the store isn't run again. After every row OUT (one JSON array) is written anew; at the end Markdown tables are printed.
"""

import argparse
import json
import pathlib
import subprocess
import sys

import cells
import protocols

# A part, and the parameters that take it away or put something else in its place.
ONE = "train-refine.references_per_view=1"
PARTS = [
    ("one reference", [ONE]),
    ("no reference", ["train-refine.references_per_view=0"]),
    ("one reference, no occlusion test", [ONE, "train-refine.occlusion=false"]),
    ("one reference, aligned", [ONE, "train-refine.alignment=true"]),
    ("one reference, expected depth", [ONE, "downscaled-views.depth=expected"]),
    ("one reference, lens ignored", [ONE, "prep.lens=ignore"]),
    ("two references", ["train-refine.references_per_view=2"]),
    ("four references", ["train-refine.references_per_view=4"]),
    ("eight references", ["train-refine.references_per_view=8"]),
    ("one reference, 16 features", [ONE, "train-refine.features=16"]),
    ("one reference, two blocks", [ONE, "train-refine.blocks=2"]),
]
# The same of the paper's network, with or without the perceptual loss; and its size, unless --set says another.
PAPER_PARTS = [
    ("paper's network", [], True),
    ("patches side by side", ["refine-paper.overlap=0"], True),
    ("L1 alone, no perceptual loss", [], False),
    ("one reference patch", ["train-paper.patches=1"], True),
]
PAPER_SIZE = {"train-paper.features": 32, "train-paper.batch": 8}

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--data", type=pathlib.Path, required=True, help="folder with nerf_llff_data/SCENE, nerf_synthetic/SCENE (or SCENE)")
parser.add_argument("--scenes", nargs="+", default=["fern"])
parser.add_argument("--protocol", default="252x4", help="LR width x scale")
parser.add_argument("--split", choices=["given", "paper", "holdout"], help="which views are for testing (default: as the data say)")
parser.add_argument("--steps", type=int, default=2000, help="steps of each training")
parser.add_argument("--paper-steps", type=int, default=400, help="steps of each training of the paper's network; 0 leaves its rows out")
parser.add_argument("--variants", type=int, help="only the first so many rows of our network")
parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/refine-ablation.json"))
parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further parameters for every row")
parser.add_argument("--nerf-sr", default="target/release/nerf-sr")
options = parser.parse_args()


def trained(scene: str, settings: list[str]) -> dict:
    """What a refiner's training says of it."""
    chosen = protocols.settings(options.protocol, "kernel", refined=True)
    chosen |= {"train-refine.steps": options.steps} | ({"split": options.split} if options.split else {})
    chosen |= dict(setting.split("=", 1) for setting in [*options.set, *settings])
    wanted = ["train-refine", "-i", f"dataset={cells.dataset(options.data, scene)}"]
    # Those of the field that isn't trained here mean nothing.
    wanted += [word for name, value in chosen.items() if name not in ("rays", "ensemble") for word in ("-p", f"{name}={value}")]
    cells.call([options.nerf_sr, "run", *wanted])
    status = subprocess.run([options.nerf_sr, "status", *map(str, wanted)], check=True, capture_output=True, text=True).stdout
    line = next(line for line in status.splitlines() if line.split()[:1] == ["train-refine"])
    start = line.split("cached")[1].split()[0]
    (folder,) = pathlib.Path(".nerf-sr/objects").glob(f"{start}*")
    return json.loads((folder / "refiner.json").read_text())


def paper_refined(scene: str, settings: list[str], perceptual: bool) -> tuple[dict, dict]:
    """Figures of the test views as rendered, and as the paper's network redraws them."""
    chosen = protocols.settings(options.protocol, "kernel", refined=False) | PAPER_SIZE
    chosen |= {"prep.hr_references": 1, "train-paper.steps": options.paper_steps}
    chosen |= {"split": options.split} if options.split else {}
    chosen |= dict(setting.split("=", 1) for setting in [*options.set, *settings])
    settings = [f"{name}={value}" for name, value in chosen.items() if not name.startswith("downscaled")]
    weights = options.data / "weights"
    inputs = {"train-paper.weights": weights} if perceptual and weights.is_dir() else {}
    page = options.out.parent / "refine-ablation" / scene
    rendered, redrawn = cells.run_target("paper-refine", options.nerf_sr, page, cells.dataset(options.data, scene), settings, weights, inputs)
    return rendered, redrawn


rows: list[dict] = []
for name, settings in PARTS[: options.variants]:
    for scene in options.scenes:
        print("==", scene, name, flush=True)
        file = trained(scene, settings)
        rows.append({"variant": name, "scene": scene, "rendered": file["rendered_psnr"], "refined": file["refined_psnr"]})
        cells.write(options.out, rows)

if rows:
    print(f"Downscaled views left out, {', '.join(options.scenes)}, {options.protocol}, {options.steps} steps, means:\n")
    print("| variant | rendered | refined | gain | against the first |")
    print("| --- | --- | --- | --- | --- |")
    of = lambda name: [row for row in rows if row["variant"] == name]
    gain = lambda name: sum(row["refined"] - row["rendered"] for row in of(name)) / len(of(name))
    for name, _ in PARTS[: options.variants]:
        mean = cells.mean(of(name))
        print(f"| {name} | {mean['rendered']:.2f} | {mean['refined']:.2f} | {gain(name):+.2f} | {gain(name) - gain(PARTS[0][0]):+.2f} |")

if options.paper_steps:
    paper: list[dict] = []
    for name, settings, perceptual in PAPER_PARTS:
        for scene in options.scenes:
            print("==", scene, name, flush=True)
            for variant, row in zip(("rendered", name), paper_refined(scene, settings, perceptual)):
                scores = {key: row[key] for key in ("psnr", "ssim", "lpips")}
                paper += [kept] if (kept := {"variant": variant, "scene": scene, **scores}) not in paper else []
            cells.write(options.out, rows + paper)
    print(f"\nTest views, {', '.join(options.scenes)}, {options.protocol}, {options.paper_steps} steps of the paper's network at a quarter of its width, means:\n")
    print("| variant | PSNR | SSIM | LPIPS |")
    print("| --- | --- | --- | --- |")
    for name in ["rendered", *(name for name, *_ in PAPER_PARTS)]:
        mean = cells.mean([row for row in paper if row["variant"] == name])
        lpips = f"{mean['lpips']:.4f}" if "lpips" in mean else "–"
        print(f"| {name} | {mean['psnr']:.2f} | {mean['ssim']:.4f} | {lpips} |")
