#!/usr/bin/env python3
"""Makes the golden files that tests compare with, from the real thing.

    python3 -m venv .venv && .venv/bin/pip install -r scripts/goldens-requirements.txt && .venv/bin/python scripts/make-goldens.py

Inputs come from an integer formula that the tests repeat (`pattern`), so only outputs are kept.
"""

import json
import pathlib
import struct

import numpy
import PIL
from PIL import Image

ROOT = pathlib.Path(__file__).resolve().parent.parent


def pattern(width, height, channels, seed):
    """Bytes with flat areas, edges, noise, and alpha of every kind. Repeated in Rust by the tests."""
    out = numpy.zeros((height, width, channels), numpy.uint8)
    state = seed
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                state = (state * 1664525 + 1013904223) & 0xFFFFFFFF
                noise = state >> 24
                if (x // 7 + y // 5) % 3 == 0:
                    value = noise
                elif (x // 7 + y // 5) % 3 == 1:
                    value = 255 if (x + y + c) % 2 else 0
                else:
                    value = (x * 9 + y * 4 + c * 60) & 0xFF
                if c == 3 and (x // 11 + y // 9) % 2 == 0:
                    value = 0 if (x // 11) % 2 else 255
                out[y, x, c] = value
    return out


def pillow():
    folder = ROOT / "stages/common/pixels/tests/goldens/pillow"
    folder.mkdir(parents=True, exist_ok=True)
    filters = {"box": Image.BOX, "bicubic": Image.BICUBIC, "lanczos": Image.LANCZOS}
    sizes = [((64, 64), (32, 32)), ((64, 64), (16, 16)), ((37, 53), (17, 23)), ((53, 37), (53, 11)), ((31, 20), (9, 20)),
             ((20, 13), (41, 29)), ((9, 9), (1, 1)), ((1, 5), (3, 2)), ((48, 36), (21, 16))]
    cases = []
    for name, kernel in filters.items():
        for seed, (source, target) in enumerate(sizes):
            image = Image.fromarray(pattern(*source, 4, seed + 1), "RGBA").resize(target, kernel)
            file = f"{name}-{source[0]}x{source[1]}-{target[0]}x{target[1]}.rgba"
            (folder / file).write_bytes(image.tobytes())
            cases.append({"file": file, "filter": name, "seed": seed + 1, "source": source, "target": target})
    (folder / "cases.json").write_text(json.dumps({"pillow": PIL.__version__, "cases": cases}, indent=1) + "\n")


def ssim():
    """`valid` from scikit-image, `reflect` from PyTorch's padding, both in f64."""
    import skimage
    import torch
    from skimage.metrics import structural_similarity

    def reflect(a, b):
        radius = 5
        taps = torch.exp(-torch.arange(-radius, radius + 1, dtype=torch.float64) ** 2 / (2 * 1.5**2))
        taps = taps / taps.sum()
        window = (taps[:, None] * taps[None, :])[None, None]

        def blur(x):
            padded = torch.nn.functional.pad(x, (radius,) * 4, mode="reflect")
            return torch.nn.functional.conv2d(padded, window)

        total = 0.0
        for c in range(3):
            x, y = (torch.from_numpy(i[None, None, :, :, c].copy()) for i in (a, b))
            mx, my = blur(x), blur(y)
            vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
            c1, c2 = 0.01**2, 0.03**2
            value = ((2 * mx * my + c1) * (2 * cov + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))
            total += value.mean().item()
        return total / 3

    cases = []
    for width, height, seed in [(40, 30, 1), (11, 11, 2), (64, 48, 3), (33, 57, 4)]:
        a = pattern(width, height, 3, seed).astype(numpy.float64) / 255
        b = 0.7 * a + 0.3 * pattern(width, height, 3, seed + 100).astype(numpy.float64) / 255
        valid = structural_similarity(a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2)
        cases.append({"width": width, "height": height, "seed": seed, "valid": float(valid), "reflect": reflect(a, b)})
    out = ROOT / "stages/eval/tests/goldens/ssim.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps({"scikit-image": skimage.__version__, "torch": torch.__version__.split("+")[0], "cases": cases}, indent=1) + "\n")


if __name__ == "__main__":
    pillow()
    ssim()
