#!/usr/bin/env python3
"""Writes the cameras of FOLDER/transforms.json as a COLMAP model with pycolmap.

    write-colmap.py FOLDER MODEL

All cameras must have one focal length, a centred principal point and no distortion. tests/photographs.rs checks that `prep` reads
pycolmap's models. Needs `pip install pycolmap`.
"""

import json
import pathlib
import sys

import numpy
import pycolmap

folder, model = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
transforms = json.loads((folder / "transforms.json").read_text())
width, height, focal = transforms["w"], transforms["h"], transforms["fl_x"]
reconstruction = pycolmap.Reconstruction()
parameters = [focal, focal, width / 2, height / 2]
camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=width, height=height, params=parameters)
reconstruction.add_camera_with_trivial_rig(camera)
for number, frame in enumerate(transforms["frames"], 1):
    # COLMAP's poses are world to camera, with axes right, down, forward.
    pose = numpy.array(frame["transform_matrix"]) @ numpy.diag([1, -1, -1, 1])
    world_to_camera = pycolmap.Rigid3d(numpy.linalg.inv(pose)[:3])
    image = pycolmap.Image(name=pathlib.Path(frame["file_path"]).name, camera_id=1, image_id=number)
    reconstruction.add_image_with_trivial_frame(image, world_to_camera)
model.mkdir(parents=True, exist_ok=True)
reconstruction.write_binary(model)
print(f"pycolmap {pycolmap.__version__}: {reconstruction.num_reg_images()} images in {model}")
