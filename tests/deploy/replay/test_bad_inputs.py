"""Recordings that cannot be replayed: one message each."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from support.faults.refusals import refusals
from support.files.recordings import (
    CAMERA,
    COUNT,
    CSV,
    MOUNT,
    csv_rows,
    image_of,
    log_messages,
    stamped,
    write_csv_folder,
    write_drive_video,
    write_folder,
    write_log,
)

from mi_nerfattack.deploy.replay import ros2
from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.deploy.replay.mcap import McapTopics
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import install_hint
from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video

pytestmark = pytest.mark.usefixtures("variant")


def opened(path: Path, camera=None, index=0):
    return open_recording(path, camera, MOUNT).image(index)


def table(*rows: str, header: str = CSV):
    """Open a folder of images with other poses; a row alone is the third of six."""
    rows = (*csv_rows()[:2], *rows, *csv_rows()[3:]) if len(rows) == 1 else rows
    return lambda at: opened(write_csv_folder(at / "a", header, rows), CAMERA)


def pictures(index: int, shape=(8, 16, 3), camera=CAMERA):
    def read(folder):
        write_csv_folder(folder / "a")
        files.write_image(folder / f"a/{index}.png", np.zeros(shape, np.uint8))
        opened(folder / "a", camera, index)

    return read


def film(*rows: str, width=16, count=COUNT):
    def read(folder):
        frames = [image_of(i % COUNT)[:, :width] for i in range(count)]
        write_video(folder / "drive.mp4", frames, 10)
        if rows:
            files.write_text(folder / "drive.csv", "\n".join(rows))
        opened(folder / "drive.mp4", CAMERA, COUNT - 1)

    return read


def transforms(change, **depth):
    """Open a folder of `transforms.json`, changed, with another depth."""

    def read(folder):
        path = write_folder(folder / "a", depth=True)
        text = files.read_json(path / "transforms.json")
        change(text)
        files.write_json(path / "transforms.json", text)
        if depth:
            files.write_safetensors(path / "depth.safetensors", depth)
        opened(path)

    return read


POSE, PLAIN, TIMED = "file,x_m,y_m,z_m,qw,qx,qy,qz", "x_m,y_m,heading_rad", "0.1,0,0,0"
WITH_TIME, NO_DEPTH = f"time_s,{PLAIN}", np.zeros((COUNT, 8, 16), np.float32)
test_recordings_that_are_refused = refusals(
    (table("0.2,2.png,nan,0,0"), "poses.csv: row 2: x_m: 'nan'"),
    (table("0.05,2.png,0,0,0"), "frame 2 is at 0.05 s"),
    (table("0.2,gone.png,0,0,0"), "row 2: 'gone.png'"),
    (table("0,0.png,0", "", header="time_s,file,x_m"), "row 0: .* x_m, y_m, heading"),
    (table("0,0,0,0", "", header=WITH_TIME), "a column 'file'"),
    (table(*([""] * 2)), "poses.csv: no frames"),
    (table("0,0.png,0,0,0", "", header="time,file,x_m,y_m,heading_rad"), ": time: unk"),
    (table("0,0.png,0,0,0", "", header="x_m,file,x_m,y_m,heading_rad"), "x_m: .*twice"),
    (table("0.png,0,0,1,0,0,0,0", "", header=POSE), "row 0: .* quaternion"),
    (lambda at: opened(at), "transforms.json"),
    (lambda at: opened(at / "drive.txt"), "drive.txt: not a recording"),
    (lambda at: opened(at / "drive.mp4"), "drive.mp4: does not exist"),
    (pictures(0, camera=None), "no intrinsics"),
    (pictures(0, (8, 16, 4)), "0.png: transparent pixels"),
    (pictures(3, (8, 17, 3)), "3.png: 17 x 8 px; the camera has 16 x 8"),
    (film(), "drive.csv"),
    (film(PLAIN, "0,0,0"), "1 poses, but .* has 6 frames"),
    (film(WITH_TIME, "0,0,0,0", TIMED, "0.5,0,0,0"), "frame 3 at 0.3 s has no pose"),
    (film(WITH_TIME, TIMED, TIMED), "frame 1 is at 0.1 s"),
    (film(PLAIN, *["0,0,0"] * 2, width=12, count=2), "12 x 8 px; .* 16 x 8 px"),
    (transforms(lambda t: t["frames"][2].update(fl_x=9.0)), "2 cameras"),
    (transforms(lambda t: t.update(units="arbitrary")), "units: 'arbitrary'"),
    (transforms(lambda t: t["frames"].pop()), r"\(6, 8, 16\); needs \(5, 8, 16\)"),
    (transforms(lambda t: None, depth=NO_DEPTH), "depth.safetensors: .* 0 or less"),
)


def test_images_and_chunks_of_announced_sizes_are_limited(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(files, "MAX_IMAGE_PIXELS", 100)
        with pytest.raises(InputError, match="16 x 8 px; at most 100 pixels"):
            opened(write_drive_video(tmp_path))
    path = write_log(tmp_path / "drive.mcap", log_messages(tmp_path), "LZ4")
    monkeypatch.setattr(ros2, "MAX_CHUNK_BYTES", 1000)
    with pytest.raises(InputError, match="at most 1000"):
        opened(path)


def test_a_log_that_is_cut_off_is_read_up_to_there(tmp_path):
    topics = log_messages(tmp_path)
    path = write_log(tmp_path / "drive.mcap", topics, chunk_size=1)  # one a message
    raw, counts = path.read_bytes(), []
    for size in range(len(raw) // 6, len(raw), 97):
        path.write_bytes(raw[:size])
        try:
            recording = open_recording(path, CAMERA, MOUNT)
        except InputError as error:
            assert error.where == str(path) and not counts
            continue
        counts.append(len(recording.track.times))
        end, of = map(int, re.findall("[0-9]+", recording.remarks[0])[:2])
        assert of == size and size - 1300 < end <= size  # a definition is the longest
        assert len(recording.remarks) == (1 if counts[-1] == COUNT else 2)
    assert counts == sorted(counts) and set(counts) >= {1, COUNT}


def test_frames_without_poses_at_both_ends_are_left_out(tmp_path):
    topics = log_messages(tmp_path)
    del topics[POSES][1][-1], topics[POSES][1][0]
    path = write_log(tmp_path / "drive.mcap", topics)
    recording = open_recording(path, None, MOUNT)
    assert len(recording.track.times) == COUNT - 2
    assert "frames 1 to 4 of 6 are read" in recording.remarks[0]
    np.testing.assert_array_equal(recording.image(0), image_of(1))


def log(change=lambda topics: None, damage=lambda path: None):
    def read(folder):
        topics = log_messages(folder)
        change(topics)
        path = write_log(folder / "drive.mcap", topics)
        damage(path)
        opened(path, index=1)

    return read


def edited(topic: str, index: int, **values):
    return log(lambda topics: topics[topic][1][index].update(values))


def pose_at(x: float, w: float) -> dict:
    position = {"x": x, "y": 0.0, "z": 0.0}
    return {"position": position, "orientation": position | {"x": 0.0, "w": w}}


def other_schema(path: Path) -> None:
    with path.open("wb") as stream:
        writer = pytest.importorskip("mcap.writer").Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        channel = writer.register_channel("/front", "json", schema)
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()


TOPICS = (["image"], ["image="], ["depth=/a"], ["image=/a", "image=/b"])
IMAGES, POSES, INFO = "/camera/image", "/camera/pose", "/camera/camera_info"
test_logs_that_are_refused = refusals(
    (log(lambda t: t.pop(IMAGES)), "drive.mcap: .* sensor_msgs/msg/CompressedImage"),
    (log(lambda t: t.pop(POSES)), "geometry_msgs/msg/PoseStamped"),
    (log(lambda t: t.pop(INFO)), "no intrinsics"),
    (edited(IMAGES, 2, **stamped(1.0)), "frame 2 is at 1 s"),
    (edited(IMAGES, 1, data=b"AAAA"), "frame 1: not an image"),
    (edited(POSES, 1, pose=pose_at(0, 0.0)), "quaternion"),
    (edited(POSES, 3, pose=pose_at(math.nan, 1.0)), "/camera/pose: "),
    (log(lambda t: t[POSES][1].__delitem__(slice(2, 4))), "frame 3 at .* 0.1 s"),
    (edited(INFO, 0, k=[0.0] * 9), "/camera/camera_info: "),
    (edited(INFO, 0, d=[0, 0, 0, 0, 1.0]), "plumb_bob"),
    (edited(INFO, 0, distortion_model="rational"), "'rational'"),
    *((lambda t=t: McapTopics.parse(t), "--topics: .*image") for t in TOPICS),
    (log(damage=other_schema), "/front .*'foxglove.CompressedImage' in 'json'"),
)


def test_mcap_is_not_installed(tmp_path, monkeypatch):
    path = write_log(tmp_path / "drive.mcap", log_messages(tmp_path))
    for name in list(sys.modules):
        if name.split(".")[0] in ("mcap", "mcap_ros2"):
            monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=re.escape(install_hint("mcap"))):
        opened(path)
