#!/usr/bin/env python3
"""Runs protocols on scenes and tabulates them: `make quality`.

A cell is a scene, a protocol (LR width x scale) and a supervision. Cells go through the ordinary pipeline, one after the
other, so that their times don't disturb each other; what is in the store isn't run again, so an interrupted table goes on
where it was. After every cell OUT (one JSON array) is written anew, and at the end a Markdown table is printed.
"""

import argparse
import itertools
import pathlib

import cells
import protocols

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--data", type=pathlib.Path, required=True, help="folder with nerf_synthetic/SCENE (or SCENE) and weights")
parser.add_argument("--scenes", nargs="+", default=["lego", "chair"])
parser.add_argument("--protocols", nargs="+", default=["100x2", "100x4", "200x2", "200x4"], help="LR width x scale")
parser.add_argument("--supervision", nargs="+", default=["average", "kernel"])
parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/quality.json"))
parser.add_argument("--split", choices=["given", "paper", "holdout"], help="which views are for testing (default: as the data say)")
parser.add_argument("--refined", action="store_true", help="a second row for every cell: its views refined")
parser.add_argument("--enlarged", action="store_true", help="a third: means of those and of photographs that IMDN enlarged (needs its weights)")
parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further parameters for every cell")
parser.add_argument("--nerf-sr", default="target/release/nerf-sr")
options = parser.parse_args()

# A cell's rows: the target that adds each to those before it, what it is of, and what tells them apart.
ROWS = [
    ("report", "", {"refined": False, "enlarged": False}),
    ("refined", ", refined", {"refined": True, "enlarged": False}),
    ("sisr-fuse", ", refined, with enlarged photographs", {"refined": True, "enlarged": True}),
][: 3 if options.enlarged else 2 if options.refined else 1]
TARGET = ROWS[-1][0]


def cell(scene: str, protocol: str, supervision: str) -> list[dict]:
    page = options.out.parent / "quality" / "-".join([scene, protocol, supervision] + [options.split] * bool(options.split))
    chosen = protocols.settings(protocol, supervision, refined=TARGET != "report")
    chosen |= {"split": options.split} if options.split else {}
    chosen |= dict(setting.split("=", 1) for setting in options.set)
    settings = [f"{name}={value}" for name, value in chosen.items()]
    folder = cells.dataset(options.data, scene)
    weights = options.data / "weights"
    inputs = {"upsample.weights": weights} if options.enlarged and weights.is_dir() else {}
    results = cells.run_target(TARGET, options.nerf_sr, page, folder, settings, weights, inputs)
    name = {"scene": scene, "protocol": protocol, "supervision": supervision}
    name |= {"split": options.split} if options.split else {}
    return [name | kind | row for (_, _, kind), row in zip(ROWS, results)]


def line(name: str, protocol: str, views: str, row: dict) -> str:
    lpips = f"{row['lpips']:.4f}" if row.get("lpips") is not None else "–"
    return (
        f"| {protocol} | {name} | {row['supervision']}{views} | {row['psnr']:.2f} | {row['ssim']:.4f} | {lpips} "
        f"| {row['train_s'] / 60:.1f} min | {row['render_s']:.1f} s | {row['rays_per_s'] / 1000:.0f} k |"
    )


rows = []
for protocol in options.protocols:
    for supervision in options.supervision:
        for scene in options.scenes:
            rows += cell(scene, protocol, supervision)
            cells.write(options.out, rows)

print("| LR × scale | scene | supervision | PSNR | SSIM | LPIPS | training | rendering | rays/s |")
print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
for protocol in options.protocols:
    for supervision, (_, views, kind) in itertools.product(options.supervision, ROWS):
        kind = {"protocol": protocol, "supervision": supervision} | kind
        mine = [row for row in rows if kind.items() <= row.items()]
        for row in mine:
            print(line(row["scene"], protocol, views, row))
        if len(mine) > 1:
            print(line(f"**mean of {len(mine)}**", protocol, views, cells.mean(mine) | kind))
