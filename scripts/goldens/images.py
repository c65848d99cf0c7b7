#!/usr/bin/env python3
"""Generates the golden files of `pixels` and `eval` with Pillow, scikit-image and PyTorch: run by `make goldens`.

Inputs are computed by an integer formula that the tests repeat (`pattern`), so golden files contain only outputs.
"""

import json
import pathlib
import struct

import numpy
import PIL
from PIL import Image

import draws

ROOT = pathlib.Path(__file__).resolve().parents[2]


def pattern(width, height, channels, seed):
    """Returns an image with gradients, edges, noise, and opaque, transparent and partial alpha. The Rust tests repeat this formula."""
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
    folder = ROOT / "stages/common/imaging/pixels/tests/goldens/pillow"
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
    """Writes SSIM values in f64: `valid` by scikit-image, `reflect` with PyTorch's reflection padding."""
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


def lpips():
    """Writes LPIPS distances of one pair of images for each network, computed by PyTorch's layers with random weights."""
    import torch
    from torch.nn import functional

    fire = lambda i, inputs, squeezed, expanded: (i, inputs, squeezed, expanded)
    # Layers: a number ends a stage of that many channels; ("P", size, ceil_mode) is a max pooling; a tuple of six is a convolution (index,
    # inputs, outputs, size, stride, padding); a tuple of four is a fire module.
    networks = {
        "squeeze": [(0, 3, 64, 3, 2, 0), 64, ("P", 3, True), fire(3, 64, 16, 64), fire(4, 128, 16, 64), 128, ("P", 3, True),
                    fire(6, 128, 32, 128), fire(7, 256, 32, 128), 256, ("P", 3, True), fire(9, 256, 48, 192), 384,
                    fire(10, 384, 48, 192), 384, fire(11, 384, 64, 256), 512, fire(12, 512, 64, 256), 512],
        "alex": [(0, 3, 64, 11, 4, 2), 64, ("P", 3, False), (3, 64, 192, 5, 1, 2), 192, ("P", 3, False),
                 (6, 192, 384, 3, 1, 1), 384, (8, 384, 256, 3, 1, 1), 256, (10, 256, 256, 3, 1, 1), 256],
        "vgg": [(0, 3, 64, 3, 1, 1), (2, 64, 64, 3, 1, 1), 64, ("P", 2, False), (5, 64, 128, 3, 1, 1), (7, 128, 128, 3, 1, 1), 128,
                ("P", 2, False), (10, 128, 256, 3, 1, 1), (12, 256, 256, 3, 1, 1), (14, 256, 256, 3, 1, 1), 256, ("P", 2, False),
                (17, 256, 512, 3, 1, 1), (19, 512, 512, 3, 1, 1), (21, 512, 512, 3, 1, 1), 512, ("P", 2, False),
                (24, 512, 512, 3, 1, 1), (26, 512, 512, 3, 1, 1), (28, 512, 512, 3, 1, 1), 512],
    }
    a = torch.from_numpy(pattern(45, 37, 3, 9).astype(numpy.float64) / 255)
    b = 0.7 * a + 0.3 * torch.from_numpy(pattern(45, 37, 3, 109).astype(numpy.float64) / 255)
    result = {}
    for number, (name, layers) in enumerate(networks.items()):
        first = purpose = 1000 * (number + 1)
        weights, heads = [], []

        def tensor(of, name, shape, scale, shift):
            nonlocal purpose
            of.append({"name": name, "shape": list(shape), "scale": scale, "shift": shift})
            values = numpy.float32(scale) * draws.uniform(7, purpose, int(numpy.prod(shape))).astype(numpy.float32) + numpy.float32(shift)
            purpose += 1
            return torch.from_numpy(values.reshape(shape)).double()

        def conv(name, outputs, inputs, size):
            reach = (6 / (inputs * size * size)) ** 0.5
            kernel = tensor(weights, f"{name}.weight", (outputs, inputs, size, size), 2 * reach, -reach)
            return kernel, tensor(weights, f"{name}.bias", (outputs,), 0.2, -0.1)

        read = []
        for layer in layers:
            if isinstance(layer, int) or layer[0] == "P":
                read.append(layer)
            elif len(layer) == 4:
                index, inputs, squeezed, expanded = layer
                at = f"features.{index}"
                read.append([conv(f"{at}.squeeze", squeezed, inputs, 1), conv(f"{at}.expand1x1", expanded, squeezed, 1),
                             conv(f"{at}.expand3x3", expanded, squeezed, 3)])
            else:
                index, inputs, outputs, size, stride, padding = layer
                read.append((*conv(f"features.{index}", outputs, inputs, size), stride, padding))
        stages = [layer for layer in layers if isinstance(layer, int)]
        linear = [tensor(heads, f"lin{k}.model.1.weight", (1, channels, 1, 1), 1.0, 0.0) for k, channels in enumerate(stages)]

        def features(x):
            x = (2 * x - 1).permute(2, 0, 1)[None]
            constant = lambda *v: torch.tensor(v, dtype=torch.float64).view(1, 3, 1, 1)
            x, found = (x - constant(-0.030, -0.088, -0.188)) / constant(0.458, 0.448, 0.450), []
            for layer in read:
                if isinstance(layer, int):
                    found.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
                elif layer[0] == "P":
                    x = functional.max_pool2d(x, layer[1], 2, ceil_mode=layer[2])
                elif isinstance(layer, list):
                    squeeze, one, three = layer
                    x = torch.relu(functional.conv2d(x, *squeeze))
                    x = torch.cat([torch.relu(functional.conv2d(x, *one)), torch.relu(functional.conv2d(x, *three, padding=1))], 1)
                else:
                    x = torch.relu(functional.conv2d(x, layer[0], layer[1], stride=layer[2], padding=layer[3]))
            return found

        parts = zip(features(a), features(b), linear)
        distance = sum((functional.conv2d((x - y).square(), head)).mean() for x, y, head in parts)
        result[name] = {"purpose": first, "weights": weights, "heads": heads, "distance": distance.item()}
    (ROOT / "stages/eval/tests/goldens/lpips.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    pillow()
    ssim()
    lpips()
