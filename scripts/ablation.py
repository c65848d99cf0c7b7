#!/usr/bin/env python3
"""What each part brings and costs: `make ablation`; PSNR against training time: `make tradeoff`; ten seeds: `make seeds`.

The first two train on scenes with training views withheld (scripts/hold-out.py) and score those, so that choices made by these
tables don't look at test views; `seeds` takes the demo scene. What is in the store isn't run again. OUT gets one JSON array; a
Markdown table is printed, and for `tradeoff` a curve is drawn beside OUT as SVG.
"""

import argparse
import math
import pathlib
import statistics
import subprocess
import sys

import cells

# A part, and the parameters that take it away or put something else in its place; those that matter most first.
PARTS = [
    ("as it is", []),
    ("supervision: average", ["supervision=average"]),
    ("all pixels drawn alike", ["pixel_importance=1"]),
    ("no supersampling", ["supersample=1"]),
    ("all sub-pixel rays from the start", ["supersample_warmup=0"]),
    ("no weight averaging", ["ema_decay=0"]),
    ("one ray a rendered pixel", ["render-depth.samples_per_axis=1"]),
    ("networks 32 wide", ["hidden_dim=32"]),
    ("two fields, half the rays each", ["ensemble=2"]),
    ("supervision: refiltered", ["supervision=refiltered"]),
    ("detail drawn 30 times as often", ["pixel_importance=30"]),
    ("3×3 sub-pixel rays", ["supersample=3"]),
    ("3×3 rays a rendered pixel", ["render-depth.samples_per_axis=3"]),
    ("tables of 2^15", ["log2_hashmap_size=15"]),
    ("tables of 2^19", ["log2_hashmap_size=19"]),
    ("finest level 512", ["max_resolution=512"]),
    ("grid rate 1e-2", ["learning_rate=0.01"]),
    ("network rate 4e-2", ["mlp_learning_rate=0.04"]),
    ("32,768 samples a step", ["samples_per_step=32768"]),
    ("131,072 samples a step", ["samples_per_step=131072", "max_rays_per_step=8192"]),
    ("256 steps along the diagonal", ["march_steps=256"]),
    ("no averaging, final rate 0.02", ["ema_decay=0", "learning_rate_decay=0.02"]),
    ("distortion loss 0.01", ["distortion=0.01"]),
    ("no floater loss", ["floater_loss=0"]),
    ("all levels' rates alike", ["level_rate=1"]),
    ("no weight decay", ["network_decay=0"]),
    ("alpha supervision, averaged", ["background=alpha"]),
    ("alpha hull", ["hull=alpha"]),
]
# Rays of the curve's points: about 15 seconds to 20 minutes on two cores.
CURVE = [750_000, 1_500_000, 3_000_000, 6_000_000, 12_000_000, 24_000_000, 96_000_000]

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("table", choices=["ablation", "tradeoff", "seeds"])
parser.add_argument("--data", type=pathlib.Path, help="folder with nerf_synthetic/SCENE (or SCENE)")
parser.add_argument("--scenes", nargs="+", default=["lego", "chair"])
parser.add_argument("--protocol", default="100x2", help="LR width x scale")
parser.add_argument("--rays", type=int, default=12_000_000, help="rays of each training of the ablation")
parser.add_argument("--variants", type=int, help="only the first so many rows")
parser.add_argument("--out", type=pathlib.Path, required=True)
parser.add_argument("--nerf-sr", default="target/release/nerf-sr")
options = parser.parse_args()

lr, scale = options.protocol.split("x")
base = [f"lr_width={lr}", f"prep.scale={scale}"]
if options.table == "ablation":
    variants = [(name, [*base, f"rays={options.rays}", *settings]) for name, settings in PARTS]
elif options.table == "tradeoff":
    variants = [(f"{rays / 1e6:g} M rays", [*base, f"rays={rays}"]) for rays in CURVE]
else:
    variants = [(f"seed {seed}", [f"train-ss.seed={seed}", f"rays={options.rays}"]) for seed in range(10)]

variants = variants[: options.variants]

# The scenes' folders; none for the demo scene.
scenes: dict[str, pathlib.Path | None] = {"demo": None} if options.table == "seeds" else {}
for scene in [] if options.table == "seeds" else options.scenes:
    if not options.data:
        parser.error("--data is needed")
    held_out = options.out.parent / "held-out" / scene
    source = cells.dataset(options.data, scene)
    script = pathlib.Path(__file__).with_name("hold-out.py")
    subprocess.run([sys.executable, script, source, held_out], check=True, stdout=subprocess.DEVNULL)
    scenes[scene] = held_out

rows = []
for name, settings in variants:
    for scene, folder in scenes.items():
        page = options.out.parent / options.table / scene
        rows.append({"variant": name, "scene": scene} | cells.run(options.nerf_sr, page, folder, settings))
        cells.write(options.out, rows)


def means(name: str) -> dict:
    return cells.mean([row for row in rows if row["variant"] == name])


first = means(variants[0][0])
if options.table == "seeds":
    print("The demo scene's test views:\n")
else:
    print(f"Withheld training views of {', '.join(scenes)}, {options.protocol}, means:\n")
print("| variant | PSNR | against the first | SSIM | training | samples a ray | rendering |")
print("| --- | --- | --- | --- | --- | --- | --- |")
for name, _ in variants:
    row = means(name)
    print(
        f"| {name} | {row['psnr']:.2f} | {row['psnr'] - first['psnr']:+.2f} | {row['ssim']:.4f} | {row['train_s']:.0f} s "
        f"| {row['samples_per_ray']:.1f} | {row['render_s']:.1f} s |"
    )

if options.table == "seeds":
    scores = [row["psnr"] for row in rows]
    spread = statistics.stdev(scores) if len(scores) > 1 else 0.0
    print(f"\nPSNR over seeds: {statistics.mean(scores):.2f} ± {spread:.2f} dB, from {min(scores):.2f} to {max(scores):.2f}")

if options.table == "tradeoff":
    points = [(means(name)["train_s"], means(name)["psnr"]) for name, _ in variants]
    low, high = math.floor(min(p for _, p in points)), math.ceil(max(p for _, p in points))
    left, right = math.log2(min(t for t, _ in points)), math.log2(max(t for t, _ in points))
    x = lambda t: 90 + 510 * (math.log2(t) - left) / max(right - left, 1e-9)
    y = lambda p: 330 - 300 * (p - low) / max(high - low, 1e-9)
    parts = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 660 390" font-family="sans-serif" font-size="13">']
    parts.append('<rect width="660" height="390" fill="white"/>')
    for p in range(low, high + 1):
        parts.append(f'<path d="M60 {y(p):.1f}H620" stroke="#ddd"/><text x="52" y="{y(p) + 4:.1f}" text-anchor="end">{p}</text>')
    for (t, _), (name, _) in zip(points, variants):
        label = f"{t:.0f} s" if t < 90 else f"{t / 60:.1f} min"
        parts.append(f'<text x="{x(t):.1f}" y="352" text-anchor="middle">{label}</text>')
    line = " ".join(f"{x(t):.1f},{y(p):.1f}" for t, p in points)
    parts.append(f'<polyline points="{line}" fill="none" stroke="#1b6ca8" stroke-width="2"/>')
    for t, p in points:
        parts.append(f'<circle cx="{x(t):.1f}" cy="{y(p):.1f}" r="4" fill="#1b6ca8"/>')
        parts.append(f'<text x="{x(t):.1f}" y="{y(p) - 9:.1f}" text-anchor="middle">{p:.2f}</text>')
    parts.append('<text x="340" y="378" text-anchor="middle">training time (log)</text><text x="60" y="18">PSNR, dB</text></svg>')
    drawing = options.out.with_suffix(".svg")
    drawing.write_text("\n".join(parts) + "\n")
    print(f"\nThe curve: {drawing}")
