#!/usr/bin/env python3
"""Converts checkpoints of the reference implementation to a field that `render-depth` renders.

    scripts/convert-checkpoint.py 20_net_Coarse.pth 20_net_Fine.pth converted/
    nerf-sr run render-depth ...      # with `inputs: {field: ./converted, cameras: prep/cameras}` in pipeline.yaml

Needs only Python's standard library. Sizes of the networks are read from their layers; all names and shapes are checked.
"""

import argparse
import json
import pathlib
import sys

import checkpoints

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("coarse", type=pathlib.Path, help="EPOCH_net_Coarse.pth")
parser.add_argument("fine", type=pathlib.Path, help="EPOCH_net_Fine.pth")
parser.add_argument("out", type=pathlib.Path, help="folder to create")
parser.add_argument("--near", type=float, default=2.0, help="distance at which rays begin (default 2, for Blender scenes)")
parser.add_argument("--far", type=float, default=6.0, help="distance at which rays end (default 6, for Blender scenes)")
parser.add_argument("--background", choices=["white", "black"], default="white")
options = parser.parse_args()

def octaves(path: pathlib.Path, inputs: int) -> int:
    """Returns the octaves of an encoding with this many values; exits if no number of octaves fits."""
    if inputs < 3 or inputs % 6 != 3:
        sys.exit(f"{path}: {inputs} inputs, which is not the size of an encoded position or direction (3 and 6 per octave)")
    return (inputs - 3) // 6


def sizes(path: pathlib.Path, state: dict) -> dict:
    """Returns the network's sizes, read from its layers."""
    try:
        first, directional = (state[f"{layer}.0.weight"].shape for layer in ("xyz_encoding_1", "dir_encoding"))
    except KeyError as error:
        sys.exit(f"{path}: tensor {error} is missing; expected the weights of a VanillaMLP")
    if len(first) != 2 or len(directional) != 2:
        sys.exit(f"{path}: weights have the shapes {first} and {directional}; expected matrices, as in a VanillaMLP")
    width, position = first
    direction = directional[1] - width
    depth = sum(name.startswith("xyz_encoding_") and name.endswith(".0.weight") for name in state)
    return {"position_frequencies": octaves(path, position), "direction_frequencies": octaves(path, direction), "layers": depth, "hidden_dim": width}


def shapes(network: dict) -> dict:
    """Returns the shapes of a network's tensors by name."""
    position, direction = (3 + 6 * network[f"{of}_frequencies"] for of in ("position", "direction"))
    width, depth = network["hidden_dim"], network["layers"]
    # Skip connection: the fifth layer also reads the encoded position.
    layers = {f"xyz_encoding_{i + 1}.0": (position if i == 0 else position + width if i == 4 else width, width) for i in range(depth)}
    layers |= {"sigma": (width, 1), "xyz_encoding_final": (width, width)}
    layers |= {"dir_encoding.0": (width + direction, width // 2), "rgb.0": (width // 2, 3)}
    return {f"{name}.{part}": shape for name, (i, o) in layers.items() for part, shape in (("weight", (o, i)), ("bias", (o,)))}


networks, tensors = [], {}
for prefix, path in (("coarse", options.coarse), ("fine", options.fine)):
    state = checkpoints.tensors(path, checkpoints.read(path))
    networks.append(sizes(path, state))
    checked = checkpoints.check(path, state, shapes(networks[-1]), "a VanillaMLP")
    tensors |= {f"{prefix}.{name}": tensor for name, tensor in checked.items()}
if networks[0] != networks[1]:
    sys.exit(f"{options.fine}: network sizes {networks[1]} differ from {networks[0]} in {options.coarse}")

checkpoints.write(options.out / "field-0.safetensors", tensors)
# The box is chosen by hand: positions are world coordinates, and rays end at --far. Numbers of samples are those of the authors' scripts.
reach = options.far
description = {
    "field": {"mlp": networks[0] | {"coarse_samples": 64, "fine_samples": 64}},
    "members": 1,
    "bounds": {"min": [-reach] * 3, "max": [reach] * 3, "near": options.near, "far": options.far},
    "background": options.background,
}
(options.out / "field.json").write_text(json.dumps(description, indent=2) + "\n")
print(f"{options.out}: {len(tensors)} tensors")
