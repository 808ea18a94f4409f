"""Small recorded drives, written to files in every form that can be replayed."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest
from helpers.posed_folders import write_transforms

from mi_nerfattack.capture.transforms import write_poses
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


def stamp(seconds: float) -> dict[str, int]:
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}


def quaternion(matrix: np.ndarray) -> dict[str, float]:
    from scipy.spatial.transform import Rotation

    values = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return dict(zip("xyzw", values.tolist(), strict=True))


def pose_message(seconds: float, matrix: np.ndarray) -> dict:
    position = dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
    pose = {"position": position, "orientation": quaternion(matrix)}
    return {"timestamp": stamp(seconds), "frame_id": "world", "pose": pose}


def image_message(folder: Path, seconds: float, index: int) -> dict:
    files.write_image(folder / "one.png", image_of(index))
    data = base64.b64encode((folder / "one.png").read_bytes()).decode()
    return {"timestamp": stamp(seconds), "data": data, "format": "png"}


CALIBRATION = {
    "width": 16,
    "height": 8,
    "distortion_model": "plumb_bob",
    "D": [0, 0, 0, 0, 0],
    "K": [8.0, 0, 7.5, 0, 8.0, 3.5, 0, 0, 1],
}


def log_messages(folder: Path) -> dict[str, tuple[str, list[dict]]]:
    """Topic -> schema and messages: a log from 2026, poses 10 ms after the images."""
    start = 1.77e9
    times = start + 0.1 * np.arange(COUNT)
    images = [image_message(folder, t, i) for i, t in enumerate(times)]
    poses = [pose_message(t + 0.01, m) for t, m in zip(times, POSES, strict=True)]
    return {
        "/camera/image": ("foxglove.CompressedImage", images),
        "/camera/pose": ("foxglove.PoseInFrame", poses),
        "/camera/calibration": ("foxglove.CameraCalibration", [dict(CALIBRATION)]),
    }


def write_log(
    path: Path, topics, compression: str = "ZSTD", encoding="json", chunk_size=1 << 20
) -> Path:
    writer_module = pytest.importorskip("mcap.writer")
    with path.open("wb") as stream:
        kind = getattr(writer_module.CompressionType, compression)
        writer = writer_module.Writer(stream, chunk_size, kind)
        writer.start()
        for topic, (schema, messages) in topics.items():
            number = writer.register_schema(schema, "jsonschema", b"{}")
            channel = writer.register_channel(topic, encoding, number)
            for i, message in enumerate(messages):
                data = json.dumps(message).encode()
                writer.add_message(channel, log_time=i, data=data, publish_time=i)
        writer.finish()
    return path
