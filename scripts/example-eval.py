#!/usr/bin/env python3
"""Example of a stage in another language: replaces eval by the mean squared error. Needs only Python 3.

    stages:
      eval:
        run: ./scripts/example-eval.py

The script follows the stage contract: `describe` prints JSON; a run reads --params and --input NAME=DIR, creates --output DIR, reports
an error as one line on stderr, and exits with 0 (done), 1 (failed), 2 (wrong usage) or 3 (bad input). The runner writes artifact.json.
"""

import argparse
import hashlib
import json
import pathlib
import struct
import sys
import zlib


def describe():
    """Returns the description that the runner reads: parameters, inputs and output of the stage."""
    return {
        "name": "example-eval",
        "version": "1",
        "code": hashlib.sha256(pathlib.Path(__file__).read_bytes()).hexdigest(),
        "summary": "Mean squared error of 8-bit previews.",
        "parameters": {
            "type": "object",
            "additionalProperties": False,
            "properties": {"peak": {"type": "number", "exclusiveMinimum": 0, "default": 255, "description": "Value of white."}},
        },
        "inputs": {
            "views": {"kinds": ["views"], "summary": "rendered views"},
            "truth": {"kinds": ["scene/truth"], "summary": "ground truth"},
        },
        "output": {"kind": "metrics"},
    }


def read_png(path):
    """Reads an 8-bit RGB or RGBA PNG; returns its RGB values over white, row by row."""
    data = path.read_bytes()
    position, compressed = 8, b""
    while position < len(data):
        (length,), kind = struct.unpack(">I", data[position : position + 4]), data[position + 4 : position + 8]
        body = data[position + 8 : position + 8 + length]
        if kind == b"IHDR":
            width, height, _, colour = struct.unpack(">IIBB", body[:10])
        elif kind == b"IDAT":
            compressed += body
        position += 12 + length
    channels = 4 if colour == 6 else 3
    raw, stride, rows, before = zlib.decompress(compressed), width * channels, [], bytearray(width * channels)
    for y in range(height):
        filter_type, line = raw[y * (stride + 1)], bytearray(raw[y * (stride + 1) + 1 : (y + 1) * (stride + 1)])
        for i in range(stride):
            a = line[i - channels] if i >= channels else 0
            b, c = before[i], before[i - channels] if i >= channels else 0
            if filter_type == 1:
                line[i] = (line[i] + a) & 255
            elif filter_type == 2:
                line[i] = (line[i] + b) & 255
            elif filter_type == 3:
                line[i] = (line[i] + (a + b) // 2) & 255
            elif filter_type == 4:
                p = a + b - c
                nearest = min((abs(p - a), 0, a), (abs(p - b), 1, b), (abs(p - c), 2, c))[2]
                line[i] = (line[i] + nearest) & 255
        rows.append(line)
        before = line
    pixels = []
    for row in rows:
        for x in range(width):
            p = row[x * channels : (x + 1) * channels]
            alpha = p[3] / 255 if channels == 4 else 1.0
            pixels.extend(v * alpha + 255 * (1 - alpha) for v in p[:3])
    return pixels


def main():
    if sys.argv[1:] == ["describe"]:
        print(json.dumps(describe()))
        return 0
    parser = argparse.ArgumentParser()
    for name in ("--params", "--output", "--work", "--device", "--threads", "--progress"):
        parser.add_argument(name)
    parser.add_argument("--input", action="append", default=[])
    arguments = parser.parse_args()
    params = json.loads(pathlib.Path(arguments.params).read_text())
    inputs = {name: pathlib.Path(folder) for name, folder in (text.split("=", 1) for text in arguments.input)}
    output = pathlib.Path(arguments.output)
    print("scoring with Python", file=sys.stderr)
    scores = {}
    for view in json.loads((inputs["truth"] / "views.json").read_text())["views"]:
        name = view["camera"]["name"]
        preview = inputs["views"] / "previews" / f"{name}.png"
        if not preview.is_file():
            print(f"example-eval: {preview} not found; render the cameras of the ground truth", file=sys.stderr)
            return 3
        found, expected = read_png(preview), read_png(inputs["truth"] / view["image"])
        if len(found) != len(expected):
            print(f"example-eval: {preview} and the ground truth differ in size", file=sys.stderr)
            return 3
        scores[name] = sum((a - b) ** 2 for a, b in zip(found, expected)) / len(found) / params["peak"] ** 2
    output.mkdir()
    mean = sum(scores.values()) / len(scores)
    (output / "metrics.json").write_text(json.dumps({"mean": {"mse": mean}, "views": scores}, indent=1) + "\n")
    (output / "summary.txt").write_text(f"mean squared error {mean:.6f} over {len(scores)} views\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
