"""Module that reads PyTorch checkpoints and writes safetensors, with the standard library only. A checkpoint is a ZIP file of a pickle and
raw numbers; no code in the pickle is executed."""

import array
import collections
import json
import math
import pathlib
import pickle
import struct
import sys
import zipfile

# Format characters of `struct` for PyTorch's storage types.
KINDS = {"FloatStorage": "f", "HalfStorage": "e", "DoubleStorage": "d", "LongStorage": "q", "IntStorage": "i", "BoolStorage": "?"}

# Tensor with its shape and its numbers in row-major order.
Tensor = collections.namedtuple("Tensor", ["shape", "numbers"])


class Unpickler(pickle.Unpickler):
    """Unpickler of dictionaries, lists, tensors, strings and numbers; all other objects are refused."""

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
            raise ValueError(f"the pickle contains {module}.{name}; only tensors are expected")
        return allowed[module, name]

    def persistent_load(self, identity):
        _, kind, key, _, count = identity
        return struct.unpack(f"<{count}{KINDS[kind]}", self.archive.read(f"{self.folder}data/{key}"))

    @staticmethod
    def tensor(storage, offset, shape, stride, *_):
        count, dense = math.prod(shape), tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))
        if tuple(stride) == dense:
            return Tensor(tuple(shape), storage[offset : offset + count])
        places = [offset]
        for length, step in zip(shape, stride):
            places = [place + step * i for place in places for i in range(length)]
        return Tensor(tuple(shape), [storage[place] for place in places])


def read(path: pathlib.Path) -> dict:
    """Returns the content of a checkpoint; exits with one line if the file can't be read."""
    try:
        with zipfile.ZipFile(path) as archive:
            (name,) = [name for name in archive.namelist() if name.endswith("data.pkl")]
            return Unpickler(archive, name).load()
    except zipfile.BadZipFile:
        sys.exit(f"{path}: not a checkpoint of PyTorch 1.6 or newer; load the file in a newer PyTorch and save it again")
    except OSError as error:
        sys.exit(f"{path}: {error.strerror}")
    except Exception as error:
        sys.exit(f"{path}: not a dictionary of tensors: {error}")


def tensors(path: pathlib.Path, state: dict) -> dict:
    """Checks that a dictionary contains only tensors; returns them without `module.`, the name prefix of multi-GPU checkpoints."""
    if not isinstance(state, dict) or not all(isinstance(tensor, Tensor) for tensor in state.values()):
        sys.exit(f"{path}: not a dictionary of tensors")
    return {name.removeprefix("module."): tensor for name, tensor in state.items()}


def check(path: pathlib.Path, state: dict, expected: dict, network: str) -> dict:
    """Returns the tensors if names and shapes are those of the network and all numbers are finite; exits otherwise."""
    for name in sorted(expected.keys() | state.keys()):
        if name not in state:
            sys.exit(f"{path}: tensor {name} is missing; expected the weights of {network}")
        if name not in expected:
            sys.exit(f"{path}: tensor {name} doesn't belong to {network}")
        shape, numbers = state[name]
        if shape != expected[name]:
            sys.exit(f"{path}: tensor {name}: expected shape {expected[name]}, found {shape}")
        if not all(map(math.isfinite, numbers)):
            sys.exit(f"{path}: tensor {name} has numbers that are not finite")
    return state


def write(path: pathlib.Path, state: dict) -> None:
    """Writes tensors as f32 safetensors, sorted by name so that equal tensors give equal bytes."""
    header, data = {}, bytearray()
    for name, (shape, numbers) in sorted(state.items()):
        numbers = array.array("f", numbers)
        if sys.byteorder == "big":
            numbers.byteswap()
        start = len(data)
        data += numbers.tobytes()
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [start, len(data)]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(struct.pack("<Q", len(text)) + text + data)
    partial.replace(path)
