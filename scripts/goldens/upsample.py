#!/usr/bin/env python3
"""Generates the golden files of `upsample` with PyTorch's own layers: run by `make goldens`.

The networks are built here from their papers' descriptions, small and with fixed random weights, and run in f64. A file contains a
network's weights, inputs (golden.input.N) and outputs (golden.output.N). Some weights are also saved in the format of their project's
releases, for tests/checkpoint.rs.

If weights/imdn_x2.safetensors is in NERF_SR_DATA (or ../shared/data), scores of IMDN's released weights on ten test views, run in f32, are
also written.
"""

import json
import math
import os
import pathlib

import numpy
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from torch import nn
from torch.nn import functional

ROOT = pathlib.Path(__file__).resolve().parents[2]
TO = ROOT / "stages/upsample/tests/goldens"
torch.manual_seed(7)


def conv(inputs, outputs, size=3):
    return nn.Conv2d(inputs, outputs, size, padding=size // 2)


class Distillation(nn.Module):
    """IMDN's block: each layer passes a quarter of the channels to the output; contrast-aware attention weights channels."""

    def __init__(self, width):
        super().__init__()
        self.kept = width // 4
        rest = width - self.kept
        self.c1, self.c2, self.c3 = conv(width, width), conv(rest, width), conv(rest, width)
        self.c4, self.c5 = conv(rest, self.kept), conv(4 * self.kept, width, 1)
        self.cca = nn.Module()
        self.cca.conv_du = nn.Sequential(
            conv(4 * self.kept, 4 * self.kept // 16, 1), nn.ReLU(), conv(4 * self.kept // 16, 4 * self.kept, 1), nn.Sigmoid()
        )

    def forward(self, x):
        rest, kept = x, []
        for layer in (self.c1, self.c2, self.c3):
            y = functional.leaky_relu(layer(rest), 0.05)
            kept.append(y[:, : self.kept])
            rest = y[:, self.kept :]
        y = torch.cat([*kept, self.c4(rest)], 1)
        deviation = y.std((2, 3), correction=0, keepdim=True)
        return self.c5(y * self.cca.conv_du(deviation + y.mean((2, 3), keepdim=True))) + x


class Imdn(nn.Module):
    def __init__(self, width, blocks, scale):
        super().__init__()
        self.blocks, self.scale = blocks, scale
        self.fea_conv = conv(3, width)
        for i in range(blocks):
            setattr(self, f"IMDB{i + 1}", Distillation(width))
        self.c = nn.Sequential(conv(width * blocks, width, 1))
        self.LR_conv = conv(width, width)
        self.upsampler = nn.Sequential(conv(width, 3 * scale**2))

    def forward(self, x):
        first = self.fea_conv(x)
        outputs = [first]
        for i in range(self.blocks):
            outputs.append(getattr(self, f"IMDB{i + 1}")(outputs[-1]))
        y = functional.leaky_relu(self.c(torch.cat(outputs[1:], 1)), 0.05)
        return functional.pixel_shuffle(self.upsampler(self.LR_conv(y) + first), self.scale)


class Liif(nn.Module):
    """EDSR's baseline encoder with LIIF's decoder: feature unfolding, local ensemble, cell decoding."""

    def __init__(self, width, blocks, hidden):
        super().__init__()
        block = lambda: nn.ModuleDict({"body": nn.Sequential(conv(width, width), nn.ReLU(), conv(width, width))})
        self.encoder = nn.ModuleDict(
            {
                "head": nn.Sequential(conv(3, width)),
                "body": nn.ModuleList([*(block() for _ in range(blocks)), conv(width, width)]),
            }
        )
        sizes = [9 * width + 4, *hidden, 3]
        layers = []
        for a, b in zip(sizes, sizes[1:]):
            layers += [nn.Linear(a, b), nn.ReLU()]
        self.imnet = nn.ModuleDict({"layers": nn.Sequential(*layers[:-1])})

    def forward(self, x, rows, columns):
        first = self.encoder["head"]((x - 0.5) / 0.5)
        y = first
        for block in self.encoder["body"][:-1]:
            y = block["body"](y) + y
        features = self.encoder["body"][-1](y) + first
        _, width, low_rows, low_columns = features.shape
        features = functional.unfold(features, 3, padding=1).view(1, 9 * width, low_rows, low_columns)
        centres = lambda n: -1 + (2 * torch.arange(n, dtype=x.dtype) + 1) / n
        grid = lambda h, w: torch.stack(torch.meshgrid(centres(h), centres(w), indexing="ij"), -1)
        target_centres, source_centres = grid(rows, columns), grid(low_rows, low_columns).permute(2, 0, 1)[None]
        low = torch.tensor([low_rows, low_columns], dtype=x.dtype)
        cell = (2 / torch.tensor([rows, columns], dtype=x.dtype) * low).expand(rows, columns, 2)
        colours, areas = [], []
        for down in (-1, 1):
            for across in (-1, 1):
                shifted = target_centres + torch.tensor([down, across]) / low + 1e-6
                shifted = shifted.clamp(-1 + 1e-6, 1 - 1e-6).flip(-1)[None]
                nearest = lambda of: functional.grid_sample(of, shifted, mode="nearest", align_corners=False)[0].permute(1, 2, 0)
                offset = (target_centres - nearest(source_centres)) * low
                colours.append(self.imnet["layers"](torch.cat([nearest(features), offset, cell], -1)))
                areas.append(offset.prod(-1).abs() + 1e-9)
        total_area = sum(areas)
        shares = [area / total_area for area in reversed(areas)]
        colour = sum(c * s[..., None] for c, s in zip(colours, shares))
        return (colour * 0.5 + 0.5).permute(2, 0, 1)[None]


class Attention(nn.Module):
    def __init__(self, width, heads, window):
        super().__init__()
        self.heads, self.window = heads, window
        self.relative_position_bias_table = nn.Parameter(0.3 * torch.randn((2 * window - 1) ** 2, heads))
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x, mask):
        windows, pixels, width = x.shape
        q, k, v = self.qkv(x).reshape(windows, pixels, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        position = torch.stack(torch.meshgrid(*[torch.arange(self.window)] * 2, indexing="ij"), -1).reshape(-1, 2)
        relative = position[:, None] - position[None] + self.window - 1
        bias = self.relative_position_bias_table[relative[..., 0] * (2 * self.window - 1) + relative[..., 1]].permute(2, 0, 1)
        score = q @ k.transpose(-1, -2) / math.sqrt(width // self.heads) + bias
        if mask is not None:
            score = score + mask[:, None]
        return self.proj((score.softmax(-1) @ v).transpose(1, 2).reshape(windows, pixels, width))


class Block(nn.Module):
    def __init__(self, width, heads, window, shift):
        super().__init__()
        self.window, self.shift = window, shift
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attn = Attention(width, heads, window)
        self.mlp = nn.ModuleDict({"fc1": nn.Linear(width, 2 * width), "fc2": nn.Linear(2 * width, width)})

    def windows(self, x):
        w, (_, rows, columns, depth) = self.window, x.shape
        return x.view(rows // w, w, columns // w, w, depth).transpose(1, 2).reshape(-1, w * w, depth)

    def forward(self, x):
        w, s, (_, rows, columns, depth) = self.window, self.shift, x.shape
        mask = None
        if s:
            regions = torch.zeros(1, rows, columns, 1)
            parts = (slice(0, -w), slice(-w, -s), slice(-s, None))
            for i, down in enumerate(parts):
                for j, across in enumerate(parts):
                    regions[:, down, across] = 3 * i + j
            regions = self.windows(regions)[..., 0]
            mask = torch.where(regions[:, None] == regions[:, :, None], 0.0, -100.0).to(x.dtype)
        y = self.attn(self.windows(self.norm1(x).roll((-s, -s), (1, 2))), mask)
        y = y.view(rows // w, columns // w, w, w, depth).transpose(1, 2).reshape(1, rows, columns, depth)
        x = x + y.roll((s, s), (1, 2))
        return x + self.mlp["fc2"](functional.gelu(self.mlp["fc1"](self.norm2(x))))


def residual(width, three_convs):
    if not three_convs:
        return conv(width, width)
    narrow = width // 4
    leak = nn.LeakyReLU(0.2)
    return nn.Sequential(conv(width, narrow), leak, conv(narrow, narrow, 1), leak, conv(narrow, width))


class SwinIr(nn.Module):
    def __init__(self, width, depths, heads, window, kind, scale, three_convs=False):
        super().__init__()
        self.window, self.kind, self.scale = window, kind, scale
        self.conv_first = conv(3, width)
        self.patch_embed = nn.ModuleDict({"norm": nn.LayerNorm(width)})
        self.layers = nn.ModuleList()
        for depth in depths:
            blocks = nn.ModuleList(Block(width, heads, window, (i % 2) * (window // 2)) for i in range(depth))
            group = nn.ModuleDict({"residual_group": nn.ModuleDict({"blocks": blocks}), "conv": residual(width, three_convs)})
            self.layers.append(group)
        self.norm = nn.LayerNorm(width)
        self.conv_after_body = residual(width, three_convs)
        if kind == "direct":
            self.upsample = nn.Sequential(conv(width, 3 * scale**2))
            return
        self.conv_before_upsample = nn.Sequential(conv(width, 8), nn.LeakyReLU())
        self.conv_last = conv(8, 3)
        if kind == "shuffled":
            steps = [3] if scale == 3 else [2] * int(math.log2(scale))
            self.upsample = nn.Sequential(*(m for s in steps for m in (conv(8, 8 * s**2), nn.PixelShuffle(s))))
        else:
            self.conv_up1, self.conv_hr = conv(8, 8), conv(8, 8)
            if scale == 4:
                self.conv_up2 = conv(8, 8)

    def forward(self, x):
        rows, columns = x.shape[2:]
        mean = torch.tensor([0.4488, 0.4371, 0.4040], dtype=x.dtype).view(1, 3, 1, 1)
        x = functional.pad(x, (0, -columns % self.window, 0, -rows % self.window), "reflect") - mean
        first = self.conv_first(x)
        y = self.patch_embed["norm"](first.permute(0, 2, 3, 1))
        for layer in self.layers:
            z = y
            for block in layer["residual_group"]["blocks"]:
                z = block(z)
            y = y + layer["conv"](z.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        y = self.conv_after_body(self.norm(y).permute(0, 3, 1, 2)) + first
        if self.kind == "direct":
            y = functional.pixel_shuffle(self.upsample(y), self.scale)
        elif self.kind == "shuffled":
            y = self.conv_last(self.upsample(self.conv_before_upsample(y)))
        else:
            y = self.conv_before_upsample(y)
            for step in (self.conv_up1, self.conv_up2) if self.scale == 4 else (self.conv_up1,):
                y = functional.leaky_relu(step(functional.interpolate(y, scale_factor=2, mode="nearest")), 0.2)
            y = self.conv_last(functional.leaky_relu(self.conv_hr(y), 0.2))
        return (y + mean)[..., : rows * self.scale, : columns * self.scale]


def golden(name, network, cases):
    """Writes a network's golden file and returns its weights; `cases` are tuples (rows, columns of the input, further arguments)."""
    tensors = {key: value.detach().float().clone() for key, value in network.state_dict().items()}
    network.double()
    for i, (rows, columns, *more) in enumerate(cases):
        x = torch.rand(1, 3, rows, columns)
        tensors[f"golden.input.{i}"] = x
        with torch.no_grad():
            tensors[f"golden.output.{i}"] = network(x.double(), *more).float().contiguous()
    save_file(tensors, TO / f"{name}.safetensors")
    return {key: value for key, value in tensors.items() if not key.startswith("golden")}


def released(name, state):
    torch.save(state, ROOT / f"tests/data/{name}.pth")


TO.mkdir(parents=True, exist_ok=True)
imdn = golden("imdn", Imdn(16, 2, 3), [(9, 7)])
liif = golden("liif", Liif(6, 2, [24, 16]), [(9, 7, 18, 14), (7, 10, round(7 * 3.3), 33), (5, 6, 20, 24), (6, 5, 13, 21)])
golden("swinir_classical", SwinIr(12, [2, 3], 3, 4, "shuffled", 4), [(8, 12), (9, 13), (5, 7)])
golden("swinir_classical_x3", SwinIr(8, [2], 2, 4, "shuffled", 3), [(7, 9)])
light = golden("swinir_light", SwinIr(8, [2], 2, 4, "direct", 2), [(7, 9)])
golden("swinir_real", SwinIr(16, [2, 2], 2, 8, "repeated", 4, three_convs=True), [(16, 8), (11, 21)])
golden("swinir_real_x2", SwinIr(8, [2], 2, 4, "repeated", 2), [(10, 6)])

released("imdn", {f"module.{key}": value for key, value in imdn.items()})
# `shifts` and `extra` are tensors that the converter must ignore.
shifts = {f"encoder.{side}_mean.{part}": torch.eye(3) for side in ("sub", "add") for part in ("weight", "bias")}
released("liif", {"model": {"name": "liif", "args": {"cell_decode": True}, "sd": liif | shifts}, "epoch": 1000})
first = "layers.0.residual_group.blocks"
extra = {f"{first}.0.attn.relative_position_index": torch.zeros(16, 16, dtype=torch.long), f"{first}.1.attn_mask": torch.zeros(4, 16, 16)}
released("swinir", {"params": light | extra})

# Scores of IMDN's released weights on ten test views at 200 px over white; LR images by Pillow's bicubic filter.
data = pathlib.Path(os.environ.get("NERF_SR_DATA", ROOT.parent / "shared/data"))
imdn_x2 = data / "weights/imdn_x2.safetensors"
if imdn_x2.is_file():
    scores = {}
    for scale in (2, 4):
        weights = load_file(data / f"weights/imdn_x{scale}.safetensors")
        network = Imdn(64, 6, scale)
        network.load_state_dict({key.removeprefix("module."): value for key, value in weights.items()})
        frames = json.loads((data / "nerf_synthetic/lego/transforms_test.json").read_text())["frames"][:50:5]
        rows = []
        for frame in frames:
            picture = Image.open(data / "nerf_synthetic/lego" / (frame["file_path"] + ".png"))
            white = Image.new("RGBA", picture.size, "white")
            high = Image.alpha_composite(white, picture).convert("RGB").resize((200, 200), Image.LANCZOS)
            low = high.resize((200 // scale, 200 // scale), Image.BICUBIC)
            tensor = lambda image: torch.from_numpy(numpy.asarray(image).copy()).permute(2, 0, 1)[None].float() / 255
            with torch.no_grad():
                large = network(tensor(low)).clamp(0, 1)
            psnr = lambda x: -10 * math.log10(((x - tensor(high)).double() ** 2).mean())
            bicubic = tensor(low.resize((200, 200), Image.BICUBIC))
            rows.append({"view": frame["file_path"], "psnr": psnr(large), "bicubic_psnr": psnr(bicubic)})
        scores[f"x{scale}"] = rows
    (TO / "imdn-lego.json").write_text(json.dumps(scores, indent=2) + "\n")
else:
    print(f"IMDN on ten views: skipped: no {imdn_x2}")
