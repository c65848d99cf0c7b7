#!/usr/bin/env python3
"""Draws docs/demo.png, the first picture of the README, from the last `make demo`; called by scripts/readme-pictures.sh.

Needs Pillow (`make goldens` installs it).
"""

import pathlib
import subprocess

from PIL import Image, ImageDraw

ROOT = pathlib.Path(__file__).resolve().parent.parent
SIDE = 300


def artifact(stage: str) -> pathlib.Path:
    """Returns the folder of a stage's current artifact."""
    return pathlib.Path(subprocess.run([ROOT / "target/release/nerf-sr", "path", stage], cwd=ROOT, check=True, text=True, stdout=subprocess.PIPE).stdout.strip())


def main() -> None:
    name = "r_5"
    truth = artifact("prep/truth")
    parts = [
        ("LR input, 100 px", truth / f"low/{name}.png", Image.NEAREST),
        ("rendered, 200 px", artifact("render-depth") / f"previews/{name}.png", Image.LANCZOS),
        ("ground truth", truth / f"images/{name}.png", Image.LANCZOS),
        ("error", artifact("eval") / f"errors/{name}.png", Image.NEAREST),
    ]
    sheet = Image.new("RGB", (len(parts) * SIDE, SIDE + 18), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (label, path, kernel) in enumerate(parts):
        image = Image.open(path).convert("RGBA").resize((SIDE, SIDE), kernel)
        sheet.paste(image, (i * SIDE, 0), image)
        draw.text((i * SIDE + 8, SIDE + 2), label, fill="black")
    (ROOT / "docs").mkdir(exist_ok=True)
    sheet.save(ROOT / "docs/demo.png", optimize=True)


if __name__ == "__main__":
    main()
