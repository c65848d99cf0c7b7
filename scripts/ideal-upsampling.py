#!/usr/bin/env python3
"""Prints the PSNR of ideal up-sampling: HR test views without frequencies above the LR images' Nyquist frequency.

Upper bound for methods without a prior or a second view; a yardstick for the tables. Needs numpy and Pillow (`.venv/bin/python`
after `make goldens`). HR views are computed as in `prep`: Lanczos in 8 bits, then a white background.

    .venv/bin/python scripts/ideal-upsampling.py --data ../shared/data --scenes lego chair
"""

import argparse
import json
import pathlib

import numpy
from PIL import Image

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--data", type=pathlib.Path, required=True)
parser.add_argument("--scenes", nargs="+", default=["lego", "chair"])
parser.add_argument("--protocols", nargs="+", default=["100x2", "100x4", "200x2", "200x4"], help="protocols as LR width x scale (default 100x2 100x4 200x2 200x4)")
options = parser.parse_args()


def psnr(a: numpy.ndarray, b: numpy.ndarray) -> float:
    return -10 * numpy.log10(numpy.mean((a - b) ** 2))


def ideal(view: pathlib.Path, lr: int, scale: float) -> float:
    """Returns the PSNR of a test view after removing all frequencies above the LR image's Nyquist frequency."""
    hr = round(lr * scale)
    image = Image.open(view).convert("RGBA")
    if image.width != hr:
        image = image.resize((hr, round(image.height * hr / image.width)), Image.LANCZOS)
    pixels = numpy.asarray(image).astype(float) / 255
    truth = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    spectrum = numpy.fft.fft2(truth, axes=(0, 1))
    for axis, length in enumerate(truth.shape[:2]):
        kept = numpy.abs(numpy.fft.fftfreq(length)) < 0.5 / scale
        spectrum *= kept.reshape(-1, 1, 1) if axis == 0 else kept.reshape(1, -1, 1)
    low = numpy.fft.ifft2(spectrum, axes=(0, 1)).real.clip(0, 1)
    return psnr(low, truth)


print("| LR × scale | " + " | ".join(options.scenes) + " | mean |")
print("| --- |" + " --- |" * (len(options.scenes) + 1))
for protocol in options.protocols:
    lr, scale = protocol.split("x")
    values = []
    for scene in options.scenes:
        folder = next(folder for folder in (options.data / "nerf_synthetic" / scene, options.data / scene) if folder.is_dir())
        frames = json.loads((folder / "transforms_test.json").read_text())["frames"]
        views = [folder / (frame["file_path"] + ".png") for frame in frames]
        values.append(sum(ideal(view, int(lr), float(scale)) for view in views) / len(views))
    print(f"| {protocol} | " + " | ".join(f"{v:.2f}" for v in [*values, sum(values) / len(values)]) + " |")
