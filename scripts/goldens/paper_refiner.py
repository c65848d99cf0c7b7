#!/usr/bin/env python3
"""Generates the golden files of `refinement::paper` with PyTorch's own layers in f64: run by `make goldens`.

The network and VGG-19's blocks are built here from their published descriptions, with narrow layers and fixed random weights. Golden files
contain features after each block, the network's output with running and with batch statistics, the loss with and without its perceptual
part, and all gradients.
"""

import pathlib

import torch
from safetensors.torch import save_file
from torch import nn
from torch.nn import functional

ROOT = pathlib.Path(__file__).resolve().parents[2]
TO = ROOT / "stages/common/refinement/refinement/tests/goldens"
torch.manual_seed(3)


class Layer(nn.Module):
    def __init__(self, inputs, outputs, stride=1, normalised=True):
        super().__init__()
        conv = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.weight, self.bias, self.stride = conv.weight, conv.bias, stride
        self.norm = nn.BatchNorm2d(outputs) if normalised else None
        if normalised:
            nn.init.normal_(self.norm.weight, 1, 0.2)
            nn.init.normal_(self.norm.bias, 0, 0.1)
            self.norm.running_mean.normal_(0, 0.2)
            self.norm.running_var.uniform_(0.5, 1.5)

    def forward(self, x):
        y = functional.conv2d(x, self.weight, self.bias, self.stride, 1)
        return self.norm(y) if self.norm else y


class Refiner(nn.Module):
    def __init__(self, w):
        super().__init__()
        sizes = [(3, w, 1, False), (w, w), (w, 2 * w, 2), (2 * w, 2 * w), (2 * w, 4 * w, 2), (4 * w, 4 * w), (4 * w, 4 * w, 2)]
        self.encoder = nn.ModuleList(Layer(*size) for size in sizes)
        sizes = [(8, 4), (4, 4), (4, 4), (12, 4), (4, 4), (4, 2), (6, 2), (2, 2), (2, 1), (3, 1), (1, 1)]
        self.decoder = nn.ModuleList([*(Layer(a * w, b * w) for a, b in sizes), Layer(w, 3, 1, False)])

    def encode(self, x):
        taps = []
        for i, layer in enumerate(self.encoder):
            x = torch.relu(layer(x))
            if i in (1, 3, 5, 6):
                taps.append(x)
        return taps

    def forward(self, rendered, references):
        own = self.encode(rendered)
        count = len(rendered)
        best = [f.view(count, -1, *f.shape[1:]).amax(1) for f in self.encode(references)]
        layer, up = iter(self.decoder), lambda x: functional.interpolate(x, scale_factor=2, mode="nearest")
        step = lambda x: torch.relu(next(layer)(x))
        x = step(up(step(step(torch.cat([own[3], best[3]], 1)))))
        x = step(up(step(step(torch.cat([x, own[2], best[2]], 1)))))
        x = step(up(step(step(torch.cat([x, own[1], best[1]], 1)))))
        x = step(step(torch.cat([x, own[0], best[0]], 1)))
        return torch.tanh(next(layer)(x))


BLOCKS = [2, 2, 4, 4, 4]
WIDTHS = [4, 4, 6, 6, 6]


def vgg(kind):
    """Writes random weights of the blocks and returns the perceptual distance that uses them."""
    weights, inputs, index, convs = {}, 3, 0, []
    for block in range(3 if kind == "caffe" else 5):
        for i in range(BLOCKS[block]):
            name = f"conv{block + 1}_{i + 1}" if kind == "caffe" else f"features.{index + 2 * i}"
            conv = nn.Conv2d(inputs, WIDTHS[block], 3, padding=1)
            nn.init.kaiming_normal_(conv.weight)
            weights |= {f"{name}.weight": conv.weight.detach().clone(), f"{name}.bias": conv.bias.detach().clone()}
            convs.append((block, i, name))
            inputs = WIDTHS[block]
        index += 2 * BLOCKS[block] + 1
    constant = lambda *values: torch.tensor(values, dtype=torch.float64).view(1, 3, 1, 1)

    def features(x):
        x = (x + 1) / 2
        if kind == "caffe":
            x = x.flip(1) * 255 - constant(103.939, 116.779, 123.68)
        else:
            x = (x - constant(0.485, 0.456, 0.406)) / constant(0.229, 0.224, 0.225)
        found = []
        for block, i, name in convs:
            if i == 0 and block:
                x = functional.max_pool2d(x, 2)
            x = torch.relu(functional.conv2d(x, weights[f"{name}.weight"].double(), weights[f"{name}.bias"].double(), padding=1))
            if i == 1:
                found.append(x)
        return found

    def distance(a, b):
        total = 0
        for x, y, share in zip(features(a), features(b), (1, 0.75, 0.5, 0.5, 1)):
            total = total + share * (x - y).abs().mean() / (y.abs().mean() + 1e-6 if kind == "caffe" else 1)
        return total

    save_file(weights, TO / f"vgg-{kind}.safetensors")
    return distance


TO.mkdir(parents=True, exist_ok=True)
network = Refiner(4)
state = {name: value.detach().clone() for name, value in network.state_dict().items() if "num_batches" not in name}
network.double()
patches = lambda count: torch.rand(count, 3, 16, 16) * 2 - 1
rendered, references, truth = patches(2), patches(6), patches(2)
tensors = state | {"golden.rendered": rendered, "golden.references": references, "golden.truth": truth}
rendered, references, truth = rendered.double(), references.double(), truth.double()
with torch.no_grad():
    network.eval()
    for i, feature in enumerate(network.encode(rendered)):
        tensors[f"golden.features.{i}"] = feature
    tensors["golden.drawn"] = network(rendered, references)
    network.train()
    tensors["golden.training"] = network(rendered, references)
    network.eval()
    tensors["golden.moved"] = network(rendered, references)
network.train()
for kind in ("l1", "caffe", "torchvision"):
    found = network(rendered, references)
    loss = (found - truth).abs().mean()
    if kind != "l1":
        loss = loss + vgg(kind)(found, truth)
    network.zero_grad()
    loss.backward()
    tensors[f"golden.{kind}.loss"] = loss.detach().reshape(1)
    tensors |= {f"golden.{kind}.{name}": value.grad.clone() for name, value in network.named_parameters()}
save_file({name: value.float().contiguous() for name, value in tensors.items()}, TO / "golden.safetensors")
