#!/usr/bin/env python3
"""Turns checkpoints of the reference implementation into a field that `render-depth` renders.

    scripts/convert-checkpoint.py 20_net_Coarse.pth 20_net_Fine.pth converted/
    nerf-sr run render-depth ...      # with `inputs: {field: ./converted, cameras: prep/cameras}` in pipeline.yaml

Needs nothing but Python: a checkpoint is a ZIP file of a pickle and raw numbers, of which no code is run. Sizes of the networks
are read from their layers; every key and shape is checked.
"""

import argparse
import array
import json
import math
import pathlib
import pickle
import struct
import sys
import zipfile

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("coarse", type=pathlib.Path, help="EPOCH_net_Coarse.pth")
parser.add_argument("fine", type=pathlib.Path, help="EPOCH_net_Fine.pth")
parser.add_argument("out", type=pathlib.Path, help="folder to make")
parser.add_argument("--near", type=float, default=2.0, help="where rays begin (Blender scenes: 2)")
parser.add_argument("--far", type=float, default=6.0, help="where rays end (Blender scenes: 6)")
parser.add_argument("--background", choices=["white", "black"], default="white")
options = parser.parse_args()

# Kinds of numbers, as `struct` calls them.
KINDS = {"FloatStorage": "f", "HalfStorage": "e", "DoubleStorage": "d"}


class Tensors(pickle.Unpickler):
    """Reads a dictionary of tensors as (shape, numbers); anything else in the pickle is refused."""

    def __init__(self, archive: zipfile.ZipFile, name: str):
        super().__init__(archive.open(name))
        self.archive, self.folder = archive, name.removesuffix("data.pkl")

    def find_class(self, module, name):
        allowed = {
            ("collections", "OrderedDict"): dict,
            ("torch._utils", "_rebuild_tensor_v2"): self.tensor,
            ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
            **{("torch", kind): kind for kind in KINDS},
        }
        if (module, name) not in allowed:
            raise ValueError(f"it holds a {module}.{name}; weights alone are expected")
        return allowed[module, name]

    def persistent_load(self, identity):
        _, kind, key, _, count = identity
        numbers = self.archive.read(f"{self.folder}data/{key}")
        return struct.unpack(f"<{count}{KINDS[kind]}", numbers)

    @staticmethod
    def tensor(storage, offset, shape, stride, *_):
        places = [offset]
        for length, step in zip(shape, stride):
            places = [place + step * i for place in places for i in range(length)]
        return tuple(shape), [storage[place] for place in places]


def read(path: pathlib.Path) -> dict:
    try:
        with zipfile.ZipFile(path) as archive:
            (name,) = [name for name in archive.namelist() if name.endswith("data.pkl")]
            state = Tensors(archive, name).load()
        # Checkpoints of several GPUs have a prefix before each name.
        return {name.removeprefix("module."): tensor for name, tensor in state.items()}
    except zipfile.BadZipFile:
        sys.exit(f"{path}: not a checkpoint of PyTorch 1.6 or newer; load it there and save it again")
    except OSError as error:
        sys.exit(f"{path}: {error.strerror}")
    except Exception as error:
        sys.exit(f"{path}: not a dictionary of tensors: {error}")


def octaves(path: pathlib.Path, inputs: int) -> int:
    if inputs < 3 or inputs % 6 != 3:
        sys.exit(f"{path}: {inputs} inputs are no encoded position or direction (3 and 6 for every octave)")
    return (inputs - 3) // 6


def sizes(path: pathlib.Path, state: dict) -> dict:
    """What the layers say of the network."""
    try:
        width, position = state["xyz_encoding_1.0.weight"][0]
        direction = state["dir_encoding.0.weight"][0][1] - width
    except (KeyError, ValueError) as error:
        sys.exit(f"{path}: tensor {error} is missing; is it a VanillaMLP?")
    depth = sum(name.startswith("xyz_encoding_") and name.endswith(".0.weight") for name in state)
    return {"position_octaves": octaves(path, position), "direction_octaves": octaves(path, direction), "depth": depth, "width": width}


def shapes(network: dict) -> dict:
    """Names and shapes of a network's tensors."""
    position, direction = (3 + 6 * network[f"{of}_octaves"] for of in ("position", "direction"))
    width, depth = network["width"], network["depth"]
    # The position joins in again at the fifth layer.
    layers = {f"xyz_encoding_{i + 1}.0": (position if i == 0 else position + width if i == 4 else width, width) for i in range(depth)}
    layers |= {"sigma": (width, 1), "xyz_encoding_final": (width, width)}
    layers |= {"dir_encoding.0": (width + direction, width // 2), "rgb.0": (width // 2, 3)}
    return {f"{name}.{part}": shape for name, (i, o) in layers.items() for part, shape in (("weight", (o, i)), ("bias", (o,)))}


networks, tensors = [], {}
for prefix, path in (("coarse", options.coarse), ("fine", options.fine)):
    state = read(path)
    networks.append(sizes(path, state))
    expected = shapes(networks[-1])
    for name in sorted(expected.keys() | state.keys()):
        if name not in state:
            sys.exit(f"{path}: tensor {name} is missing; is it a VanillaMLP?")
        if name not in expected:
            sys.exit(f"{path}: tensor {name} doesn't belong to the network")
        shape, numbers = state[name]
        if shape != expected[name]:
            sys.exit(f"{path}: tensor {name} is {shape} where {expected[name]} is expected")
        if not all(map(math.isfinite, numbers)):
            sys.exit(f"{path}: tensor {name} is not finite")
        tensors[f"{prefix}.{name}"] = (shape, array.array("f", numbers))
if networks[0] != networks[1]:
    sys.exit(f"{options.fine}: its network is {networks[1]}, that of {options.coarse} {networks[0]}")

header, data = {}, bytearray()
for name, (shape, numbers) in sorted(tensors.items()):
    if sys.byteorder == "big":
        numbers.byteswap()
    start = len(data)
    data += numbers.tobytes()
    header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [start, len(data)]}
text = json.dumps(header, separators=(",", ":")).encode()
text += b" " * (-len(text) % 8)
options.out.mkdir(parents=True, exist_ok=True)
(options.out / "field-0.safetensors").write_bytes(struct.pack("<Q", len(text)) + text + data)
reach = options.far
description = {
    "field": {"mlp": networks[0] | {"coarse_samples": 64, "fine_samples": 64}},
    "members": 1,
    "bounds": {"min": [-reach] * 3, "max": [reach] * 3, "near": options.near, "far": options.far},
    "background": options.background,
}
(options.out / "field.json").write_text(json.dumps(description, indent=2) + "\n")
print(f"{options.out}: {len(tensors)} tensors")
