"""The formats that are fuzzed: a good file of each, and what reads it.

Nothing heavy is imported before a reader is made: each is made in a process of its own.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from fuzz import exchanges, programs
from fuzz.mutations import (
    Mutation,
    of_bytes,
    of_glb,
    of_json,
    of_png,
    of_tensors,
    of_text,
    one_of,
)

Read = Callable[[Path], Any]


class Format(NamedTuple):
    """What writes good files into a folder and returns each with its reader; damage."""

    prepare: Callable[[Path], list[tuple[Path, Read]]]
    mutate: Mutation


def _scenario(folder: Path) -> list[tuple[Path, Read]]:
    from support.files.runs import HEAD, write_named_files

    from mi_nerfattack.scenario.scenario import load_scenario

    write_named_files(folder)
    path = folder / "scenario.toml"
    path.write_text(HEAD + (Path(__file__).parent / "scenario.toml").read_text())
    return [(path, lambda path: load_scenario(path)[0].identity())]


def _grid(folder: Path) -> list[tuple[Path, Read]]:
    from support.files.runs import HEAD, write_named_files

    from mi_nerfattack.experiment.sweep.grid import load_cells

    write_named_files(folder)
    route = {"goal": 0, "points_m": [[0, 0], [9, 0]], "lane_width_m": 3.5}
    (folder / "routes.json").write_text(json.dumps({"lane": route | {"speed_ms": 5.0}}))
    (folder / "scenario.toml").write_text(HEAD)
    path = folder / "grid.toml"
    path.write_text(
        'scenario = "scenario.toml"\nseeds = [0, 1]\nbudgets = [400]\n'
        'backward_multiple = 1.5\n[[routes]]\nname = "lane"\n'
        'set.drive.length_m = 5\n[[objects]]\nname = "hydrant"\nroutes = ["lane"]\n'
        '[[objects.set.objects]]\nid = "a"\nfield = "object.safetensors"\n'
        'position_m = [1, 2, 0]\n[[methods]]\nname = "blocks"\n'
        'set.attack.method.kind = "blocks"\n[[methods]]\nname = "gradient"\n'
    )
    return [(path, load_cells)]


def _motor(folder: Path) -> list[tuple[Path, Read]]:
    from mi_nerfattack.car.vesc import calibration

    path = folder / "car.toml"
    calibration.write_calibration(path, calibration.Calibration())
    return [(path, calibration.read_calibration)]


def _policy_toml(folder: Path) -> list[tuple[Path, Read]]:
    from mi_nerfattack.commands.shared.policy_file import PolicyFile

    path = folder / "policy.toml"
    path.write_text(
        '[policy]\nurl = "http://127.0.0.1:1"\ntimeout_s = 2.0\noutput = 1\n'
        "control_scale = 1e-2\n[policy.preprocess]\nresize_px = [200, 66]\n"
        "[camera]\nwidth = 80\nheight = 40\nfov_x_deg = 70.5\npitch_deg = 0\n"
    )

    def read(path: Path) -> None:
        PolicyFile.read(str(path)).section.build()

    return [(path, read)]


def _field(folder: Path) -> list[tuple[Path, Read]]:
    from support.worlds.fields import blob, small_bricks, small_ngp

    from mi_nerfattack.fields.io import load_field, save_field

    rng = np.random.default_rng(0)
    paths = [folder / f"{kind}.safetensors" for kind in ("grid", "ngp", "bricks")]
    for path, field in zip(
        paths, (blob(rng), small_ngp(), small_bricks(rng)), strict=True
    ):
        save_field(path, field)
    return [(path, lambda path: load_field(path).metadata()) for path in paths]


def _gltf(folder: Path) -> list[tuple[Path, Read]]:
    from support.files.objects import four_colours, plate

    gltf = plate()
    texture = {"index": gltf.texture(four_colours(), wrapS=33071, wrapT=33071)}
    gltf.material(baseColorTexture=texture, baseColorFactor=[1, 0.5, 1, 0.5])
    gltf.tree["nodes"] = [{"children": [1], "scale": [1, 2, 1]}, {"mesh": 0}]
    gltf.write(folder / "plate.glb")
    return [(folder / "plate.glb", _read_mesh)]


def _gltf_text(folder: Path) -> list[tuple[Path, Read]]:
    from support.files.objects import plate

    gltf = plate(COLOR_0=np.full((4, 3), 0.5))
    gltf.material(baseColorFactor=[1, 0.5, 1, 1])
    gltf.write(folder / "plate.gltf")
    return [(folder / "plate.gltf", _read_mesh)]


def _obj(folder: Path) -> list[tuple[Path, Read]]:
    from support.files.objects import four_colours

    four_colours().save(folder / "four.png")
    (folder / "plate.mtl").write_text("newmtl a\nKd 0.5 0.25 1\nmap_Kd four.png\n")
    (folder / "plate.obj").write_text(
        "mtllib plate.mtl\nv 0 0 0\nv 2 0 0\nv 2 1 0.5\nv 0 1 0\nvt 0 0\nvt 1 0\n"
        "vt 1 1\nvt 0 1\nvn 0 0 1\nusemtl a\nf 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n"
    )
    mesh = folder / "plate.obj"
    return [(mesh, _read_mesh), (folder / "plate.mtl", lambda _: _read_mesh(mesh))]


def _ply(folder: Path) -> list[tuple[Path, Read]]:
    import trimesh

    cube = trimesh.creation.box()
    cube.visual.vertex_colors = np.full((8, 4), 128, np.uint8)
    for kind in ("ascii", "binary"):
        (folder / f"{kind}.ply").write_bytes(cube.export(None, "ply", encoding=kind))
    return [(folder / f"{kind}.ply", _read_mesh) for kind in ("ascii", "binary")]


def _read_mesh(path: Path) -> None:
    from mi_nerfattack.capture.mesh.read import load_mesh

    load_mesh(path)


def _splats(folder: Path) -> list[tuple[Path, Read]]:
    from support.files.objects import cloud, columns, write_ply

    from mi_nerfattack.fields.splats import read_splats

    values = columns(cloud(np.random.default_rng(0), 3))
    return [
        (write_ply(folder / f"{text}.ply", values, text), read_splats)
        for text in (False, True)
    ]


def _compact_splats(folder: Path, name: str) -> list[tuple[Path, Read]]:
    import gzip

    import mitsuba as mi
    from support.files import compact, objects

    from mi_nerfattack.fields.compact_splats import load_splats

    mi.set_variant("llvm_ad_rgb")
    item, path = objects.cloud(np.random.default_rng(0), 3), folder / f"a.{name}"
    path.write_bytes(getattr(compact, name)(item))

    def read(path: Path) -> None:
        if name == "spz":  # what is damaged is packed, or few inputs pass a checksum
            packed = path.with_name("packed.spz")
            packed.write_bytes(gzip.compress(path.read_bytes(), 1))
            path = packed
        load_splats(path)

    return [(path, read)]


def _png(folder: Path) -> list[tuple[Path, Read]]:
    from PIL import Image

    from mi_nerfattack.io import files

    picture = np.random.default_rng(0).integers(0, 255, (6, 5, 4), dtype=np.uint8)
    Image.fromarray(picture).save(folder / "rgba.png")
    palette = Image.fromarray(picture[..., :3]).quantize(7)
    palette.save(folder / "palette.png", transparency=b"\0\x80\xff")
    Image.fromarray(picture[..., 0]).save(folder / "grey.png", transparency=3)
    Image.fromarray(picture[..., 0].astype(np.uint16) * 99).save(folder / "deep.png")
    names = ("rgba.png", "palette.png", "grey.png")
    targets: list[tuple[Path, Read]] = [(folder / n, files.read_image) for n in names]
    return [*targets, (folder / "deep.png", files.read_image16)]


def _jpeg(folder: Path) -> list[tuple[Path, Read]]:
    from PIL import Image

    from mi_nerfattack.io import files

    picture = np.random.default_rng(0).integers(0, 255, (16, 24, 3), dtype=np.uint8)
    Image.fromarray(picture).save(folder / "a.jpg")
    Image.fromarray(picture).save(folder / "b.jpg", progressive=True)
    Image.fromarray(picture).save(folder / "c.webp")
    return [(folder / n, files.read_image) for n in ("a.jpg", "b.jpg", "c.webp")]


def _exr(folder: Path) -> list[tuple[Path, Read]]:
    from mi_nerfattack.io import exr

    rng = np.random.default_rng(0)
    layers = {"": rng.random((6, 5, 4)), "Z": rng.random((6, 5))}
    exr.write_layers(folder / "a.exr", layers, {"step": "12"})

    def read(path: Path) -> None:
        exr.read_metadata(path)
        exr.read_layers(path)

    return [(folder / "a.exr", read)]


def _transforms(folder: Path) -> list[tuple[Path, Read]]:
    from support.files import folders as foreign_folders

    from mi_nerfattack.capture.camera_path import read_path
    from mi_nerfattack.capture.inputs import read_depth
    from mi_nerfattack.capture.transforms import read_images

    def read(path: Path) -> None:
        images = read_images(path.parent, skip_missing=True)
        read_depth(path.parent, images)

    targets: list[tuple[Path, Read]] = []
    for make in (foreign_folders.nerfstudio, foreign_folders.instant_ngp):
        sub = folder / make.__name__
        sub.mkdir()
        targets.append((make(sub) / "transforms.json", read))
    return [*targets, (targets[0][0], read_path)]


def _colmap(folder: Path, suffix: str = ".bin") -> list[tuple[Path, Read]]:
    import pycolmap
    from support.files import folders as foreign_folders

    from mi_nerfattack.capture.colmap import model as reader

    reader.run_task = _forked  # the process of its own, without its start
    model = foreign_folders.colmap(folder) / "sparse/0"
    (model / "points3D.bin").write_bytes(bytes(8))
    if suffix == ".txt":
        pycolmap.Reconstruction(model).write_text(model)
        for path in model.glob("*.bin"):
            path.unlink()
    names = ("cameras", "images", "points3D")
    return [
        (model / (name + suffix), lambda _: reader.read_colmap(folder))
        for name in names
    ]


def _forked(task: dict[str, Any], stages: Any) -> int:
    """Do what `colmap.follow.run_task` does, in a fork of this process."""
    from mi_nerfattack.capture.colmap.process import run

    out, into = os.pipe()
    child = os.fork()
    if child == 0:
        os.dup2(into, 1)
        os.dup2(into, 2)
        os.close(into)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        code = 1
        try:
            code = run(task)
        except SystemExit as error:
            print(error.code, flush=True)
        finally:
            os._exit(code)
    os.close(into)
    with os.fdopen(out, encoding="utf-8", errors="replace") as lines:
        stages.follow(lines)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _profile(folder: Path) -> list[tuple[Path, Read]]:
    from PIL import ImageCms

    from mi_nerfattack.attack.texture.gamut import Gamut

    path = folder / "monitor.icc"
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    path.write_bytes(profile.tobytes())
    return [(path, Gamut.load)]


def _patches(folder: Path) -> list[tuple[Path, Read]]:
    from mi_nerfattack.attack.texture.gamut import Gamut

    path = folder / "patches.csv"
    np.savetxt(path, np.random.default_rng(0).uniform(0, 1, (9, 3)), delimiter=",")
    return [(path, Gamut.load)]


def _routes(folder: Path) -> list[tuple[Path, Read]]:
    from mi_nerfattack.vehicle.route.route import load_routes

    corner = {"goal": 0, "points_m": [[0, 0], [5, 0], [5, 5]], "closed": True}
    table = {"a": {**corner, "lane_width_m": 3.5, "speed_ms": 5.0}}
    table["b"] = {**table["a"], "closed": False}
    (folder / "routes.json").write_text(json.dumps(table))

    def read(path: Path) -> None:
        for route in load_routes(path):
            route.project_numpy(np.zeros((1, 3)))
            route.curvature_at(1.0, 0.5)

    return [(folder / "routes.json", read)]


def _zed(folder: Path) -> list[tuple[Path, Read]]:
    from support.files.recordings import calibration_text

    from mi_nerfattack.car.camera.zed import LeftEye, read_left_eye

    path = folder / "SN1.conf"
    path.write_text(calibration_text())

    def read(path: Path) -> None:
        eye = read_left_eye(path)
        LeftEye(eye, eye.camera())

    return [(path, read)]


_TEXT, _JSON = one_of(of_text, of_text, of_bytes), one_of(of_json, of_json, of_text)
_JSON_OR_BYTES = one_of(of_json, of_json, of_text, of_bytes)
_TENSORS = one_of(of_tensors, of_tensors, of_bytes)
_PNG = one_of(of_png, of_bytes)
FORMATS: dict[str, Format] = {
    "scenario": Format(_scenario, _TEXT),
    "grid": Format(_grid, _TEXT),
    "policy_toml": Format(_policy_toml, _TEXT),
    "motor": Format(_motor, _TEXT),
    "field": Format(_field, _TENSORS),
    "glb": Format(_gltf, one_of(of_glb, of_glb, of_bytes)),
    "gltf": Format(_gltf_text, _JSON_OR_BYTES),
    "obj": Format(_obj, _TEXT),
    "ply": Format(_ply, _TEXT),
    "splats": Format(_splats, _TEXT),
    "spz": Format(partial(_compact_splats, name="spz"), of_bytes),
    "splat": Format(partial(_compact_splats, name="splat"), of_bytes),
    "png": Format(_png, _PNG),
    "jpeg": Format(_jpeg, of_bytes),
    "exr": Format(_exr, of_bytes),
    "transforms": Format(_transforms, _JSON_OR_BYTES),
    "colmap": Format(_colmap, of_bytes),
    "colmap_text": Format(partial(_colmap, suffix=".txt"), _TEXT),
    "profile": Format(_profile, of_bytes),
    "patches": Format(_patches, _TEXT),
    "routes": Format(_routes, _JSON_OR_BYTES),
    "onnx": Format(programs.onnx_files, one_of(programs.of_onnx, of_bytes)),
    "policy": Format(programs.policies, programs.of_policy),
    "program": Format(programs.programs, one_of(programs.of_zip, of_bytes)),
    "checkpoint": Format(programs.checkpoints, programs.of_checkpoints),
    "record": Format(programs.records, _JSON_OR_BYTES),
    "poses": Format(programs.poses, _TEXT),
    "mcap": Format(programs.logs, one_of(of_text, of_bytes)),
    "video": Format(programs.videos, of_bytes),
    "xml": Format(programs.scenes, _TEXT),
    "zed": Format(_zed, _TEXT),
    "request": Format(exchanges.requests, one_of(of_text, of_bytes)),
    "answer": Format(exchanges.answers, one_of(of_text, of_bytes)),
}
