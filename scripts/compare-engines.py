#!/usr/bin/env python3
"""Compares what two builds' engines cost and bring, on withheld training views, one after the other in one run.

compare-engines.py OLD NEW [--data DIR] [--only NAME ...] [--rays FACTOR] [--seeds N]

OLD and NEW are work trees, each built by `make build`. OLD prepares each scene and scores the views of both.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

# Data set (None is the demo scene with a backdrop), LR width, scale, rays of one field.
SCENES = {
    "lego 100x2": ("nerf_synthetic/lego", 100, 2, 2_000_000),
    "lego 200x4": ("nerf_synthetic/lego", 200, 4, 2_000_000),
    "fern 252x4": ("nerf_llff_data/fern", 252, 4, 2_000_000),
    "demo with backdrop": (None, 100, 2, 1_500_000),
}


def run(tree: pathlib.Path, stage: str, folder: pathlib.Path, output: str, inputs: dict[str, str], params: dict) -> tuple[float, int]:
    """Runs a stage of a build; returns its seconds and its peak memory in MiB."""
    (folder / "params.json").write_text(json.dumps(params))
    words = [f"--input={name}={folder / path}" for name, path in inputs.items()]
    begin = time.monotonic()
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            [tree / f"target/release/{stage}", "--output", folder / output, "--params", folder / "params.json", "--progress", "none", *words],
            env=os.environ | {"LD_LIBRARY_PATH": str(tree / ".libtorch/lib")}, stdout=log, stderr=log)
        _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{stage} failed: {(folder / 'log').read_text()[-500:]}")
    return time.monotonic() - begin, usage.ru_maxrss // 1024


def prepare(options: argparse.Namespace, folder: pathlib.Path, name: str) -> None:
    dataset, width, scale, _ = SCENES[name]
    source = folder / "dataset"
    if dataset is None:
        run(options.old, "demo-scene", folder, "dataset", {}, {"backdrop": True})
    elif (options.data / dataset / "transforms_train.json").exists():
        subprocess.run([options.old / "scripts/hold-out.py", options.data / dataset, source], check=True, stdout=subprocess.DEVNULL)
    else:
        source.symlink_to((options.data / dataset).resolve())
    run(options.old, "prep", folder, "scene", {"dataset": "dataset"}, {"lr_width": width, "scale": scale, "test_views": 12})


def measure(options: argparse.Namespace, folder: pathlib.Path, name: str, build: str, seed: int) -> str:
    _, _, scale, rays = SCENES[name]
    params = {"field": {"grid": {"rays": int(rays * options.rays)}}, "supersample": scale, "seed": seed}
    tree, at = getattr(options, build), f"{build}-{seed}"
    training, memory = run(tree, "train-ss", folder, f"{at}/field", {"scene": "scene/train"}, params)
    rendering, most = run(tree, "render-depth", folder, f"{at}/views", {"field": f"{at}/field", "cameras": "scene/truth"}, {})
    run(options.old, "eval", folder, f"{at}/eval", {"views": f"{at}/views", "truth": "scene/truth"}, {})
    mean = json.loads((folder / at / "eval/metrics.json").read_text())["mean"]
    figures = f"{mean['psnr']:.3f} | {mean['ssim']:.4f} | {training:.1f} s | {rendering:.1f} s | {max(memory, most)} MiB"
    return f"| {name} | {build} | {seed} | {figures} | {os.getloadavg()[0]:.1f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=pathlib.Path)
    parser.add_argument("new", type=pathlib.Path)
    parser.add_argument("--data", type=pathlib.Path, default=pathlib.Path("../shared/data"), help="scenes (default ../shared/data)")
    parser.add_argument("--only", nargs="*", choices=SCENES, default=list(SCENES), help="which scenes (default all)")
    parser.add_argument("--rays", type=float, default=1.0, help="factor of the rays")
    parser.add_argument("--seeds", type=int, default=1, help="seeds of each training")
    options = parser.parse_args()
    print("| scene | build | seed | PSNR | SSIM | training | rendering | peak memory | load |\n" + "| --- " * 9 + "|")
    for name in options.only:
        with tempfile.TemporaryDirectory() as folder:
            prepare(options, pathlib.Path(folder), name)
            for seed in range(1, options.seeds + 1):
                for build in ("old", "new"):
                    print(measure(options, pathlib.Path(folder), name, build, seed), flush=True)


if __name__ == "__main__":
    main()
