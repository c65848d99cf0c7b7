#!/usr/bin/env python3
"""Turns checkpoints of the reference implementation into a field that `render-depth` renders.

    scripts/convert-checkpoint.py 20_net_Coarse.pth 20_net_Fine.pth converted/
    nerf-sr run render-depth ...      # with `inputs: {field: ./converted, cameras: prep/cameras}` in pipeline.yaml

Needs PyTorch and safetensors (scripts/goldens-requirements.txt has versions that work). Every key and shape is checked.
"""

import argparse
import json
import pathlib
import sys

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("coarse", type=pathlib.Path, help="EPOCH_net_Coarse.pth")
parser.add_argument("fine", type=pathlib.Path, help="EPOCH_net_Fine.pth")
parser.add_argument("out", type=pathlib.Path, help="folder to make")
parser.add_argument("--near", type=float, default=2.0, help="where rays begin (Blender scenes: 2)")
parser.add_argument("--far", type=float, default=6.0, help="where rays end (Blender scenes: 6)")
parser.add_argument("--background", choices=["white", "black"], default="white")
options = parser.parse_args()

try:
    import torch
    from safetensors.torch import save_file
except ImportError as error:
    sys.exit(f"{error.name} is missing; pip install -r scripts/goldens-requirements.txt")

POSITION, DIRECTION, DEPTH, WIDTH = 63, 27, 8, 256
layers = {f"xyz_encoding_{i + 1}.0": (POSITION if i == 0 else POSITION + WIDTH if i == 4 else WIDTH, WIDTH) for i in range(DEPTH)}
layers |= {"sigma": (WIDTH, 1), "xyz_encoding_final": (WIDTH, WIDTH), "dir_encoding.0": (WIDTH + DIRECTION, WIDTH // 2), "rgb.0": (WIDTH // 2, 3)}
shapes = {f"{name}.{part}": shape for name, (i, o) in layers.items() for part, shape in (("weight", (o, i)), ("bias", (o,)))}

tensors = {}
for prefix, path in (("coarse", options.coarse), ("fine", options.fine)):
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        sys.exit(f"{path}: PyTorch can't read it: {str(error).splitlines()[0]}")
    # Checkpoints of several GPUs have a prefix before each name.
    state = {name.removeprefix("module."): value for name, value in state.items()}
    for name in sorted(shapes.keys() | state.keys()):
        if name not in state:
            sys.exit(f"{path}: tensor {name} is missing; is it a VanillaMLP of the published size?")
        if name not in shapes:
            sys.exit(f"{path}: tensor {name} doesn't belong to the network")
        if tuple(state[name].shape) != shapes[name]:
            sys.exit(f"{path}: tensor {name} is {tuple(state[name].shape)} where {shapes[name]} is expected")
        tensors[f"{prefix}.{name}"] = state[name].float().contiguous()

options.out.mkdir(parents=True, exist_ok=True)
save_file(tensors, options.out / "field-0.safetensors")
reach = options.far
description = {
    "field": {"mlp": {"position_octaves": 10, "direction_octaves": 4, "depth": DEPTH, "width": WIDTH, "coarse_samples": 64, "fine_samples": 64}},
    "members": 1,
    "bounds": {"min": [-reach] * 3, "max": [reach] * 3, "near": options.near, "far": options.far},
    "background": options.background,
}
(options.out / "field.json").write_text(json.dumps(description, indent=2) + "\n")
print(f"{options.out}: {len(tensors)} tensors")
