"""Folders as other programs leave them, and shards of frames."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from mi_nerfattack.io import files
from mi_nerfattack.render.camera.conventions import opencv_to_opengl
from mi_nerfattack.render.camera.intrinsics import look_at
from mi_nerfattack.training.dataset import shard_columns

WIDTH, HEIGHT = 12, 8


def poses(count: int) -> list[list[list[float]]]:
    """OpenGL matrices of cameras that look at the origin."""
    eyes = [[3 * np.cos(i), 3 * np.sin(i), 1.0] for i in range(count)]
    matrices = np.stack([look_at(eye, np.zeros(3)) for eye in eyes])
    return opencv_to_opengl(matrices).tolist()


def picture(i: int, channels: int = 3, width: int = WIDTH) -> np.ndarray:
    rng = np.random.default_rng(i)
    return rng.integers(0, 255, (HEIGHT, width, channels), dtype=np.uint8)


def write(folder: Path, table: dict, name: str = "transforms.json") -> Path:
    (folder / name).write_text(json.dumps(table))
    return folder


def nerfstudio(folder: Path) -> Path:
    """As ns-process-data writes it: intrinsics, depth and more in every frame."""
    for sub in ("images", "depths"):
        (folder / sub).mkdir()
    frames = []
    for i, matrix in enumerate(poses(3)):
        name = f"frame_{i:05d}"
        files.write_image(folder / f"images/{name}.png", picture(i))
        millimetres = np.full((HEIGHT // 2, WIDTH // 2), 1500, np.uint16)
        Image.fromarray(millimetres).save(folder / f"depths/{name}.png")
        lens = {"fl_x": 10.0 + i, "fl_y": 11.0 + i, "cx": 6.25, "cy": 3.75}
        lens |= {"k1": 0.01 * i, "k2": 0.0, "p1": 0.0, "p2": 0.0}
        frame = {"w": WIDTH, "h": HEIGHT, "file_path": f"images/{name}.png"}
        frame |= {"depth_file_path": f"depths/{name}.png", "colmap_im_id": i + 1}
        frames.append(lens | frame | {"transform_matrix": matrix})
    (folder / "sparse_pc.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
        "property float z\nproperty uint8 red\nend_header\n0 0 0 1\n0.1 0.2 0.3 1\n"
    )
    turn = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
    table = {"camera_model": "OPENCV", "applied_transform": turn}
    return write(folder, table | {"ply_file_path": "sparse_pc.ply", "frames": frames})


def instant_ngp(folder: Path) -> Path:
    """As Instant-NGP's colmap2nerf writes it."""
    (folder / "images").mkdir()
    frames = []
    for i, matrix in enumerate(poses(3)):
        files.write_image(folder / f"images/{i}.jpg", picture(i))
        frame = {"file_path": f"./images/{i}.jpg", "sharpness": 30.0}
        frames.append(frame | {"transform_matrix": matrix})
    table = {"camera_angle_x": 1.0, "camera_angle_y": 0.7, "fl_x": 10.0, "fl_y": 11.0}
    table |= {"k1": 0.01, "k2": 0.002, "k3": 0, "k4": 0, "p1": 0.001, "p2": 0.002}
    table |= {"is_fisheye": False, "cx": 6.5, "cy": 3.75, "aabb_scale": 4}
    table |= {"w": float(WIDTH), "h": float(HEIGHT), "frames": frames}
    return write(folder, table)


def blender(folder: Path) -> Path:
    """As Blender's synthetic scenes: three JSON files, RGBA, no suffix, no size."""
    for split, count in (("train", 3), ("val", 1), ("test", 2)):
        (folder / split).mkdir()
        frames = []
        for i, matrix in enumerate(poses(count)):
            files.write_image(folder / f"{split}/r_{i}.png", picture(i, 4))
            frame = {"file_path": f"./{split}/r_{i}", "rotation": 0.01}
            frames.append(frame | {"transform_matrix": matrix})
        table = {"camera_angle_x": 0.6911112070083618, "frames": frames}
        write(folder, table, f"transforms_{split}.json")
    return folder


def colmap(folder: Path) -> Path:
    """A binary model in sparse/0 beside its images."""
    (folder / "images").mkdir()
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    camera = struct.pack("<QiiQQ3d", 1, 1, 0, WIDTH, HEIGHT, 10.0, 6.0, 4.0)
    (model / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", 3)
    for i in range(3):
        images += struct.pack("<I7dI", i, 1.0, 0.1 * i, 0.2, 0.0, 0.0, 0.0, 2.0, 1)
        images += f"{i}.png".encode() + b"\0" + struct.pack("<Q", 0)
        files.write_image(folder / f"images/{i}.png", picture(i))
    (model / "images.bin").write_bytes(images)
    return folder


def write_shard(path: Path, frames, goals, controls) -> Path:
    path = path.with_suffix(".safetensors")
    files.write_safetensors(path, shard_columns(frames, goals, controls))
    return path
