#!/usr/bin/env python3
"""Rendered views beside refined ones, without references and with some: `make refine-table`.

All methods are scored on the same views: as many references are left out of them as any method uses. Cells go through the ordinary
pipeline, one after the other; what is in the store isn't run again. After every cell OUT (one JSON array) is written anew, and at the
end a Markdown table is printed.
"""

import argparse
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
    chosen |= {"prep.references": max(options.references)}
    chosen |= {"train-referenced.references": references, "refine-referenced.references": references}
    chosen |= {"split": options.split} if options.split else {}
    chosen |= dict(setting.split("=", 1) for setting in options.set)
    settings = [f"{name}={value}" for name, value in chosen.items()]
    folder = cells.dataset(options.data, scene)
    results = cells.run_target("referenced", options.nerf_sr, page, folder, settings, options.data / "weights")
    kinds = [("ss", 0, "render_s"), ("refine", 0, "refine_s"), ("refine", references, "refine_s")]
    rows = []
    for (method, count, spent), row in zip(kinds, results):
        name = {"scene": scene, "protocol": protocol, "method": method, "references": count}
        scores = {key: row[key] for key in ("psnr", "ssim", "lpips")}
        rows.append(name | scores | {"seconds_per_view": row[spent] / row["views"]})
    return rows


rows = []
for protocol in options.protocols:
    for scene in options.scenes:
        for references in options.references:
            rows += [row for row in cell(scene, protocol, references) if row not in rows]
            cells.write(options.out, rows)

print("| LR × scale | scene | method | references | PSNR | SSIM | LPIPS | seconds a view |")
print("| --- | --- | --- | --- | --- | --- | --- | --- |")
for row in rows:
    lpips = f"{row['lpips']:.4f}" if row["lpips"] is not None else "–"
    print(
        f"| {row['protocol']} | {row['scene']} | {row['method']} | {row['references']} | {row['psnr']:.2f} | {row['ssim']:.4f} "
        f"| {lpips} | {row['seconds_per_view']:.2f} |"
    )
