#!/usr/bin/env python3
"""Projects points with pycolmap: reads cameras and points as JSON from stdin, writes image positions as JSON to stdout.

tests/lenses.rs compares the lens models with pycolmap's. Needs `pip install pycolmap`.
"""

import json
import sys

import numpy
import pycolmap


def projected(entry: dict) -> list:
    """Projects the points of one camera and returns the image positions."""
    size = {"width": entry["width"], "height": entry["height"]}
    camera = pycolmap.Camera(model=entry["model"], params=entry["parameters"], **size)
    return camera.img_from_cam(numpy.array(entry["points"])).tolist()


json.dump([projected(entry) for entry in json.load(sys.stdin)], sys.stdout)
