#!/usr/bin/env python3
"""Reads an artifact of `export` with trimesh, plyfile and, if installed, pycolmap, and compares it with a true surface.

    check-export.py EXPORT TRUTH.ply SEEN.ply

TRUTH.ply has points of the true surface, SEEN.ply the points that are visible from the cameras; both have normals. Prints JSON:

* `mesh`, `points`, `splats`: `count` of points (of the mesh, samples), mean distance from these points to TRUTH.ply (`to_truth`) and from
  SEEN.ply to these points (`from_truth`), both divided by the scene's longest side, and the share of normals that point to the same side
  as the nearest true normal (`outward`). The mesh also has its number of triangles, `outward` of its vertices and facts on its colours;
  points and splats have the properties of their files.
* `frames`: number of cameras in transforms.json.
* `colmap`, only with pycolmap: numbers of points and cameras, and the cameras' poses.
"""

import json
import sys
from pathlib import Path

import numpy as np
import plyfile
import trimesh
from scipy.spatial import cKDTree


def columns(element, names):
    return np.stack([np.asarray(element[name], dtype=np.float64) for name in names], axis=1)


def read_points(path):
    vertex = plyfile.PlyData.read(path)["vertex"]
    return columns(vertex, ["x", "y", "z"]), columns(vertex, ["nx", "ny", "nz"]), vertex


def outward(points, normals, tree, truth_normals):
    """Returns the share of normals that point to the same side as the nearest true normal."""
    _, nearest = tree.query(points)
    return float(np.mean(np.sum(normals * truth_normals[nearest], axis=1) > 0))


def main():
    export = Path(sys.argv[1])
    truth, truth_normals, _ = read_points(sys.argv[2])
    seen, _, _ = read_points(sys.argv[3])
    size = float((truth.max(axis=0) - truth.min(axis=0)).max())
    tree = cKDTree(truth)

    def figures(points, normals, to_surface):
        return {
            "count": len(points),
            "to_truth": float(np.mean(tree.query(points)[0])) / size,
            "from_truth": float(np.mean(to_surface)) / size,
            "outward": outward(points, normals, tree, truth_normals),
        }

    found = {}
    (mesh,) = trimesh.load(export / "mesh.glb", process=False).geometry.values()
    # The number of samples is chosen by hand.
    samples, faces = trimesh.sample.sample_surface(mesh, 200_000, seed=1)
    found["mesh"] = figures(samples, mesh.face_normals[faces], cKDTree(samples).query(seen)[0])
    found["mesh"]["triangles"] = len(mesh.faces)
    found["mesh"]["vertices_outward"] = outward(mesh.vertices, mesh.vertex_normals, tree, truth_normals)
    found["mesh"]["has_colours"] = len(mesh.visual.vertex_attributes["color"]) == len(mesh.vertices)
    coloured = trimesh.load(export / "mesh.ply", process=False)
    found["mesh"]["kind"] = coloured.visual.kind
    found["mesh"]["is_white"] = bool((coloured.visual.vertex_colors[:, :3] > 250).all())
    points, normals, vertex = read_points(export / "points.ply")
    found["points"] = figures(points, normals, cKDTree(points).query(seen)[0])
    found["points"]["properties"] = [p.name for p in vertex.properties]
    splats, normals, vertex = read_points(export / "splats.ply")
    found["splats"] = figures(splats, normals, cKDTree(splats).query(seen)[0])
    found["splats"]["properties"] = [p.name for p in vertex.properties]
    cameras = json.loads((export / "transforms.json").read_text())
    found["frames"] = len(cameras["frames"])
    try:
        import pycolmap
    except ImportError:
        pass
    else:
        model = pycolmap.Reconstruction(str(export / "colmap/sparse/0"))
        poses = {}
        for image in model.images.values():
            pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
            poses[image.name] = pose.inverse().matrix().tolist()
        found["colmap"] = {"points": len(model.points3D), "cameras": len(model.cameras), "camera_to_world": poses}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
