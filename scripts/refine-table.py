#!/usr/bin/env python3
"""Rendered views beside refined ones, without references and with some: `make refine-table`.

All methods are scored on the same views: as many references are left out of them as any method uses. Cells go through the ordinary
pipeline, one after the other; what is in the store isn't run again. After every cell OUT (one JSON array) is written anew, and at the
end a Markdown table is printed. Beside the means over all views stand those over views that look the way a reference does, within 60°,
and what the view that fares worst gains over what is rendered.
"""

import argparse
import json
import math
import pathlib

import cells
import protocols

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--data", type=pathlib.Path, required=True, help="folder with nerf_llff_data/SCENE, nerf_synthetic/SCENE (or SCENE) and weights")
parser.add_argument("--scenes", nargs="+", default=["fern"])
parser.add_argument("--protocols", nargs="+", default=["252x2", "252x4"], help="LR width x scale")
parser.add_argument("--references", nargs="+", type=int, default=[1], help="numbers of references, a row each")
parser.add_argument("--split", choices=["given", "paper", "holdout"], help="which views are for testing (default: as the data say)")
parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/refine-table.json"))
parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further parameters for every cell")
parser.add_argument("--nerf-sr", default="target/release/nerf-sr")
options = parser.parse_args()


def cell(scene: str, protocol: str, references: int) -> list[dict]:
    """Rows of what is rendered, refined without references, and with so many."""
    page = options.out.parent / "refine-table" / f"{scene}-{protocol}-{references}"
    chosen = protocols.settings(protocol, "kernel", refined=True)
    chosen |= {"prep.hr_references": max(options.references)}
    chosen |= {f"{stage}.max_references": references for stage in ("finetuned-field", "refine-reference")}
    chosen["train-reference.references_per_view"] = references
    chosen |= {"split": options.split} if options.split else {}
    given = dict(setting.split("=", 1) for setting in options.set)
    # Half of what the field has, so that all that references need takes less time than the field.
    chosen |= {"finetuned-field.rays": int(given.get("rays", chosen["rays"])) // 2} | given
    settings = [f"{name}={value}" for name, value in chosen.items()]
    folder = cells.dataset(options.data, scene)
    results = cells.results("reference-refine", options.nerf_sr, page, folder, settings, options.data / "weights")
    results = [next(row for row in results if row["stage"] == stage) for stage in ("eval", "eval-refined", "eval-reference")]
    rendered = cells.view_psnr(results[0])
    near = views_near_references(pathlib.Path(results[0]["stages"]["prep"]["folder"]))
    kinds = [("ss", 0, "render_s"), ("refine", 0, "refine_s"), ("refine", references, "refine_s")]
    # What rendering both fields takes more than one counts as refining, where references ask for it.
    second = max(0, cells.seconds(results[-1], "finetuned-views") - cells.seconds(results[0], "render-depth"))
    rows = []
    for (method, count, spent), result in zip(kinds, results):
        row, views = cells.figures(result), cells.view_psnr(result)
        name = {"scene": scene, "protocol": protocol, "method": method, "references": count}
        scores = {key: row[key] for key in ("psnr", "ssim", "lpips")}
        scores |= {"near_views": len(near), "near_psnr": sum(views[view] for view in near) / len(near) if near else None}
        scores |= {"least_gain": min(views[view] - rendered[view] for view in views)}
        rows.append(name | scores | {"seconds_per_view": (row[spent] + (second if count else 0)) / row["views"]})
    return rows


def views_near_references(prep: pathlib.Path, degrees: float = 60) -> list[str]:
    """Test views whose optical axis is within so many degrees of a reference's."""

    def axes(part: str) -> dict[str, list[float]]:
        views = json.loads((prep / part / "views.json").read_text())["views"]
        return {view["camera"]["name"]: [row[2] for row in view["camera"]["camera_to_world"]] for view in views}

    least = math.cos(math.radians(degrees))
    references = axes("references").values()
    return [name for name, axis in axes("cameras").items() if any(sum(a * b for a, b in zip(axis, other)) >= least for other in references)]


rows = []
for protocol in options.protocols:
    for scene in options.scenes:
        for references in options.references:
            rows += [row for row in cell(scene, protocol, references) if row not in rows]
            cells.write(options.out, rows)

print("| LR × scale | scene | method | references | PSNR | SSIM | LPIPS | PSNR of views within 60° of a reference | least gain of a view | seconds a view |")
print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
for row in rows:
    lpips = f"{row['lpips']:.4f}" if row["lpips"] is not None else "–"
    near = f"{row['near_psnr']:.2f} ({row['near_views']})" if row["near_views"] else "–"
    print(
        f"| {row['protocol']} | {row['scene']} | {row['method']} | {row['references']} | {row['psnr']:.2f} | {row['ssim']:.4f} "
        f"| {lpips} | {near} | {row['least_gain']:+.2f} | {row['seconds_per_view']:.2f} |"
    )
