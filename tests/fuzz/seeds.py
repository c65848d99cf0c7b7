#!/usr/bin/env python3
"""Writes the seeds of each fuzz target, mostly valid files: seeds.py FOLDER."""

import base64
import io
import json
import pathlib
import struct
import sys
import tarfile
import zlib

out = pathlib.Path(sys.argv[1])


def seed(target: str, name: str, data: bytes) -> None:
    (out / target).mkdir(parents=True, exist_ok=True)
    (out / target / name).write_bytes(data)


cameras = struct.pack("<QIIQQ4d", 1, 1, 1, 4, 3, 5, 5, 2, 1.5)
image = lambda i, name: struct.pack("<I7dI", i, 1, 0, 0, 0, 0.1, 0.2, i, 1) + name + b"\0" + struct.pack("<Q2dQ", 1, 1, 1, 1)
images = struct.pack("<Q", 2) + image(1, b"a.png") + image(2, b"b.png")
points = struct.pack("<QQ3d3BdQII", 1, 1, 0, 0, 5, 9, 9, 9, 0.5, 1, 1, 0)
for which, data in enumerate([cameras, images, points]):
    seed("colmap", f"binary-{which}", bytes([which]) + data)
fisheye = struct.pack("<QIIQQ8d", 1, 1, 5, 4, 3, 2, 2, 2, 1.5, -0.02, 0.006, -0.003, 0.0005)
seed("colmap", "binary-fisheye", b"\0" + fisheye)
rational = struct.pack("<QIIQQ12d", 1, 1, 6, 4, 3, 5, 5, 2, 1.5, 0.1, -0.02, 0.001, 0.002, 0.01, 0.2, -0.05, 0.01)
seed("colmap", "binary-rational", b"\0" + rational)
for model, numbers in {"FISHEYE": "2 2 2 1.5", "RADIAL_FISHEYE": "2 2 1.5 -0.02 0.004", "THIN_PRISM_FISHEYE": "2 2 2 1.5 0.1 0 0.01 0 0 0 0 0"}.items():
    seed("colmap", f"text-{model}", f"\x041 {model} 4 3 {numbers}\n".encode())
seed("colmap", "text-cameras", b"\x041 SIMPLE_RADIAL 4 3 5 2 1.5 0.1\n")
seed("colmap", "text-images", b"\x051 1 0 0 0 0 0 1 1 a.png\n1 1 1\n2 1 0 0 0 0 0 2 1 b.png\n\n")
seed("colmap", "text-points", b"\x061 0 0 5 9 9 9 0.5 1 0\n")


def npy(numbers: list, kind: str = "<f8", order: str = "False", shape: str = "(2, 17)", version: int = 1) -> bytes:
    header = f"{{'descr': '{kind}', 'fortran_order': {order}, 'shape': {shape}, }}".ljust(117) + "\n"
    length = struct.pack("<H" if version == 1 else "<I", len(header))
    data = struct.pack(f"{kind[0]}{len(numbers)}{'d' if kind[2] == '8' else 'f'}", *numbers)
    return b"\x93NUMPY" + bytes([version, 0]) + length + header.encode() + data


# Seeds for every branch of the reader, and shapes whose counts overflow or almost do.
row = [0, 1, 0, 0, 3, -1, 0, 0, 0, 4, 0, 0, 1, 4, 5, 1, 9]
seed("llff", "two", npy(row + row))
for version in (2, 3):
    seed("llff", f"version-{version}", npy(row + row, version=version))
for name, kind in {"single": "<f4", "big-single": ">f4", "big": ">f8", "native": "=f8", "integers": "<i8"}.items():
    seed("llff", name, npy(row + row, kind))
seed("llff", "by-columns", npy([value for pair in zip(row, row) for value in pair], order="True"))
seed("llff", "python-2", npy(row + row, shape="(2L, 17L)"))
seed("llff", "double-quotes", npy(row + row).replace(b"'", b'"'))
seed("llff", "nan", npy(row + [float("nan")] + row[1:]))
for name, shape in {"one": (1, 17), "none": (0, 17), "most": ((2**64 - 1) // 17, 17), "overflow": (2**60, 17), "no-columns": (2**64 - 1, 0)}.items():
    seed("llff", f"shape-{name}", npy(row + row, shape=str(shape)))
seed("llff", "one-dimension", npy(row + row, shape="(34,)"))
seed("llff", "beyond", npy(row + row, version=2).replace(struct.pack("<I", 118), struct.pack("<I", 2**32 - 1), 1))
seed("llff", "cut-short", npy(row + row)[:-1])

pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]"
frame = f'{{"file_path": "images/a.png", "transform_matrix": {pose}, "fl_x": 5, "k1": 0.1, "mask_path": "images/b.png"}}'
seed("transforms", "one", f'{{"camera_angle_x": 0.7, "w": 4, "h": 3, "frames": [{frame}]}}'.encode())

names = [
    "images/a.png\tmasks/a.png\tdepth/a.png\nimages\\b.png\n\nimages/a.png\n\nimages\\b.png",
    "C:\\x\\images\\c\n/home/x/images/A.png\nimages/d.png.png\n\n/y/images/c\n\n\n\nimages/a.png.png",
    "images/a\tmasks/B\nx/b.png\n../images/a.png\n.\\images\\.e.png",
]
for which, text in enumerate(names):
    seed("names", f"transforms-{which}", b"\0" + text.encode())
seed("names", "colmap", b"\1a.png\nx/b.png\nA  b.png\nimages/c.jpg\n/x/images/x/b.png")
seed("names", "llff", b"\2b.png\r\na\r\n")
for name, lens in {
    "brown4": '"fl_x": 5, "k1": 0.1, "k2": -0.02, "k3": 0.003, "k4": -0.0004, "p1": 0.001',
    "rational": '"fl_x": 5, "camera_model": "FULL_OPENCV", "k1": 0.1, "k4": 0.2, "k5": -0.05, "k6": 0.01',
    "opencv-fisheye": '"fl_x": 1.1, "camera_model": "OPENCV_FISHEYE", "k1": -0.02, "k2": 0.006, "k3": -0.003, "k4": 0.0005',
    "is-fisheye": '"fl_x": 2, "is_fisheye": true, "k1": 0.1, "p2": 0.01',
}.items():
    seed("transforms", name, f'{{{lens}, "frames": [{{"file_path": "images/a.png", "transform_matrix": {pose}}}]}}'.encode())
for which in range(4):
    # Radial, tangential and rational terms, focal lengths, principal point; integers are scaled to 1 at the largest i64.
    terms = [-0.02, 0.006, -0.003, 0.0005, 0.1, 0.2, 0, 0, 0, -0.1, -0.1, 0.1, 0.1]
    numbers = struct.pack("<13q", *(int(k * (2**63 - 1)) for k in terms)) if which & 2 == 0 else struct.pack("<13d", *terms)
    seed("lens", str(which), bytes([which]) + numbers)

chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
for bits, size in ((8, 4), (16, 8)):
    pixels = zlib.compress((b"\0" + bytes(range(4 * size))) * 3)
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 3, bits, 6, 0, 0, 0)) + chunk(b"IDAT", pixels)
    seed("picture", f"png-{bits}", b"\0" + png + chunk(b"IEND", b""))
# 4×3, with an EXIF orientation.
jpeg = """
/9j/4AAQSkZJRgABAQAAAQABAAD/4QAiRXhpZgAATU0AKgAAAAgAAQESAAMAAAABAAYAAAAAAAD/2wBDABALDA4MChAODQ4SERATGCgaGBYWGDEjJR0oOjM9
PDkzODdASFxOQERXRTc4UG1RV19iZ2hnPk1xeXBkeFxlZ2P/2wBDARESEhgVGC8aGi9jQjhCY2NjY2NjY2NjY2NjY2NjY2NjY2NjY2NjY2NjY2NjY2NjY2Nj
Y2NjY2NjY2NjY2NjY2P/wAARCAADAAQDASIAAhEBAxEB/8QAHwAAAQUBAQEBAQEAAAAAAAAAAAECAwQFBgcICQoL/8QAtRAAAgEDAwIEAwUFBAQAAAF9AQID
AAQRBRIhMUEGE1FhByJxFDKBkaEII0KxwRVS0fAkM2JyggkKFhcYGRolJicoKSo0NTY3ODk6Q0RFRkdISUpTVFVWV1hZWmNkZWZnaGlqc3R1dnd4eXqDhIWG
h4iJipKTlJWWl5iZmqKjpKWmp6ipqrKztLW2t7i5usLDxMXGx8jJytLT1NXW19jZ2uHi4+Tl5ufo6erx8vP09fb3+Pn6/8QAHwEAAwEBAQEBAQEBAQAAAAAA
AAECAwQFBgcICQoL/8QAtREAAgECBAQDBAcFBAQAAQJ3AAECAxEEBSExBhJBUQdhcRMiMoEIFEKRobHBCSMzUvAVYnLRChYkNOEl8RcYGRomJygpKjU2Nzg5
OkNERUZHSElKU1RVVldYWVpjZGVmZ2hpanN0dXZ3eHl6goOEhYaHiImKkpOUlZaXmJmaoqOkpaanqKmqsrO0tba3uLm6wsPExcbHyMnK0tPU1dbX2Nna4uPk
5ebn6Onq8vP09fb3+Pn6/9oADAMBAAIRAxEAPwCGiiivKPcP/9k=
"""
seed("picture", "jpeg", b"\x01" + base64.b64decode(jpeg))
attribute = lambda name, kind, data: name + b"\0" + kind + b"\0" + struct.pack("<I", len(data)) + data
channels = b"".join(c + b"\0" + struct.pack("<IB3xII", 1, 0, 1, 1) for c in (b"A", b"B", b"G", b"R")) + b"\0"
exr = struct.pack("<II", 20000630, 2) + attribute(b"channels", b"chlist", channels) + attribute(b"compression", b"compression", b"\0")
for name in (b"dataWindow", b"displayWindow"):
    exr += attribute(name, b"box2i", struct.pack("<4i", 0, 0, 3, 2))
exr += attribute(b"lineOrder", b"lineOrder", b"\0") + attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1))
exr += attribute(b"screenWindowCenter", b"v2f", struct.pack("<ff", 0, 0)) + attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1)) + b"\0"
first = len(exr) + 3 * 8
exr += struct.pack("<3Q", *(first + 40 * y for y in range(3)))
exr += b"".join(struct.pack("<iI", y, 32) + struct.pack("<e", 0.5) * 16 for y in range(3))
seed("picture", "exr", b"\x02" + exr)

# Pillow's JPEGs of 20×20 pixels with subsampled chroma, restart markers and progressive scans, and of 20×12 grey pixels. The byte before
# each is the length at which the target cuts the file, in units of 1/256.
jpegs = {
    "baseline": """
/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDABQODxIPDRQSEBIXFRQYHjIhHhwcHj0sLiQySUBMS0dARkVQWnNiUFVtVkVGZIhlbXd7gYKBTmCNl4x9lnN+gXz/2wBD
ARUXFx4aHjshITt8U0ZTfHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHz/wAARCAAUABQDASIAAhEBAxEB/8QAGQABAQAD
AQAAAAAAAAAAAAAAAAQBAwUG/8QAHRAAAgIDAQEBAAAAAAAAAAAAAAECAwQRITFBYf/EABcBAAMBAAAAAAAAAAAAAAAAAAMEBQb/xAAeEQEAAgEEAwAAAAAAAAAA
AAABAAMhAgQREhNhkf/aAAwDAQACEQMRAD8A83XjecKq8Tq4X1Y34W1Ym/gGt7wVO6nLWG9eIHejjxitNdARKjDqPpKRu8TFMI84WxhGMG0vABWhfGvpmWqck2V0
wlHbQAFNIcSpzP/Z
""",
    "restarts": """
/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDABQODxIPDRQSEBIXFRQYHjIhHhwcHj0sLiQySUBMS0dARkVQWnNiUFVtVkVGZIhlbXd7gYKBTmCNl4x9lnN+gXz/2wBD
ARUXFx4aHjshITt8U0ZTfHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHz/wAARCAAUABQDAREAAhEBAxEB/8QAGAABAAMB
AAAAAAAAAAAAAAAABAIDBQb/xAAgEAABBAIBBQAAAAAAAAAAAAABAAIDBBEhEjFRgaGx/8QAGQEBAAIDAAAAAAAAAAAAAAAABAAFAQMG/8QAHREAAwEBAAIDAAAA
AAAAAAAAAAECAxESIRMxgf/dAAQAAv/aAAwDAQACEQMRAD8A5uOrrPFavLpiNBUVQ9lOdGRqf//QzW1DjXxa/jRbTr6L4qp0jRXTlo1P/9GUVME9PSkIPGooVw3R
cB4Wb2xzfjb9/olX0//SXDG3I0qzF9Odmn0a1jQwkDadejzxdT9is220f//T22RNLc4VLC9BlTP/2Q==
""",
    "grey": """
/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDABQODxIPDRQSEBIXFRQYHjIhHhwcHj0sLiQySUBMS0dARkVQWnNiUFVtVkVGZIhlbXd7gYKBTmCNl4x9lnN+gXz/wAAL
CAAMABQBAREA/8QAFgABAQEAAAAAAAAAAAAAAAAABAIG/8QAHxAAAQMDBQAAAAAAAAAAAAAAAwABAgQRITFBUWGB/9oACAEBAAA/AM0Kl5Sx0l8MyRGjxorEOL3f
pNEOLbJURxt6v//Z
""",
    "progressive": """
/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDABQODxIPDRQSEBIXFRQYHjIhHhwcHj0sLiQySUBMS0dARkVQWnNiUFVtVkVGZIhlbXd7gYKBTmCNl4x9lnN+gXz/2wBD
ARUXFx4aHjshITt8U0ZTfHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHz/wgARCAAUABQDASIAAhEBAxEB/8QAGAABAAMB
AAAAAAAAAAAAAAAAAAEDBAX/xAAXAQADAQAAAAAAAAAAAAAAAAACAwQF/9oADAMBAAIQAxAAAAHm2abgDK3CqXisqQin/8QAGBABAQEBAQAAAAAAAAAAAAAAAAEC
EkH/2gAIAQEAAQUCmUy4TKZcpHj/xAAYEQACAwAAAAAAAAAAAAAAAAAAAgMQE//aAAgBAwEBPwFJTUSv/8QAGxEAAgEFAAAAAAAAAAAAAAAAAAIBEBEhMlH/2gAI
AQIBAT8BjJZeia0//8QAFBABAAAAAAAAAAAAAAAAAAAAMP/aAAgBAQAGPwIf/8QAGBABAQEBAQAAAAAAAAAAAAAAAQAQESH/2gAIAQEAAT8hwTT+IoOQDl//2gAM
AwEAAgADAAAAEEcoP//EABcRAAMBAAAAAAAAAAAAAAAAAAABETH/2gAIAQMBAT8QgJoaRWf/xAAYEQEBAQEBAAAAAAAAAAAAAAABABFRkf/aAAgBAgEBPxB1BxHp
NEnIDL//xAAdEAACAgEFAAAAAAAAAAAAAAAAAREhMUFRYXGh/9oACAEBAAE/EGzg4CRbDpx2SiSkeFChEiRph//Z
""",
}
for name, data in jpegs.items():
    for cut in (64, 200):
        seed("jpeg", f"{name}-{cut}", bytes([cut]) + base64.b64decode(data))
# Masks of a 4×3 photograph.
for kind in ("png-8", "png-16", "jpeg", "exr"):
    seed("mask", kind, (out / "picture" / kind).read_bytes())

names = '{"grid":{"dtype":"F32","shape":[4],"data_offsets":[0,16]}}'
seed("field", "one", struct.pack("<Q", len(names)) + names.encode() + bytes(16))

pipeline = """default: [report]
stages:
  make: {}
  train:
    inputs: {data: make/part}
    parameters: &own {rays: 2, place: [1, 2.5]}
  again:
    extends: train
    inputs: {data: ./folder}
    parameters:
      <<: *own
      rate: 2e0
  report:
    inputs: {run: train, more: again}
"""
stage = lambda name, **more: {"name": name, "version": "", "code": "", "summary": "", "inputs": {}, "parameters": {}} | more
number, seed_type = {"type": ["number", "null"], "default": None}, {"type": "integer", "format": "uint64", "default": 0}
kernel = {"oneOf": [{"const": "box", "type": "string"}, {"const": "average", "type": "string"}]}
words = {"anyOf": [{"$ref": "#/$defs/Kernel"}, {"type": "null"}], "default": None}
make = stage("make", output={"kind": "data", "subtrees": {"part": "data/part"}}, parameters={"properties": {"seed": seed_type}})
train = stage(
    "train",
    output={"kind": "field"},
    inputs={"data": {"kinds": ["data/part"], "summary": ""}, "weights": {"kinds": ["w"], "optional": True, "summary": ""}},
    parameters={
        "properties": {
            "rays": {"type": "integer", "minimum": 1, "default": 3},
            "rate": number,
            "kernel": words,
            "place": {"type": "array", "items": {"type": "number"}, "default": [0.5]},
        },
        "$defs": {"Kernel": kernel},
    },
    rules=[
        {"when": {"kernel": {"const": "average"}}, "needs": ["weights"], "message": "weights are needed"},
        {"when": {"data.seed": {"minimum": 5}}, "must": {"rate": {"multipleOf": 1}}, "message": "the rate must be whole"},
    ],
)
report = stage("report", output={"kind": "page"}, sink=True, inputs={"run": {"kinds": ["run"], "summary": ""}})
record = {"stage": "train", "point": "rays=2", "key_parts": {"code": "0" * 64, "parameter rate": 2.5}, "output": "0" * 64}
record |= {"started_unix": 1, "seconds": 0.5, "threads": 2, "host": "h"}
seed("runner", "pipeline", b"\x00" + pipeline.encode())
for one in (make, train, report):
    seed("runner", f"describe-{one['name']}", b"\x01" + json.dumps(one).encode())
seed("runner", "arguments", b"\x02pseed=1,2\npkernel=box\nptrain.rate=2,2.0,3\npplace=[1,2]\nidata=a,b\nprays=6e4\nttrain\nitrain.weights=w")
seed("runner", "arguments-wrong", b'\x02pplace=[1,"a,b"],2\nidata=a,,b\nprays=0x10')
seed("runner", "record", b"\x03" + json.dumps(record).encode())

entry = {"path": "views/r_0.png", "size": 3, "blake3": "0" * 64}
files = [entry | {"path": "metrics.json"}, entry, entry | {"path": "views/" + "n" * 120}]
index = {"export": 1, "store": 1, "artifact": "0" * 64, "objects": ["0" * 64], "actions": ["0" * 64, "1" * 64]}
seed("remote", "edits", bytes([1, 124, 0, 1, 0, 2, 255]))
seed("remote", "index", b"\x02" + json.dumps(index).encode())
seed("remote", "manifest", b"\x03" + json.dumps({"kind": "views", "schema": 1, "files": files}).encode())
seed("remote", "record", b"\x04" + json.dumps(record | {"made_of": ["2" * 64]}).encode())
for which, path in enumerate(["../evil", "/tmp/evil", "a/../../evil", "a", "artifact.json", "a/" * 400 + "x"]):
    hostile = {"kind": "views", "schema": 1, "files": [entry | {"path": path}, entry | {"path": path + "/x"}]}
    seed("remote", f"path-{which}", b"\x03" + json.dumps(hostile).encode())
archive = io.BytesIO()
with tarfile.open(fileobj=archive, mode="w", format=tarfile.GNU_FORMAT) as tar:
    for name in ("export.json", f"objects/{'0' * 64}/artifact.json"):
        data = json.dumps(index).encode()
        member = tarfile.TarInfo(name)
        member.size = len(data)
        tar.addfile(member, io.BytesIO(data))
seed("remote", "archive", b"\x00" + archive.getvalue()[:4000])
