#!/usr/bin/env python3
"""Projects points by COLMAP's own library: reads cameras with points from stdin, writes image positions to stdout, as JSON.

A test's other side: lens models must agree with pycolmap's. Needs `pip install pycolmap`.
"""

import json
import sys

import numpy
import pycolmap


def projected(entry: dict) -> list:
    size = {"width": entry["width"], "height": entry["height"]}
    camera = pycolmap.Camera(model=entry["model"], params=entry["parameters"], **size)
    return camera.img_from_cam(numpy.array(entry["points"])).tolist()


json.dump([projected(entry) for entry in json.load(sys.stdin)], sys.stdout)
