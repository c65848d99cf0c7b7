#!/usr/bin/env python3
"""Compares time and quality of two builds' engines on withheld training views, one after the other in one run.

compare-engines.py OLD NEW [--data DIR] [--only NAME ...] [--rays FACTOR ... | --budgets] [--seeds N] [--picture FILE.svg]

OLD and NEW are work trees, each built by `make build`. OLD prepares each scene, NEW scores the views of both; the build that trains
first alternates between seeds and between factors. With several factors of the rays, --picture draws PSNR against training time.
--budgets reads rays and other parameters from each build's own protocols (experiments/common.yaml). Times are wall-clock times;
processor time, which depends less on other load, follows in brackets and is the picture's axis. Depth error is the mean of the views'
median errors in scene units, if true depth is known; seen is the share of pixels whose depth agrees with a neighbouring view's.
LPIPS needs DATA/weights.
"""

import argparse
import itertools
import json
import os
import pathlib
import re
import statistics
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

# Data set (None: the demo scene with a backdrop), LR width, scale, and rays of one field.
SCENES = {
    "lego 100x2": ("nerf_synthetic/lego", 100, 2, 2_000_000),
    "lego 200x4": ("nerf_synthetic/lego", 200, 4, 2_000_000),
    "fern 252x4": ("nerf_llff_data/fern", 252, 4, 2_000_000),
    "demo with backdrop": (None, 100, 2, 1_500_000),
    "lego 100x4": ("nerf_synthetic/lego", 100, 4, 2_000_000),
    "lego 200x2": ("nerf_synthetic/lego", 200, 2, 2_000_000),
    "fern 252x2": ("nerf_llff_data/fern", 252, 2, 2_000_000),
}
# Default scenes, except with --budgets.
SHORT = ["lego 100x2", "lego 200x4", "fern 252x4", "demo with backdrop"]
# Default scenes with --budgets; the last word of a name is its protocol in experiments/common.yaml.
PROTOCOLS = [name for name, (dataset, *_) in SCENES.items() if dataset]


class Cost(NamedTuple):
    """Cost of a stage: wall-clock seconds, processor seconds, and peak memory in MiB."""

    seconds: float
    processor: float
    memory: int

    def words(self) -> str:
        return f"{self.seconds:.1f} s ({self.processor:.1f} s)"


def run(tree: pathlib.Path, stage: str, folder: pathlib.Path, output: str, inputs: dict[str, str], params: dict) -> Cost:
    """Runs a stage of a build and returns its cost; exits if the stage fails."""
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
    return Cost(time.monotonic() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss // 1024)


def prepare(options: argparse.Namespace, folder: pathlib.Path, name: str) -> None:
    """Prepares a scene with the old build, in `folder/scene`."""
    dataset, width, scale, _ = SCENES[name]
    source = folder / "dataset"
    if dataset is None:
        run(options.old, "demo-scene", folder, "dataset", {}, {"backdrop": True})
    elif (options.data / dataset / "transforms_train.json").exists():
        subprocess.run([options.old / "scripts/hold-out.py", options.data / dataset, source], check=True, stdout=subprocess.DEVNULL)
    else:
        source.symlink_to((options.data / dataset).resolve())
    run(options.old, "prep", folder, "scene", {"dataset": "dataset"}, {"lr_width": width, "scale": scale, "test_views": 12})


class Result(NamedTuple):
    """Scores and costs of one training by a build."""

    scene: str
    build: str
    seed: int
    rays: int
    psnr: float
    ssim: float
    lpips: float | None
    depth_error: float | None
    seen: float | None
    training: Cost
    rendering: Cost

    def line(self) -> str:
        memory = max(self.training.memory, self.rendering.memory)
        others = " | ".join("" if value is None else f"{value:.4f}" for value in (self.lpips, self.depth_error, self.seen))
        figures = f"{self.psnr:.3f} | {self.ssim:.4f} | {others} | {self.training.words()} | {self.rendering.words()} | {memory} MiB"
        return f"| {self.scene} | {self.build} | {self.seed} | {self.rays / 1e6:g} M | {figures} | {os.getloadavg()[0]:.1f} |"


def protocol(tree: pathlib.Path, name: str) -> dict[str, dict[str, int]]:
    """Returns each stage's parameters in the build's protocol for a scene."""
    width_and_scale = name.split()[-1]
    preset = re.search(rf"^    {width_and_scale}:(.*?)^    \S", (tree / "experiments/common.yaml").read_text(), re.DOTALL | re.MULTILINE)
    params = {}
    for stage, key, value in re.findall(r"([a-z-]+)\.(\w+): (\d+)", preset[1] if preset else ""):
        params.setdefault(stage, {})[key] = int(value)
    if "rays" not in params.get("train-ss", {}):
        sys.exit(f"{tree}/experiments/common.yaml: protocol {width_and_scale} of {name} has no train-ss.rays")
    return params


def measure(options: argparse.Namespace, folder: pathlib.Path, name: str, build: str, seed: int, factor: float) -> Result:
    """Trains and renders a scene with one build and scores the views with the new build."""
    _, _, scale, rays = SCENES[name]
    tree = getattr(options, build)
    own = protocol(tree, name) if options.budgets else {"train-ss": {"rays": int(rays * factor)}}
    rays = own["train-ss"].pop("rays")
    params = {"rays": rays, "supersample": scale, "seed": seed} | own["train-ss"]
    at = f"{build}-{seed}-{rays}"
    training = run(tree, "train-ss", folder, f"{at}/field", {"scene": "scene/train"}, params)
    rendering = run(tree, "render-depth", folder, f"{at}/views", {"field": f"{at}/field", "cameras": "scene/truth"}, own.get("render-depth", {}))
    weights = (options.data / "weights").resolve()
    inputs = {"views": f"{at}/views", "truth": "scene/truth"} | ({"weights": str(weights)} if weights.is_dir() else {})
    run(options.new, "eval", folder, f"{at}/eval", inputs, {})
    mean = json.loads((folder / at / "eval/metrics.json").read_text())["mean"]
    depth_error, seen = mean.get("depth", {}).get("median_absolute"), mean.get("warp", {}).get("seen")
    return Result(name, build, seed, rays, mean["psnr"], mean["ssim"], mean.get("lpips"), depth_error, seen, training, rendering)


WIDTH, HEIGHT, LEFT, TOP, BETWEEN = 420, 300, 52, 30, 30
COLOURS = {"old": "#8a8a8a", "new": "#c2410c"}


def picture(results: list[Result]) -> str:
    """Returns an SVG of PSNR against training time: one panel per scene, one curve per build, seeds averaged."""
    scenes = list(dict.fromkeys(result.scene for result in results))
    panels = "".join(panel(scene, [r for r in results if r.scene == scene], i * (WIDTH + BETWEEN)) for i, scene in enumerate(scenes))
    width = len(scenes) * (WIDTH + BETWEEN) - BETWEEN
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {HEIGHT}" font-family="sans-serif" font-size="12">'
            f'<rect width="{width}" height="{HEIGHT}" fill="#fff"/>{panels}</svg>\n')


def panel(scene: str, results: list[Result], left: int) -> str:
    """Returns one scene's curves as SVG, `left` units from the left edge."""
    curves = {build: [] for build in COLOURS}
    for build, rays in dict.fromkeys((r.build, r.rays) for r in results):
        seeds = [r for r in results if (r.build, r.rays) == (build, rays)]
        curves[build].append((statistics.mean(r.training.processor for r in seeds), statistics.mean(r.psnr for r in seeds)))
    points = [point for curve in curves.values() for point in curve]
    longest = max(seconds for seconds, _ in points) * 1.05
    low, high = (pick(psnr for _, psnr in points) for pick in (min, max))
    low, high = low - 0.1 * (high - low) - 0.02, high + 0.1 * (high - low) + 0.02

    def place(seconds: float, psnr: float) -> tuple[float, float]:
        return (left + LEFT + seconds / longest * (WIDTH - LEFT - 10), HEIGHT - 40 - (psnr - low) / (high - low) * (HEIGHT - 40 - TOP))

    parts = [f'<text x="{left + LEFT}" y="18" font-weight="bold">{scene}: PSNR in dB</text>']
    for share in (0, 0.5, 1):
        x, y = place(longest * share, low + (high - low) * share)
        parts.append(f'<line x1="{left + LEFT}" x2="{left + WIDTH - 10}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>')
        parts.append(f'<text x="{left + LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{low + (high - low) * share:.1f}</text>')
        anchor = "end" if share == 1 else "middle"
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 22}" text-anchor="{anchor}">{longest * share:.0f}</text>')
    parts.append(f'<text x="{left + (LEFT + WIDTH) / 2}" y="{HEIGHT - 6}" text-anchor="middle">processor seconds of training</text>')
    for build, curve in curves.items():
        places = [place(*point) for point in sorted(curve)]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{COLOURS[build]}" stroke-width="2"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{COLOURS[build]}"/>' for x, y in places]
        x, y = places[-1]
        parts.append(f'<text x="{x:.1f}" y="{y - 8:.1f}" text-anchor="end" fill="{COLOURS[build]}">{build}</text>')
    return "".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=pathlib.Path, help="work tree of the old build")
    parser.add_argument("new", type=pathlib.Path, help="work tree of the new build")
    parser.add_argument("--data", type=pathlib.Path, default=pathlib.Path("../shared/data"), help="folder with the scenes (default ../shared/data)")
    parser.add_argument("--only", nargs="*", choices=SCENES, help=f"scenes to compare (default {', '.join(SHORT)}; with --budgets all except the demo scene)")
    rays = parser.add_mutually_exclusive_group()
    rays.add_argument("--rays", type=float, nargs="+", default=[1.0], help="factors by which the number of rays is multiplied (default 1)")
    rays.add_argument("--budgets", action="store_true", help="use the rays and other parameters of each build's own protocols")
    parser.add_argument("--picture", type=pathlib.Path, help="write an SVG of PSNR against training time")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds (default 1)")
    options = parser.parse_args()
    names = options.only or (PROTOCOLS if options.budgets else SHORT)
    if options.budgets:
        # A missing protocol must fail before hours of training.
        for tree, name in itertools.product((options.old, options.new), names):
            protocol(tree, name)
    print("| scene | build | seed | rays | PSNR | SSIM | LPIPS | depth error | seen | training (processor) | rendering (processor) | peak memory | load |\n" + "| --- " * 13 + "|")
    results = []
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            prepare(options, pathlib.Path(folder), name)
            for seed, (turn, factor) in itertools.product(range(1, options.seeds + 1), enumerate(options.rays, 1)):
                for build in ("old", "new") if (seed + turn) % 2 == 0 else ("new", "old"):
                    results.append(measure(options, pathlib.Path(folder), name, build, seed, factor))
                    print(results[-1].line(), flush=True)
    if options.picture:
        options.picture.write_text(picture(results))


if __name__ == "__main__":
    main()
