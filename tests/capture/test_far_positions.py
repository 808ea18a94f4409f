"""Positions of maps, far from the origin, are refused wherever they come in.

At 5,412 km a number of single precision is one of every half metre.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.files import folders as foreign_folders
from support.files.objects import cloud, columns, plate, write_ply
from support.worlds.fields import blob

from mi_nerfattack.capture.camera_path import read_path
from mi_nerfattack.capture.mesh.read import load_mesh
from mi_nerfattack.capture.pose_files import read_poses
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.io import load_field, save_field
from mi_nerfattack.fields.splats import read_splats
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import FAR_M, require_near
from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.vehicle.route.route import load_routes

pytestmark = pytest.mark.usefixtures("variant")

AWAY = np.array([442_118.0, 5_412_078.0, 313.0])


def moved_transforms(folder, away):
    source = foreign_folders.nerfstudio(folder) / "transforms.json"
    table = json.loads(source.read_text())
    for frame in table["frames"]:
        for row, shift in zip(frame["transform_matrix"], away, strict=False):
            row[3] += shift
    source.write_text(json.dumps(table))
    return source


def transforms(folder, away):
    return read_images(moved_transforms(folder, away)).camera_to_world


def camera_path(folder, away):
    return read_path(moved_transforms(folder, away))


def colmap(folder, away):
    import pycolmap

    root = foreign_folders.colmap(folder)
    (root / "sparse/0/points3D.bin").write_bytes(bytes(8))
    model = pycolmap.Reconstruction(root / "sparse/0")
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), away))
    model.write(root / "sparse/0")
    return read_images(root).camera_to_world


def pose_file(folder, away):
    path = folder / "poses.csv"
    rows = [f"{0.1 * i},{away[0] + i},{away[1]},0.1" for i in range(4)]
    path.write_text("\n".join(["time_s,x_m,y_m,heading_rad", *rows]) + "\n")
    return read_poses(path, CameraMount()).camera_to_world


def route(folder, away):
    points = (away[:2] + [[0, 0], [20, 0], [20, 30]]).tolist()
    entry = {"goal": 0, "points_m": points, "lane_width_m": 3.5, "speed_ms": 5.0}
    (folder / "routes.json").write_text(json.dumps({"a": entry}))
    return load_routes(folder / "routes.json")


def splat_file(folder, away):
    values = columns(cloud(np.random.default_rng(0), 30))
    for name, shift in zip("xyz", away, strict=True):
        values[name] = values[name] + shift
    return read_splats(write_ply(folder / "a.ply", values))


def mesh(folder, away):
    gltf = plate()
    gltf.material()
    gltf.tree["nodes"][0]["translation"] = [away[0], away[2], -away[1]]  # y up
    return load_mesh(gltf.write(folder / "a.glb"))


def field(folder, away):
    grid = blob(np.random.default_rng(0))
    grid.lower, grid.upper = grid.lower + away, grid.upper + away
    save_field(folder / "a.safetensors", grid)
    return load_field(folder / "a.safetensors")


def scene(folder, away):
    (folder / "a.xml").write_text(
        '<scene version="3.0.0"><shape type="cube"><transform name="to_world">'
        f'<translate x="{away[0]}" y="{away[1]}"/></transform></shape></scene>'
    )
    return load_scene(folder / "a.xml")


READERS = [transforms, camera_path, colmap, pose_file]
READERS += [route, splat_file, mesh, field, scene]


@pytest.mark.parametrize("read", READERS, ids=lambda read: read.__name__)
def test_positions_of_a_map_are_refused_with_the_shift_to_subtract(read, tmp_path):
    near, far = (files.make_folder(tmp_path / name) for name in ("near", "far"))
    read(near, 0 * AWAY)
    with pytest.raises(InputError, match=r"far/.*subtract \(4\d{5}, 54\d{5}"):
        read(far, AWAY)


def test_what_is_large_or_has_outliers_is_no_map():
    rng = np.random.default_rng(0)
    require_near("a", rng.uniform(-1e6, 1e6, (100, 3)))  # millimetres of a place
    require_near("a", np.r_[rng.normal(size=(99, 3)), [[1e9, 0, 0]]])
    require_near("a", np.full((1, 2), FAR_M))
    for places in (np.full((1, 2), 1.01 * FAR_M), np.full((2, 2), 1e308)):
        with pytest.raises(InputError, match="subtract"):
            require_near("a", places)
