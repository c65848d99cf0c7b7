#!/usr/bin/env python3
"""Converts released weights of super-resolution networks to the safetensors files that `upsample` reads.

    scripts/convert-weights.py imdn IMDN_x2.pth weights/imdn_x2.safetensors
    scripts/convert-weights.py liif edsr-baseline-liif.pth weights/liif.safetensors
    scripts/convert-weights.py swinir 001_classicalSR_DF2K_s64w8_SwinIR-M_x2.pth weights/swinir_x2.safetensors

Needs only Python's standard library. Sizes are read from some tensors; all names, and all other shapes against these sizes, are checked.
Tensors that `upsample` doesn't use or computes itself (LIIF's colour shifts, SwinIR's masks and indices) are left out.
"""

import argparse
import math
import pathlib
import re
import sys

import checkpoints

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("network", choices=["imdn", "liif", "swinir"])
parser.add_argument("checkpoint", type=pathlib.Path, help="released FILE.pth")
parser.add_argument("out", type=pathlib.Path, help="FILE.safetensors to write")
options = parser.parse_args()


def layer(name: str, outputs: int, inputs: int, *kernel: int) -> dict:
    return {f"{name}.weight": (outputs, inputs, *kernel), f"{name}.bias": (outputs,)}


def conv(name: str, outputs: int, inputs: int, size: int = 3) -> dict:
    return layer(name, outputs, inputs, size, size)


def count(state: dict, pattern: str) -> int:
    """Returns the number of distinct numbers that the pattern's group matches in the tensors' names."""
    return len({match[1] for name in state if (match := re.match(pattern, name))})


def imdn(state: dict) -> dict:
    """Returns the expected shapes of IMDN's tensors by name; sizes are read from `state`."""
    width = state["fea_conv.weight"].shape[0]
    blocks, kept = count(state, r"IMDB(\d+)\."), width // 4
    rest, narrow = width - kept, state["IMDB1.cca.conv_du.0.weight"].shape[0]
    expected = conv("fea_conv", width, 3) | conv("c.0", width, width * blocks, 1) | conv("LR_conv", width, width)
    expected |= conv("upsampler.0", state["upsampler.0.weight"].shape[0], width)
    for block in (f"IMDB{i + 1}" for i in range(blocks)):
        expected |= conv(f"{block}.c1", width, width) | conv(f"{block}.c2", width, rest) | conv(f"{block}.c3", width, rest)
        expected |= conv(f"{block}.c4", kept, rest) | conv(f"{block}.c5", width, 4 * kept, 1)
        expected |= conv(f"{block}.cca.conv_du.0", narrow, 4 * kept, 1) | conv(f"{block}.cca.conv_du.2", 4 * kept, narrow, 1)
    return expected


def liif(state: dict) -> dict:
    """Returns the expected shapes of LIIF's tensors by name; sizes are read from `state`."""
    width = state["encoder.head.0.weight"].shape[0]
    blocks = count(state, r"encoder\.body\.(\d+)\.body\.")
    expected = conv("encoder.head.0", width, 3) | conv(f"encoder.body.{blocks}", width, width)
    for i in range(blocks):
        expected |= conv(f"encoder.body.{i}.body.0", width, width) | conv(f"encoder.body.{i}.body.2", width, width)
    layers, inputs = count(state, r"imnet\.layers\.(\d+)\."), 9 * width + 4
    for i in range(layers):
        outputs = 3 if i + 1 == layers else state[f"imnet.layers.{2 * i}.weight"].shape[0]
        expected |= layer(f"imnet.layers.{2 * i}", outputs, inputs)
        inputs = outputs
    return expected


def swinir(state: dict) -> dict:
    """Returns the expected shapes of SwinIR's tensors by name; sizes and variant are read from `state`."""
    width = state["conv_first.weight"].shape[0]

    def convs(name: str) -> dict:
        if f"{name}.weight" in state:
            return conv(name, width, width)
        narrow = width // 4
        return conv(f"{name}.0", narrow, width) | conv(f"{name}.2", narrow, narrow, 1) | conv(f"{name}.4", width, narrow)

    norm = lambda name: {f"{name}.weight": (width,), f"{name}.bias": (width,)}
    expected = conv("conv_first", width, 3) | norm("norm") | convs("conv_after_body")
    if "patch_embed.norm.weight" in state:
        expected |= norm("patch_embed.norm")
    for i in range(count(state, r"layers\.(\d+)\.")):
        expected |= convs(f"layers.{i}.conv")
        for k in range(count(state, rf"layers\.{i}\.residual_group\.blocks\.(\d+)\.")):
            block = f"layers.{i}.residual_group.blocks.{k}"
            hidden = state[f"{block}.mlp.fc1.weight"].shape[0]
            table, heads = state[f"{block}.attn.relative_position_bias_table"].shape
            if (math.isqrt(table) % 2, math.isqrt(table) ** 2) != (1, table):
                sys.exit(f"{options.checkpoint}: a table of {table} biases doesn't fit a square window")
            expected |= norm(f"{block}.norm1") | norm(f"{block}.norm2")
            expected |= {f"{block}.attn.relative_position_bias_table": (table, heads)}
            expected |= layer(f"{block}.attn.qkv", 3 * width, width) | layer(f"{block}.attn.proj", width, width)
            expected |= layer(f"{block}.mlp.fc1", hidden, width) | layer(f"{block}.mlp.fc2", width, hidden)
    if "conv_before_upsample.0.weight" not in state:
        return expected | conv("upsample.0", state["upsample.0.weight"].shape[0], width)
    middle = state["conv_before_upsample.0.weight"].shape[0]
    expected |= conv("conv_before_upsample.0", middle, width) | conv("conv_last", 3, middle)
    if "conv_up1.weight" in state:
        for name in ["conv_hr", *(f"conv_up{i + 1}" for i in range(count(state, r"conv_up(\d+)\.")))]:
            expected |= conv(name, middle, middle)
        return expected
    for i in range(count(state, r"upsample\.(\d+)\.")):
        expected |= conv(f"upsample.{2 * i}", state[f"upsample.{2 * i}.weight"].shape[0], middle)
    return expected


whole = checkpoints.read(options.checkpoint)
# Nested keys under which the projects save the weights, outermost first.
for key in ("params_ema", "params", "model", "sd"):
    if isinstance(whole, dict) and isinstance(whole.get(key), dict):
        whole = whole[key]
left_out = r"encoder\.(sub|add)_mean\.|.*\.(attn_mask|relative_position_index)$"
state = {name: tensor for name, tensor in checkpoints.tensors(options.checkpoint, whole).items() if not re.match(left_out, name)}
try:
    expected = {"imdn": imdn, "liif": liif, "swinir": swinir}[options.network](state)
except KeyError as error:
    sys.exit(f"{options.checkpoint}: tensor {error.args[0]} is missing; expected the weights of {options.network}")
except (IndexError, ValueError):
    sys.exit(f"{options.checkpoint}: the tensors' shapes are not those of {options.network}")
checkpoints.write(options.out, checkpoints.check(options.checkpoint, state, expected, options.network))
print(f"{options.out}: {len(state)} tensors")
