"""Recorded drives in every form that can be replayed, and files of a ZED."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.worlds.views import write_transforms

from mi_nerfattack.capture.transforms import write_poses
from mi_nerfattack.deploy.replay.ros2 import definition, full_name
from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix

CAMERA, MOUNT, COUNT = from_fov(16, 8, 90.0), CameraMount(), 6
STATES = np.stack([0.5 * np.arange(COUNT), 0.1 * np.arange(COUNT), np.full(COUNT, 0.2)])
STATES = STATES.T  # x, y, heading
POSES = mount_matrix(STATES, MOUNT)
CSV = "time_s,file,x_m,y_m,heading_rad"


def image_of(index: int) -> np.ndarray:
    """Left half red, right half blue; brighter from frame to frame."""
    image = np.zeros((8, 16, 3), np.uint8)
    image[:, :8, 0], image[:, 8:, 2] = 80 + 20 * index, 80 + 20 * index
    return image


def write_folder(folder: Path, depth: bool = False) -> Path:
    images = np.stack([image_of(i) for i in range(COUNT)])
    extra = {"depth_file": "depth.safetensors"} if depth else {}
    write_transforms(folder, images, CAMERA, POSES, extra)
    if depth:
        values = np.full((COUNT, 8, 16), 3.0, np.float32)
        values[:, 0], values[:, 1] = np.inf, np.nan
        files.write_safetensors(folder / "depth.safetensors", {"depth": values})
    return folder


def csv_rows(period: float = 0.1) -> list[str]:
    return [
        f"{period * i},{i}.png,{x},{y},{theta}"
        for i, (x, y, theta) in enumerate(STATES)
    ]


def write_csv_folder(folder: Path, header: str = CSV, rows=None) -> Path:
    folder.mkdir()
    for i in range(COUNT):
        files.write_image(folder / f"{i}.png", image_of(i))
    text = "\n".join([header, *(csv_rows() if rows is None else rows)])
    files.write_text(folder / "poses.csv", text + "\n")
    return folder


def write_drive_video(folder: Path, table: bool = True) -> Path:
    path = folder / "drive.mp4"
    write_video(path, (image_of(i) for i in range(COUNT)), 10)
    if table:
        names = [f"{i}.png" for i in range(COUNT)]
        write_poses(folder / "drive.json", names, CAMERA, POSES)
    return path


def stamped(seconds: float, frame: str = "") -> dict:
    sec, nanosec = divmod(round(seconds * 1e9), 10**9)
    return {"header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}}


def quaternion(matrix: np.ndarray) -> dict[str, float]:
    from scipy.spatial.transform import Rotation

    values = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return dict(zip("xyzw", values.tolist(), strict=True))


def pose_of(matrix: np.ndarray) -> dict:
    position = dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
    return {"position": position, "orientation": quaternion(matrix)}


def pose_message(seconds: float, matrix: np.ndarray) -> dict:
    return {**stamped(seconds, "world"), "pose": pose_of(matrix)}


def image_message(folder: Path, seconds: float, index: int) -> dict:
    files.write_image(folder / "one.png", image_of(index))
    data = (folder / "one.png").read_bytes()
    return {**stamped(seconds, "camera"), "data": data, "format": "png"}


_REGION = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
CALIBRATION = stamped(0.0) | {"width": 16, "height": 8, "distortion_model": "plumb_bob"}
CALIBRATION |= {"d": [0.0] * 5, "k": [8.0, 0.0, 7.5, 0.0, 8.0, 3.5, 0.0, 0.0, 1.0]}
CALIBRATION |= {"r": [0.0] * 9, "p": [0.0] * 12, "binning_x": 0, "binning_y": 0}
CALIBRATION |= {"roi": {**_REGION, "do_rectify": False}}


def log_messages(folder: Path) -> dict[str, tuple[str, list[dict]]]:
    """Topic -> kind and messages: a log from 2026, poses 10 ms after the images."""
    start = 1.77e9
    times = start + 0.1 * np.arange(COUNT)
    images = [image_message(folder, t, i) for i, t in enumerate(times)]
    later = mount_matrix(STATES + [0.05, 0.01, 0.0], MOUNT)
    poses = [pose_message(t + 0.01, m) for t, m in zip(times, later, strict=True)]
    return {
        "/camera/image": ("sensor_msgs/CompressedImage", images),
        "/camera/pose": ("geometry_msgs/PoseStamped", poses),
        "/camera/camera_info": ("sensor_msgs/CameraInfo", [dict(CALIBRATION)]),
    }


def write_log(
    path: Path, topics, compression: str = "ZSTD", chunk_size=1 << 20
) -> Path:
    kinds = pytest.importorskip("mcap.writer").CompressionType
    library = pytest.importorskip("mcap_ros2.writer")
    with path.open("wb") as stream:
        writer = library.Writer(stream, chunk_size, getattr(kinds, compression))
        for topic, (kind, messages) in topics.items():
            schema = writer.register_msgdef(full_name(kind), definition(kind))
            for i, message in enumerate(messages):
                writer.write_message(topic, schema, message, i, i)
        writer.finish()
    return path


PINHOLE = (351.2, 349.6, 330.4, 185.3)  # fx, fy, cx, cy of VGA, as OpenCV counts
DISTORTION = (-0.1712, 0.0261, 0.0008, -0.0005, 0.0)  # k1, k2, p1, p2, k3
LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
WIDTH, HEIGHT = 672, 376


def calibration_text(
    distortion: tuple[float, ...] = DISTORTION, is_apart: bool = False
) -> str:
    """Write a file of VGA and HD720, both eyes, the lens in a section apart or not."""
    lens = [
        f"{name} = {value}\n" for name, value in zip(LENS, distortion, strict=False)
    ]
    sections = "".join(["[LEFT_DISTO]\n", *lens, "\n"]) if is_apart else ""
    for end, scale in (("VGA", 1.0), ("HD", 1280 / 672)):
        for eye in ("LEFT", "RIGHT"):
            sections += f"[{eye}_CAM_{end}]\n"
            values = [scale * value for value in PINHOLE]
            for name, value in zip(("fx", "fy", "cx", "cy"), values, strict=True):
                sections += f"{name} = {value}\n"
            sections += "\n" if is_apart else "".join([*lens, "\n"])
    return sections + "[STEREO]\nBaseline = 119.9\nTY = 0.1\nCV_VGA = 0.002\n"


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the colours, 0 to 255, of what lies in the direction (x, y, 1)."""
    red, green = 128 + 100 * np.sin(25 * x), 128 + 100 * np.cos(25 * y)
    return np.stack([red, green, 128 + 40 * (x + y)], axis=-1)


def both_eyes(distortion: tuple[float, ...] = DISTORTION) -> np.ndarray:
    """Return a frame (376, 1344, 3): the pattern by distorted lenses left, white right.

    The directions are found by fixed-point iteration, in double precision.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, 0.0, 0.0, 0.0)[:8]
    fx, fy, cx, cy = PINHOLE
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    u, v = (columns - cx) / fx, (rows - cy) / fy
    x, y = u, v
    for _ in range(200):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        radial /= 1 + k4 * r2 + k5 * r2**2 + k6 * r2**3
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (u - dx) / radial, (v - dy) / radial
    left = np.rint(pattern(x, y)).astype(np.uint8)
    return np.concatenate([left, np.full_like(left, 255)], axis=1)
