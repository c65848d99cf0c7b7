#!/usr/bin/env python3
"""Generates the golden file of the paper's field (`torch-field`) with PyTorch's own layers and optimiser: run by `make goldens`.

Networks, sampling and compositing are built here from their published descriptions. Inputs and weights are draws of
`numerics::uniform`, which draws.py repeats, so the safetensors file contains only outputs. The script also writes two small
checkpoints for tests/checkpoint.rs.
"""

import collections
import math
import pathlib

import torch
from safetensors.torch import save_file

import draws

ROOT = pathlib.Path(__file__).resolve().parents[2]
SEED = 11


def draw(purpose, *shape):
    """Returns the numbers in [0, 1) of `numerics::uniform(SEED, purpose, 0..)`."""
    return torch.from_numpy(draws.uniform(SEED, purpose, math.prod(shape))).reshape(shape)


def encode(x, octaves):
    parts = [x]
    for k in range(octaves):
        parts += [torch.sin(2.0**k * x), torch.cos(2.0**k * x)]
    return torch.cat(parts, -1)


class Network(torch.nn.Module):
    """NeRF's network: `depth` layers with a skip connection of the position to the fifth; heads for density, feature and colour."""

    def __init__(self, octaves, depth, width, purpose):
        super().__init__()
        self.octaves = octaves
        position, direction = (3 * (1 + 2 * n) for n in octaves)
        inputs = [position if i == 0 else position + width if i == 4 else width for i in range(depth)]
        self.trunk = torch.nn.ModuleList(torch.nn.Linear(n, width) for n in inputs)
        self.density = torch.nn.Linear(width, 1)
        self.feature = torch.nn.Linear(width, width)
        self.direction = torch.nn.Linear(width + direction, width // 2)
        self.colour = torch.nn.Linear(width // 2, 3)
        self.double()
        with torch.no_grad():
            for i, layer in enumerate([*self.trunk, self.density, self.feature, self.direction, self.colour]):
                bound = math.sqrt(6 / layer.in_features)
                layer.weight.copy_(bound * (2 * draw(purpose + 2 * i, *layer.weight.shape) - 1))
                layer.bias.copy_(0.2 * draw(purpose + 2 * i + 1, *layer.bias.shape) - 0.05)

    def ordered(self):
        layers = [*self.trunk, self.density, self.feature, self.direction, self.colour]
        return [p for layer in layers for p in (layer.weight, layer.bias)]

    def forward(self, position, direction):
        code = encode(position, self.octaves[0])
        x = code
        for i, layer in enumerate(self.trunk):
            if i == 4:
                x = torch.cat([code, x], -1)
            x = torch.relu(layer(x))
        shaded = torch.relu(self.direction(torch.cat([self.feature(x), encode(direction, self.octaves[1])], -1)))
        return torch.sigmoid(self.colour(shaded)), self.density(x)[..., 0]


def composite(t, colour, raw, background):
    gaps = torch.cat([t[:, 1:] - t[:, :-1], torch.full_like(t[:, :1], 1e10)], 1)
    alpha = 1 - torch.exp(-gaps * torch.relu(raw))
    light = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha + 1e-10], 1), 1)[:, :-1]
    weights = alpha * light
    return (weights[..., None] * colour).sum(1) + (1 - weights.sum(1, keepdim=True)) * background, weights


def stratify(t, u):
    middles = (t[:, 1:] + t[:, :-1]) / 2
    lower, upper = torch.cat([t[:, :1], middles], 1), torch.cat([middles, t[:, -1:]], 1)
    return lower + (upper - lower) * u


def importance(edges, weights, u):
    weights = weights + 1e-5
    cumulative = torch.cumsum(weights / weights.sum(1, keepdim=True), 1)
    cumulative = torch.cat([torch.zeros_like(cumulative[:, :1]), cumulative], 1)
    above = torch.searchsorted(cumulative, u.contiguous(), right=True)
    below, above = (above - 1).clamp(min=0), above.clamp(max=weights.shape[1])
    low, high = cumulative.gather(1, below), cumulative.gather(1, above)
    width = torch.where(high - low < 1e-5, torch.ones_like(low), high - low)
    first, last = edges.gather(1, below), edges.gather(1, above)
    return first + (u - low) / width * (last - first)


def render(network, origin, direction, t, background, noise):
    n, m = t.shape
    position = origin[:, None] + t[..., None] * direction[:, None]
    colour, raw = network(position.reshape(-1, 3), direction[:, None].expand(n, m, 3).reshape(-1, 3))
    return composite(t, colour.reshape(n, m, 3), raw.reshape(n, m) + noise, background)


out = {}

# Forward pass at the published size, in single precision.
full = Network((10, 4), 8, 256, 1000).float()
position, direction = (4 * draw(1, 8, 3) - 2).float(), (2 * draw(2, 8, 3) - 1).float()
out["encoding"] = encode(position, 10)
out["full.colour"], out["full.density"] = (x.detach() for x in full(position, direction))

# Three training steps of small networks, in double precision.
n, m = 8, 8
coarse, fine = Network((4, 2), 6, 16, 2000), Network((4, 2), 6, 16, 3000)
origin = 0.5 * draw(3, n, 3) + torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
direction = draw(4, n, 3) - 0.5
direction[:, 2] = -1
background = draw(5, n, 3)
target = draw(6, n // 4, 3)
u_coarse, u_fine = draw(7, n, m), draw(8, n, m)
noise_coarse, noise_fine = draw(9, n, m) - 0.5, draw(10, n, 2 * m) - 0.5
near, far = 2.0, 6.0
even = (near + (far - near) * torch.linspace(0, 1, m, dtype=torch.float64)).expand(n, m)
parameters = coarse.ordered() + fine.ordered()
optimiser = torch.optim.Adam(parameters, lr=5e-4)
for step in range(3):
    t = stratify(even, u_coarse)
    coarse_colour, coarse_weights = render(coarse, origin, direction, t, background, noise_coarse)
    more = importance((t[:, 1:] + t[:, :-1]) / 2, coarse_weights[:, 1:-1].detach(), u_fine)
    both = torch.sort(torch.cat([t, more], 1), 1).values
    fine_colour, fine_weights = render(fine, origin, direction, both, background, noise_fine)
    loss = sum(((c.reshape(-1, 4, 3).mean(1) - target) ** 2).mean() for c in (coarse_colour, fine_colour))
    optimiser.zero_grad()
    loss.backward()
    if step == 0:
        out |= {"stratified": t, "importance": more, "coarse.weights": coarse_weights, "fine.weights": fine_weights}
        out |= {"coarse.colour": coarse_colour, "fine.colour": fine_colour, "loss": loss.reshape(1)}
        out["gradient"] = torch.cat([p.grad.reshape(-1) for p in parameters])
        # Positions from the same weights with evenly spaced draws, as in rendering.
        edges = (even[:, 1:] + even[:, :-1]) / 2
        out["importance.even"] = importance(edges, coarse_weights[:, 1:-1], torch.linspace(0, 1, m, dtype=torch.float64).expand(n, m))
    optimiser.step()
out["parameters"] = torch.cat([p.reshape(-1) for p in parameters])

path = ROOT / "stages/common/field/torch-field/tests/goldens/mlp.safetensors"
path.parent.mkdir(parents=True, exist_ok=True)
save_file({name: x.detach().contiguous() for name, x in out.items()}, path, {"torch": torch.__version__.split("+")[0]})
print(path, path.stat().st_size)

# Small checkpoints in the reference implementation's layout, for scripts/convert-checkpoint.py: weights of layer k are k, k + 1/8,
# k + 2/8 …, its biases -k, -k - 1/8 …
# The coarse one has names of a multi-GPU checkpoint, the fine one has half precision and a transposed tensor.
names = [f"xyz_encoding_{i + 1}.0" for i in range(6)] + ["sigma", "xyz_encoding_final", "dir_encoding.0", "rgb.0"]
position, direction, width = 15, 9, 8
inputs = [position, width, width, width, position + width, width, width, width, width + direction, width // 2]
outputs = [width] * 6 + [1, width, width // 2, 3]
for which, prefix, kind in (("Coarse", "module.", torch.float32), ("Fine", "", torch.float16)):
    state = collections.OrderedDict()
    for k, (name, i, o) in enumerate(zip(names, inputs, outputs)):
        state[f"{prefix}{name}.weight"] = (k + torch.arange(o * i) / 8).reshape(o, i).to(kind)
        state[f"{prefix}{name}.bias"] = (-k - torch.arange(o) / 8).to(kind)
    if which == "Fine":
        state["rgb.0.weight"] = state["rgb.0.weight"].t().contiguous().t()
    torch.save(state, ROOT / f"tests/data/7_net_{which}.pth")
