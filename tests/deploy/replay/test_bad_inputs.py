"""Recordings that cannot be replayed: one message each."""

from __future__ import annotations

import json
import math
import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.recorded_drives import (
    CAMERA,
    COUNT,
    CSV,
    MOUNT,
    csv_rows,
    image_of,
    log_messages,
    write_csv_folder,
    write_drive_video,
    write_folder,
    write_log,
)

from mi_nerfattack.deploy.replay import mcap as replay_mcap
from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video
from mi_nerfattack.system.extras import install_hint

pytestmark = pytest.mark.usefixtures("variant")


def refused(message: str, path: Path, camera=None):
    with pytest.raises(InputError, match=message):
        open_recording(path, camera, MOUNT)


def changed(rows: list[str], index: int, text: str) -> list[str]:
    return [*rows[:index], text, *rows[index + 1 :]]


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        (CSV, changed(csv_rows(), 2, "0.2,2.png,nan,0,0"), "row 2: x_m: 'nan'; must"),
        (CSV, changed(csv_rows(), 2, "0.2,2.png,x,0,0"), "row 2: x_m: 'x'; must"),
        (CSV, changed(csv_rows(), 2, "0.2,2.png,1"), "row 2 has 3 values; .* 5"),
        (CSV, changed(csv_rows(), 2, "0.05,2.png,0,0,0"), "frame 2 is at 0.05 s.*sort"),
        (
            CSV,
            changed(csv_rows(), 2, "0.2,2.png,2e9,0,0"),
            "frame 2 is at .*at most 1e",
        ),
        (CSV, changed(csv_rows(), 2, "0.2,gone.png,0,0,0"), "'gone.png' is not there"),
        (CSV, changed(csv_rows(), 2, "0.2,,0,0,0"), "row 2: file: ''; needs a path"),
        (CSV, changed(csv_rows(), 2, ",2.png,0,0,0"), "row 2: time_s: ''; must"),
        ("time_s,file,x_m", ["0,0.png,0"], "row 0: no pose; needs x_m, y_m, heading"),
        ("time_s,x_m,y_m,heading_rad", ["0,0,0,0"], "name no images; add a column"),
        ("", [], "poses.csv: empty"),
        (CSV, [], "poses.csv: no frames"),
        (
            "file,x_m,y_m,z_m,qw,qx,qy,qz",
            ["0.png,0,0,1,0,0,0,0"],
            "row 0: position .* quaternion .* length 1",
        ),
    ],
)
def test_pose_files(tmp_path, header, rows, message):
    refused(message, write_csv_folder(tmp_path / "frames", header, rows), CAMERA)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frames = 3", "needs a .*frames.* table per frame"),
        ("[camera]\nwidth = 3\n[[frames]]", "camera: cx, cy, fx, fy, height; needs"),
        ("camera = 1\n[[frames]]\nx_m = 0", "camera: needs a .camera. table"),
        (
            "[camera]\nwidth=0\nheight=8\nfx=1\nfy=1\ncx=1\ncy=1\n[[frames]]",
            "camera.width: 0; must be positive",
        ),
        ("frames = [", "must be valid TOML"),
    ],
)
def test_toml_files(tmp_path, text, message):
    folder = write_csv_folder(tmp_path / "frames")
    (folder / "poses.csv").unlink()
    files.write_text(folder / "poses.toml", text)
    refused(message, folder, CAMERA)


def test_recordings_that_lack_something(tmp_path):
    refused("no poses; looked for transforms.json", tmp_path)
    refused("not a recording; give a folder, a video", tmp_path / "drive.txt")
    refused("does not exist", tmp_path / "drive.mp4")
    folder = write_csv_folder(tmp_path / "frames")
    refused("no intrinsics; add a camera, or give one", folder)
    files.write_image(folder / "0.png", np.zeros((8, 16, 4), np.uint8))
    refused("0.png: transparent pixels", folder, CAMERA)
    path = write_drive_video(tmp_path, table=False)
    refused("no pose file beside it; add one of drive.csv", path, CAMERA)
    write_video(path, [image_of(0)[:, :12]] * 2, 10)
    files.write_text(tmp_path / "drive.csv", "x_m,y_m,heading_rad\n0,0,0\n1,0,0\n")
    refused("12 x 8 px; the camera has 16 x 8 px", path, CAMERA)


def test_a_frame_of_another_size(tmp_path):
    folder = write_csv_folder(tmp_path / "frames")
    files.write_image(folder / "3.png", np.zeros((8, 17, 3), np.uint8))
    recording = open_recording(folder, CAMERA, MOUNT)
    recording.image(2)
    with pytest.raises(InputError, match="3.png: 17 x 8 px; the camera has 16 x 8"):
        recording.image(3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["frames"][1].pop("transform_matrix"), r"frames\[1\].transform_m"),
        (lambda t: t["frames"].insert(1, 5), r"frames\[1\]: 5; needs an object"),
        (lambda t: t["frames"][2].update(fl_x=9.0), "2 cameras; a drive is recorded"),
        (lambda t: t["frames"][2].update(time_s=0.5), "row 0: time_s: None"),
        (lambda t: t.update(units="arbitrary"), "units: 'arbitrary'; .*metres-per-uni"),
        (lambda t: t.update(depth_file=7), "depth_file: 7; needs a path"),
        (lambda t: t["frames"].pop(), r"shape \(6, 8, 16\); needs \(5, 8, 16\)"),
    ],
)
def test_transforms_files(tmp_path, change, message):
    folder = write_folder(tmp_path / "frames", depth=True)
    path = folder / "transforms.json"
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    refused(message, folder)


def test_depth_of_zero(tmp_path):
    folder = write_folder(tmp_path / "frames", depth=True)
    depth = np.zeros((COUNT, 8, 16), np.float32)
    files.write_safetensors(folder / "depth.safetensors", {"depth": depth})
    refused("a depth of 0 or less", folder)


def test_a_video_of_more_pixels_than_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MAX_IMAGE_PIXELS", 100)
    refused("16 x 8 px; at most 100 pixels", write_drive_video(tmp_path))


@pytest.mark.parametrize("keep", [0, 30, 0.3, 0.6])
def test_truncated_videos(tmp_path, keep):
    path = write_drive_video(tmp_path)
    raw = path.read_bytes()
    path.write_bytes(raw[: int(keep if keep >= 1 else keep * len(raw))])
    refused("drive.mp4: .*(truncated|damaged)", path)


def test_a_video_whose_content_is_damaged(tmp_path):
    path = write_drive_video(tmp_path)
    raw = bytearray(path.read_bytes())
    start = raw.index(b"mdat") + 4
    raw[start : start + 400] = bytes(400)
    path.write_bytes(bytes(raw))
    with pytest.raises(InputError, match="drive.mp4: (damaged|.*ends at)"):
        open_recording(path, None, MOUNT).image(COUNT - 1)


def test_videos_with_a_wrong_byte_are_refused_or_read(tmp_path, rng):
    path = write_drive_video(tmp_path)
    raw = path.read_bytes()
    for _ in range(40):
        damaged = bytearray(raw)
        damaged[rng.integers(len(raw))] ^= int(rng.integers(1, 256))
        path.write_bytes(bytes(damaged))
        try:
            recording = open_recording(path, None, MOUNT)
            assert recording.image(COUNT - 1).shape == (8, 16, 3)
        except InputError as error:
            assert "drive." in str(error)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["x_m,y_m,heading_rad", "0,0,0"], "1 poses, but .* has 6 frames"),
        (
            ["time_s,x_m,y_m,heading_rad", *(f"{t},0,0,0" for t in (0, 0.1, 0.3))],
            "frame 2 at 0.2 s has no pose within 0.05 s",
        ),
        (
            ["time_s,x_m,y_m,heading_rad", "0,0,0,0", "0,0,0,0"],
            "frame 1 is at 0 s, the one before at 0 s",
        ),
    ],
)
def test_poses_that_do_not_fit_a_video(tmp_path, rows, message):
    path = write_drive_video(tmp_path, table=False)
    files.write_text(tmp_path / "drive.csv", "\n".join(rows))
    refused(message, path, CAMERA)


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize(
    ("keep", "message"),
    [
        (0.0, "damaged log .*InvalidMagic"),
        (0.001, "damaged log .*InvalidMagic"),
        (0.4, "no message on .* no frame .cut off; .* bytes are read"),
    ],
)
def test_logs_cut_off_before_a_frame(tmp_path, compression, keep, message):
    path = write_log(tmp_path / "drive.mcap", log_messages(tmp_path), compression)
    raw = path.read_bytes()
    path.write_bytes(raw[: int(keep * len(raw))])
    refused(f"drive.mcap: {message}", path)


def test_a_log_that_is_cut_off_is_read_up_to_there(tmp_path):
    topics = log_messages(tmp_path)
    path = write_log(tmp_path / "drive.mcap", topics, chunk_size=1)  # one a message
    raw, counts = path.read_bytes(), []
    for size in range(len(raw) // 3, len(raw), 97):
        path.write_bytes(raw[:size])
        try:
            recording = open_recording(path, CAMERA, MOUNT)
        except InputError as error:
            assert "no message" in str(error) and not counts
            continue
        counts.append(len(recording.track.times))
        whole, of = map(int, re.findall("[0-9]+", recording.remarks[0])[:2])
        assert of == size and size - 400 < whole <= size
        assert len(recording.remarks) == (1 if counts[-1] == COUNT else 2)
    assert counts == sorted(counts) and set(counts) >= {1, COUNT}


def test_frames_without_poses_at_both_ends_are_left_out(tmp_path):
    topics = log_messages(tmp_path)
    poses = topics["/camera/pose"][1]
    del poses[-1], poses[0]
    path = write_log(tmp_path / "drive.mcap", topics)
    recording = open_recording(path, None, MOUNT)
    assert len(recording.track.times) == COUNT - 2
    assert "frames 1 to 4 of 6 are read" in recording.remarks[0]
    expected = open_recording(
        write_log(tmp_path / "whole.mcap", log_messages(tmp_path)), None, MOUNT
    )
    np.testing.assert_array_equal(recording.image(0), expected.image(1))


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_logs_with_a_wrong_byte_are_refused_or_read(tmp_path, compression, rng):
    path = write_log(tmp_path / "drive.mcap", log_messages(tmp_path), compression)
    raw = path.read_bytes()
    for _ in range(60):
        damaged = bytearray(raw)
        damaged[rng.integers(len(raw))] ^= int(rng.integers(1, 256))
        path.write_bytes(bytes(damaged))
        try:
            recording = open_recording(path, None, MOUNT)
        except InputError as error:
            assert "drive.mcap" in str(error)
        else:
            assert len(recording.track.times) == COUNT


@pytest.mark.parametrize("compression", ["LZ4", "ZSTD"])
def test_chunks_that_announce_too_much(tmp_path, compression, monkeypatch):
    path = write_log(tmp_path / "drive.mcap", log_messages(tmp_path), compression)
    monkeypatch.setattr(replay_mcap, "MAX_CHUNK_BYTES", 1000)
    refused("a chunk of .* bytes; at most 1000 are read", path)


@pytest.mark.parametrize("compression", ["LZ4", "ZSTD"])
def test_chunks_that_announce_too_little(tmp_path, compression):
    path = write_log(tmp_path / "drive.mcap", log_messages(tmp_path), compression)
    raw = bytearray(path.read_bytes())
    # opcode 6, its length, two times, then the size: of the first chunk
    place = raw.index(b"\x06", 8 + 9)
    while struct.unpack_from("<Q", raw, place + 1)[0] > len(raw):
        place = raw.index(b"\x06", place + 1)
    struct.pack_into("<Q", raw, place + 9 + 16, 10)
    path.write_bytes(bytes(raw))
    refused("a chunk of 11 bytes that announces 10", path)


def without(topic: str):
    return lambda topics: topics.pop(topic)


def edited(topic: str, index: int, **values):
    def change(topics):
        topics[topic][1][index].update(values)

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("/camera/image"), "no message on /camera/image, so no frame"),
        (without("/camera/pose"), "no message on /camera/pose or /vehicle/pose"),
        (without("/camera/calibration"), "no intrinsics"),
        (edited("/camera/image", 1, timestamp=3), "message 1: timestamp 3; needs sec"),
        (edited("/camera/image", 1, data="%%"), "/camera/image: data is not base64"),
        (edited("/camera/image", 1, data=5), "/camera/image: data is not base64"),
        (
            edited("/camera/image", 2, timestamp={"sec": 1, "nsec": 0}),
            "frame 2 is at 1 s, the one before",
        ),
        (edited("/camera/pose", 1, pose={}), "pose {}; needs position x, y, z"),
        (
            edited("/camera/pose", 3, pose={"position": {"x": math.nan}}),
            "/camera/pose: message 3: .*NaN is not a JSON",
        ),
        (
            edited("/camera/pose", 5, timestamp={"sec": 1770000000, "nsec": 700000000}),
            "frame 5 at .* has no pose within 0.05 s in /camera/pose",
        ),
        (edited("/camera/calibration", 0, K=[1, 2]), "needs width, height, K and D"),
        (edited("/camera/calibration", 0, D=[0, 0, 0, 0, 1]), "only plumb_bob with k1"),
    ],
)
def test_messages_of_logs(tmp_path, change, message):
    topics = log_messages(tmp_path)
    change(topics)
    refused(message, write_log(tmp_path / "drive.mcap", topics))


def test_other_schemas_and_encodings(tmp_path):
    topics = log_messages(tmp_path)
    path = write_log(tmp_path / "drive.mcap", topics, encoding="protobuf")
    refused("in 'protobuf'; only foxglove.Compressed", path)
    topics["/camera/image"] = ("sensor_msgs/Image", topics["/camera/image"][1])
    path = write_log(tmp_path / "drive.mcap", topics)
    refused("has 'sensor_msgs/Image' messages in 'json'", path)


def test_a_damaged_image_in_a_log(tmp_path):
    topics = log_messages(tmp_path)
    topics["/camera/image"][1][1]["data"] = "AAAA"
    recording = open_recording(write_log(tmp_path / "d.mcap", topics), None, MOUNT)
    recording.image(0)
    with pytest.raises(InputError, match="d.mcap: frame 1: not an image"):
        recording.image(1)


def test_mcap_is_not_installed(tmp_path, monkeypatch):
    path = write_log(tmp_path / "drive.mcap", log_messages(tmp_path))
    for name in list(sys.modules):
        if name.split(".")[0] == "mcap":
            monkeypatch.setitem(sys.modules, name, None)
    refused(re.escape(install_hint("mcap")), path)
