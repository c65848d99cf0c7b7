#!/usr/bin/env python3
"""The paper's tables with every method in them: `make table`.

Rows are methods, columns protocols (LR width x scale), figures means over scenes. A cell's methods share what they can (the LR images, plain
NeRF's field), and what is in the store isn't run again. OUT is the Markdown file; beside it come .csv, .json and .html, the page, with
links to a page of images for each scene and protocol.

Methods:
    nerf          plain NeRF (a ray a pixel), rendered at HR, with as many rays as ours
    nerf-epochs   the same with as many epochs: a pixel is seen as often, by one ray instead of four
    bicubic, imdn, liif, swinir
                  plain NeRF rendered at LR, enlarged by a 2-D method (upsample)
    ss            ours: supersampling, the mean of sub-pixel rays as in the paper
    kernel        ours: supersampling through the known kernel
    refine        ours: kernel, refined by a network that learnt from the same LR images
    hr            trained on HR images: what could be reached
    mlp-nerf, mlp the paper's own field for --mlp-rays rays, plain and supersampled
"""

import argparse
import csv
import html
import json
import math
import pathlib

import cells
import protocols

NETWORKS = {"imdn": "imdn_x{scale}.safetensors", "liif": "liif.safetensors", "swinir": "swinir_x{scale}.safetensors"}
# What a row is called, and what it has seen: this scene's LR images alone, other images, or HR images of this scene.
TITLES = {
    "nerf": ("NeRF, equal rays", "LR"),
    "nerf-epochs": ("NeRF, equal epochs", "LR"),
    "bicubic": ("NeRF-Bi", "LR"),
    "imdn": ("NeRF-IMDN", "other images"),
    "liif": ("NeRF-Liif", "other images"),
    "swinir": ("NeRF-Swin", "other images"),
    "ss": ("ours, SS", "LR"),
    "kernel": ("ours, SS by the kernel", "LR, kernel"),
    "refine": ("ours, refined", "LR, kernel"),
    "hr": ("trained at HR", "HR"),
    "mlp-nerf": ("paper's field, NeRF", "LR"),
    "mlp": ("paper's field, SS", "LR"),
}
# PSNR, SSIM, LPIPS as the paper has them: means over its eight Blender scenes, and over its eight of LLFF.
PAPER = {
    "NeRF": {"100x2": "27.54/.921/.100", "100x4": "25.56/.881/.170", "200x2": "29.16/.935/.077", "200x4": "27.47/.910/.128"}
    | {"252x2": "26.36/.805/.225", "252x4": "24.47/.701/.388"},
    "NeRF-Bi": {"100x2": "26.42/.909/.151", "100x4": "24.74/.868/.244", "200x2": "28.10/.926/.109", "200x4": "26.67/.900/.175"}
    | {"252x2": "25.50/.780/.270", "252x4": "23.90/.676/.481"},
    "SS": {"100x2": "29.77/.946/.045", "100x4": "28.07/.921/.071", "200x2": "31.00/.952/.038", "200x4": "28.46/.921/.076"}
    | {"252x2": "27.31/.838/.139", "252x4": "25.13/.730/.244"},
    "Refine": {"252x2": "27.34/.842/.103", "252x4": "25.59/.759/.165"},
}
# Where the paper's values of single scenes are known: SS at 200x4.
PAPER_SCENES = {("lego", "200x4"): 29.13, ("chair", "200x4"): 30.16}
# LPIPS's networks; each needs its heads, too.
LPIPS = {"squeeze": "squeezenet1_1.safetensors", "alex": "alexnet.safetensors", "vgg": "vgg16.safetensors"}
# All that eval may give; the first three stand in the main table.
METRICS = ["psnr", "ssim", "lpips", "ssim_valid", "lpips_alex", "lpips_vgg"]

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--data", type=pathlib.Path, required=True, help="folder with nerf_synthetic/SCENE (or SCENE) and weights")
parser.add_argument("--scenes", nargs="+", default=["lego", "chair"])
parser.add_argument("--protocols", nargs="+", default=["100x2", "100x4", "200x2", "200x4"], help="LR width x scale")
parser.add_argument("--methods", nargs="+", default=[m for m in TITLES if not m.startswith("mlp")], choices=TITLES, metavar="METHOD")
parser.add_argument("--weights", type=pathlib.Path, help="folder with networks' safetensors (default: DATA/weights)")
parser.add_argument("--kernel", default="lanczos", help="what makes the LR images; average: the paper's experiment of section 5.3")
parser.add_argument("--split", choices=["given", "paper", "holdout"], help="which views are for testing (default: as the data say)")
parser.add_argument("--rays", type=int, help="rays of each training (default: the protocol's)")
parser.add_argument("--mlp-rays", type=int, default=1_000_000, help="rays of the paper's own field; 20 epochs are published")
parser.add_argument("--view", help="the view that the pages show side by side (default: the first)")
parser.add_argument("--crop", nargs=3, type=int, metavar=("X", "Y", "SIDE"), help="the square of it (default: that with most detail)")
parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/table.md"))
parser.add_argument("--pipeline", type=pathlib.Path, default=pathlib.Path("pipeline.yaml"))
parser.add_argument("--nerf-sr", default="target/release/nerf-sr")
parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further parameters for every cell")
options = parser.parse_args()
weights = options.weights or options.data / "weights"
further = dict(setting.split("=", 1) for setting in options.set)
# Sub-pixel rays of a pixel in our supersampling: train-ss's default is 2 a side.
sub_rays = math.ceil(float(further.get("supersample", 2))) ** 2


def blocks(method: str, protocol: str, rays: int) -> dict:
    """The pipeline's blocks that a method needs besides those of the shipped files; eval-METHOD scores it."""
    lr, scale = protocol.split("x")
    average = {"supervision": "average", "rays": round(rays * protocols.AVERAGE_RAYS)}
    plain = average | {"supersample": 1}
    # By the kernel, ours are pipeline.yaml's own.
    views = {"kernel": "render-depth", "refine": "refine"}.get(method, f"views-{method}")
    score = {f"eval-{method}": {"extends": "eval", "inputs": {"views": views, "truth": "prep/truth"}}}

    def field(name: str, parameters: dict, scene: str = "prep/train") -> dict:
        # Plain NeRF has a ray a pixel in training and in rendering.
        rendering = {"samples_per_axis": 1} if name.startswith("nerf") else {}
        return {
            f"field-{name}": {"extends": "train-ss", "inputs": {"scene": scene}, "parameters": parameters},
            f"views-{name}": {"extends": "render-depth", "inputs": {"field": f"field-{name}", "cameras": "prep/cameras"}, "parameters": rendering},
        }

    if method == "nerf":
        return score | field(method, plain)
    if method == "nerf-epochs":
        return score | field(method, plain | {"rays": average["rays"] // sub_rays})
    if method == "ss":
        return score | field(method, average)
    if method == "hr":
        prep = {"extends": "prep", "inputs": {"dataset": "demo-scene"}, "parameters": {"lr_width": round(int(lr) * float(scale)), "scale": 1}}
        return score | {"prep-hr": prep} | field(method, plain, "prep-hr/train")
    if method in ("mlp", "mlp-nerf"):
        paper = {"field": "mlp", "rays": options.mlp_rays, "ensemble": 1, "supervision": "average"}
        return score | field(method, paper | {"supersample": 1 if method == "mlp-nerf" else 2})
    if method in ("bicubic", *NETWORKS):
        low = {"extends": "render-depth", "inputs": {"field": "field-nerf", "cameras": "prep/cameras"}}
        low["parameters"] = {"size": int(lr), "samples_per_axis": 1}
        enlarged = {"run": "upsample", "inputs": {"views": "views-low", "cameras": "prep/cameras"}, "parameters": {"method": method}}
        if method in NETWORKS:
            enlarged["inputs"]["weights"] = f"{weights.resolve()}"
        return score | field("nerf", plain) | {"views-low": low, views: enlarged}
    return score


# Blocks that others extend, which therefore may be meant without being run themselves.
OF = {"supervision": "train-ss", "rays": "train-ss", "ensemble": "train-ss"}


def missing(method: str, protocol: str) -> str | None:
    """Why a method has no row here."""
    if method not in NETWORKS:
        return None
    scale = float(protocol.split("x")[1])
    file = NETWORKS[method].format(scale=f"{scale:g}")
    return None if (weights / file).is_file() else f"weights not given: {file}"


def seconds(stages: dict) -> tuple[float, float]:
    """Of training and of rendering; what is rendered on the way to a refiner belongs to its training."""
    trains = lambda name: name.startswith(("field-", "train-", "downscaled-"))
    renders = lambda name: name.startswith(("views-", "render-", "refine"))
    return tuple(sum(stages[s]["seconds"] for s in stages if of(s)) for of in (trains, renders))


used: dict[str, float] = {}
conventions: dict = {}


def cell(scene: str, protocol: str) -> list[dict]:
    chosen = protocols.settings(protocol, "kernel", True) | {"kernel": options.kernel}
    if options.rays:
        chosen["rays"] = options.rays
        chosen["downscaled-field.rays"] = min(chosen["downscaled-field.rays"], options.rays)
    chosen |= {"split": options.split} if options.split else {}
    if "refine" not in options.methods:
        del chosen["downscaled-field.rays"]
    chosen |= further
    run = [method for method in options.methods if not missing(method, protocol)]
    made: dict = {}
    for method in run:
        made |= blocks(method, protocol, int(chosen["rays"]))
    inputs = {"run" if method == run[0] else method: f"eval-{method}" for method in run}
    shown = {"compare": options.view} if options.view else {}
    shown |= {"crop": options.crop} if options.crop else {}
    made["table"] = {"run": "report", "inputs": inputs, "parameters": shown}
    page = options.out.parent / "table" / f"{scene}-{protocol}"
    page.mkdir(parents=True, exist_ok=True)
    extended = options.pipeline.resolve()
    extended = extended.parent / "pipelines/refined.yaml" if "refine" in run else extended
    text = f"# Written by scripts/table.py.\nextends: {json.dumps(str(extended))}\ndefault: [table]\nstages:\n"
    text += "".join(f"  {name}: {json.dumps(block)}\n" for name, block in made.items())
    (page / "pipeline.yaml").write_text(text)
    store = options.pipeline.resolve().parent / ".nerf-sr"
    command = [options.nerf_sr, "run", "table", "-j", "1", "--pipeline", page / "pipeline.yaml", "--store", store, "--out", page]
    folder = cells.dataset(options.data, scene).resolve()
    command += ["-i", f"dataset={folder}"] + (["-i", f"prep-hr.dataset={folder}"] if "hr" in run else [])
    if any((weights / net).is_file() and (weights / f"lpips_linear_{name}_v0.1.safetensors").is_file() for name, net in LPIPS.items()):
        command += ["-i", f"eval.weights={weights.resolve()}"]
    command += [word for name, value in chosen.items() for word in ("-p", f"{OF[name]}.{name}={value}" if name in OF else f"{name}={value}")]
    print("==", scene, protocol, flush=True)
    cells.call(command)
    results = {row["stage"]: row for row in json.loads((page / "table/results.json").read_text())}
    rows = []
    for method in options.methods:
        row = {"scene": scene, "protocol": protocol, "method": method}
        if method not in run:
            rows.append(row | {"missing": missing(method, protocol)})
            continue
        result = results[f"eval-{method}"]
        train, render = seconds(result["stages"])
        used.update({stage["folder"]: stage["seconds"] for stage in result["stages"].values()})
        metrics = json.loads((pathlib.Path(result["stages"][f"eval-{method}"]["folder"]) / "metrics.json").read_text())
        conventions.update(metrics["conventions"])
        rows.append(row | {name: result["mean"].get(name) for name in METRICS} | {"train_s": train, "render_s": render})
    return rows


rows: list[dict] = []
for protocol in options.protocols:
    for scene in options.scenes:
        rows += cell(scene, protocol)
        cells.write(options.out.with_suffix(".json"), rows)


def mean(method: str, protocol: str, scenes: list[str]) -> dict | None:
    mine = [r for r in rows if (r["method"], r["protocol"]) == (method, protocol) and r["scene"] in scenes and "psnr" in r]
    return cells.mean(mine) if mine else None


def figures(method: str, protocol: str, scenes: list[str]) -> str:
    value = mean(method, protocol, scenes)
    if not value:
        return next(r["missing"] for r in rows if (r["method"], r["protocol"]) == (method, protocol))
    lpips = f"{value['lpips']:.4f}" if "lpips" in value else "–"
    text = f"{value['psnr']:.2f} / {value['ssim']:.4f} / {lpips}"
    rivals = [v["psnr"] for m in options.methods if TITLES[m][1] == TITLES[method][1] and (v := mean(m, protocol, scenes))]
    return f"**{text}**" if value["psnr"] == max(rivals) and len(rivals) > 1 else text


def grid(head: list[str], lines: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, ["---"] * len(head), *lines]) + "\n"


title = lambda method: TITLES[method][0] + (f" ({options.mlp_rays:,} rays)" if method.startswith("mlp") else "")
parts = []
for scenes in [options.scenes, *([s] for s in options.scenes if len(options.scenes) > 1)]:
    lines = [[title(m), TITLES[m][1], *(figures(m, p, scenes) for p in options.protocols)] for m in options.methods]
    if scenes == options.scenes:
        known = {name: values for name, values in PAPER.items() if values.keys() & set(options.protocols)}
        lines += [[f"paper: {name}", "", *(values.get(p, "–") for p in options.protocols)] for name, values in known.items()]
    elif any((scenes[0], p) in PAPER_SCENES for p in options.protocols):
        known = [PAPER_SCENES.get((scenes[0], p)) for p in options.protocols]
        lines += [["paper: SS", "", *(f"{value:.2f}" if value else "–" for value in known)]]
    parts.append((f"Mean of {', '.join(scenes)}" if len(scenes) > 1 else scenes[0], grid(["method", "has seen", *options.protocols], lines)))

gains = []
for name, twin in (("at equal rays", "nerf"), ("at equal epochs", "nerf-epochs")):
    pairs = [(mean("ss", p, options.scenes), mean(twin, p, options.scenes)) for p in options.protocols]
    if any(a and b for a, b in pairs):
        gains.append([f"ours, SS over NeRF {name}", *(f"{a['psnr'] - b['psnr']:+.2f}" if a and b else "–" for a, b in pairs)])
if gains:
    published = [[PAPER[name].get(p, "").split("/")[0] for name in ("SS", "NeRF")] for p in options.protocols]
    gains.append(["the paper's", *(f"{float(a) - float(b):+.2f}" if a and b else "–" for a, b in published)])
    parts.append(("Gain, PSNR in dB", grid(["", *options.protocols], gains)))

given = [name for name in METRICS[3:] if any(row.get(name) is not None for row in rows)]


def others(method: str, protocol: str) -> str:
    value = mean(method, protocol, options.scenes)
    return " / ".join(f"{value[name]:.4f}" for name in given if name in value) if value else "–"


if given:
    lines = [[title(m), *(others(m, p) for p in options.protocols)] for m in options.methods]
    parts.append((f"By other metrics: {' / '.join(given)}", grid(["method", *options.protocols], lines)))

times = lambda m, p: f"{v['train_s'] / 60:.1f} min / {v['render_s']:.0f} s" if (v := mean(m, p, options.scenes)) else "–"
parts.append(("Training / rendering", grid(["method", *options.protocols], [[title(m), *(times(m, p) for p in options.protocols)] for m in options.methods])))

disk = sum(file.stat().st_size for folder in used for file in pathlib.Path(folder).rglob("*") if file.is_file())
notes = [
    "PSNR in dB / SSIM / LPIPS. In bold: the best PSNR of the rows that have seen the same.",
    *(f"{name}: {conventions[name]}." for name in ("psnr", "ssim", "lpips", "background") if name in conventions),
    f"LR images by {options.kernel}. Views to test: {options.split or 'as the data say'}.",
    "The paper's figures are means over all eight scenes of its data sets, its LPIPS network and SSIM window unknown: compare gains rather than "
    "values; its scenes' own values, where known, stand with the scenes. It gives its method four times (×2) and 16 times (×4) plain NeRF's steps: "
    f"that is the comparison at equal epochs, where ours casts {sub_rays} times as many rays.",
    f"Everything above: {sum(used.values()) / 60:.0f} min of stages' own time, {disk / 2**30:.2f} GiB of artifacts.",
]
heading = "# nerf-sr beside the paper\n\n"
text = heading + "\n".join(f"## {name}\n\n{table}" for name, table in parts) + "\n" + "\n".join(f"* {note}" for note in notes) + "\n"
options.out.write_text(text)
with options.out.with_suffix(".csv").open("w", newline="") as file:
    names = ["scene", "protocol", "method", *METRICS, "train_s", "render_s", "missing"]
    writer = csv.DictWriter(file, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)


def as_html(table: str) -> str:
    lines = [[c.strip() for c in line.strip("|").split(" | ")] for line in table.strip().splitlines()]
    body = lambda c: f"<b>{html.escape(c.strip('*'))}</b>" if c.startswith("**") else html.escape(c)
    row = lambda line, tag: "<tr>" + "".join(f"<{tag}>{body(c)}</{tag}>" for c in line) + "</tr>"
    return "<table>" + row(lines[0], "th") + "".join(row(line, "td") for line in lines[2:]) + "</table>"


links = "".join(
    f'<li><a href="table/{s}-{p}/table/index.html">{s}, {p}: every method side by side</a></li>' for p in options.protocols for s in options.scenes
)
style = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1240px;padding:0 1rem}table{border-collapse:collapse}"
style += "th,td{padding:.3rem .7rem;text-align:left;border-bottom:1px solid #ddd}"
options.out.with_suffix(".html").write_text(
    f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>nerf-sr beside the paper</title><style>{style}</style>'
    "<h1>nerf-sr beside the paper</h1>"
    + "".join(f"<h2>{name}</h2>{as_html(table)}" for name, table in parts)
    + f"<ul>{links}</ul><ul>{''.join(f'<li>{html.escape(note)}</li>' for note in notes)}</ul></html>\n"
)
print(text)
print(f"{options.out}, {options.out.with_suffix('.csv')}, {options.out.with_suffix('.html')}")
