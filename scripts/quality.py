#!/usr/bin/env python3
"""Runs protocols on scenes and tabulates them: `make quality`.

A cell is a scene, a protocol (LR width × scale) and a supervision. Cells go through the ordinary pipeline, one after the
other, so that their times don't disturb each other; what is in the store isn't run again, so an interrupted table goes on
where it was. After every cell OUT (one JSON array) is written anew, and at the end a Markdown table is printed.
"""

import argparse
import json
import pathlib
import subprocess
import sys

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--data", type=pathlib.Path, required=True, help="folder with nerf_synthetic/SCENE (or SCENE) and weights")
parser.add_argument("--scenes", nargs="+", default=["lego", "chair"])
parser.add_argument("--protocols", nargs="+", default=["100x2", "100x4", "200x2", "200x4"], help="LR width x scale")
parser.add_argument("--supervision", nargs="+", default=["average", "kernel"])
parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/quality.json"))
parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further parameters for every cell")
parser.add_argument("--nerf-sr", default="target/release/nerf-sr")
options = parser.parse_args()


def cell(scene: str, protocol: str, supervision: str) -> dict:
    """Runs one cell and reads its figures."""
    lr, scale = protocol.split("x")
    dataset = options.data / "nerf_synthetic" / scene
    if not dataset.is_dir():
        dataset = options.data / scene
    if not dataset.is_dir():
        sys.exit(f"quality: no scene {scene} in {options.data}: set DATA=DIR to a folder that has it")
    page = options.out.parent / "quality" / f"{scene}-{protocol}-{supervision}"
    command = [options.nerf_sr, "run", "-j", "1", "--out", page, "-i", f"dataset={dataset}"]
    if (options.data / "weights").is_dir():
        command += ["-i", f"weights={options.data / 'weights'}"]
    settings = [f"lr={lr}", f"prep.scale={scale}", f"supervision={supervision}", "rays=null", *options.set]
    command += [word for setting in settings for word in ("-p", setting)]
    print(f"== {scene} {protocol} {supervision}", flush=True)
    done = subprocess.run([str(word) for word in command])
    if done.returncode != 0:
        sys.exit(done.returncode)
    (row,) = json.loads((page / "report" / "results.json").read_text())
    train, render = row["stages"]["train-ss"], row["stages"]["render-depth"]
    rays = json.loads((pathlib.Path(train["folder"]) / "training.json").read_text())["rays"]
    return {
        "scene": scene,
        "protocol": protocol,
        "supervision": supervision,
        "psnr": row["mean"]["psnr"],
        "ssim": row["mean"]["ssim"],
        "lpips": row["mean"].get("lpips"),
        "train_s": train["seconds"],
        "render_s": render["seconds"],
        "rays_per_s": rays / train["seconds"],
    }


def line(row: dict) -> str:
    lpips = "–" if row["lpips"] is None else f"{row['lpips']:.4f}"
    return (
        f"| {row['protocol']} | {row['scene']} | {row['supervision']} | {row['psnr']:.2f} | {row['ssim']:.4f} | {lpips} "
        f"| {row['train_s'] / 60:.1f} min | {row['render_s']:.1f} s | {row['rays_per_s'] / 1000:.0f} k |"
    )


rows = []
options.out.parent.mkdir(parents=True, exist_ok=True)
for protocol in options.protocols:
    for supervision in options.supervision:
        for scene in options.scenes:
            rows.append(cell(scene, protocol, supervision))
            partial = options.out.with_suffix(".partial")
            partial.write_text(json.dumps(rows, indent=2) + "\n")
            partial.replace(options.out)

print("| LR × scale | scene | supervision | PSNR | SSIM | LPIPS | training | rendering | rays/s |")
print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
for protocol in options.protocols:
    for supervision in options.supervision:
        mine = [row for row in rows if (row["protocol"], row["supervision"]) == (protocol, supervision)]
        for row in mine:
            print(line(row))
        mean = {key: sum(row[key] for row in mine) / len(mine) for key in ("psnr", "ssim", "train_s", "render_s", "rays_per_s")}
        known = all(row["lpips"] is not None for row in mine)
        mean |= {"protocol": protocol, "supervision": supervision, "scene": f"**mean of {len(mine)}**"}
        mean["lpips"] = sum(row["lpips"] for row in mine) / len(mine) if known else None
        print(line(mean))
