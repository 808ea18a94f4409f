"""Recorded drives: folders, videos and logs, good and bad."""

from __future__ import annotations

import math
from pathlib import Path

import av
import numpy as np
import pytest
from helpers.recorded_drives import (
    CAMERA,
    COUNT,
    MOUNT,
    POSES,
    STATES,
    csv_rows,
    image_of,
    log_messages,
    pose_message,
    quaternion,
    write_csv_folder,
    write_drive_video,
    write_folder,
    write_log,
)
from helpers.small_fields import homogeneous

from mi_nerfattack.capture.pose_files import pose_matrix
from mi_nerfattack.deploy.replay.environment import ReplayEnvironment, open_recording
from mi_nerfattack.deploy.replay.recording import nearest_pose
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.route.route import Route

ROUTE = Route("any", 0, np.array([[0.0, 0.0], [9.0, 0.0]]))

pytestmark = pytest.mark.usefixtures("variant")


def assert_same_camera(camera: Camera) -> None:
    for name in ("width", "height", "fx", "fy", "cx", "cy", "k1"):
        assert getattr(camera, name) == pytest.approx(getattr(CAMERA, name)), name


def replay(path: Path, camera=CAMERA, period: float = 0.1) -> ReplayEnvironment:
    return ReplayEnvironment(open_recording(path, camera, MOUNT, period), MOUNT, period)


@pytest.mark.parametrize(
    ("write", "tolerance"),
    [
        (lambda folder: write_folder(folder / "frames"), 0),
        (lambda folder: write_csv_folder(folder / "frames"), 0),
        (lambda folder: write_log(folder / "drive.mcap", log_messages(folder)), 0),
        (write_drive_video, 6),  # it is compressed
    ],
)
def test_a_recording_is_shown_frame_by_frame(tmp_path, write, tolerance):
    environment = replay(write(tmp_path))
    frame = environment.reset(ROUTE, np.array([5.0, 5.0, 1.0]), seed=7)
    for index in range(COUNT):
        middle = frame.image[:, [1, 14]].astype(int)  # away from the edge of colours
        wanted = image_of(index)[:, [1, 14]].astype(int)
        assert abs(middle - wanted).max() <= tolerance
        assert frame.image.dtype == np.uint8 and frame.depth.dtype == np.float32
        assert np.isposinf(frame.depth).all() and frame.depth.shape == (8, 16)
        np.testing.assert_allclose(frame.camera_to_world, POSES[index], atol=1e-9)
        np.testing.assert_allclose(environment.state, STATES[index], atol=1e-9)
        assert environment.is_over == (index == COUNT - 1)
        if not environment.is_over:
            frame = environment.step(0.1 * index)
    assert environment.controls == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    with pytest.raises(InputError, match="the recording is over after 5 steps"):
        environment.step(0.0)
    frame = environment.reset(ROUTE)
    assert abs(frame.image[:, 1].astype(int) - image_of(0)[:, 1]).max() <= tolerance
    assert environment.controls == [] and not environment.is_over
    environment.close()


def test_frames_are_picked_by_the_period(tmp_path):
    write_csv_folder(tmp_path / "frames", rows=csv_rows(0.05))
    environment = replay(tmp_path / "frames", period=0.15)
    environment.reset(ROUTE)
    seen = [environment.state[0]]
    while not environment.is_over:
        environment.step(0.0)
        seen.append(environment.state[0])
    # recorded every 0.05 s up to 0.25 s, shown at 0, 0.15 and 0.3 s: every third
    # frame, and at last the one nearest to 0.3 s
    np.testing.assert_allclose(seen, [0.0, 1.5, 2.5])


def test_depth_of_capture_is_read_and_unknown_depth_is_far(tmp_path):
    environment = replay(write_folder(tmp_path / "frames", depth=True))
    depth = environment.reset(ROUTE).depth
    assert np.isposinf(depth[:2]).all() and (depth[2:] == 3.0).all()


@pytest.mark.parametrize(("with_depth", "is_seen"), [(True, False), (False, True)])
def test_objects_are_behind_recorded_depth_alone(tmp_path, with_depth, is_seen):
    environment = replay(write_folder(tmp_path / "frames", depth=with_depth))
    plain = environment.reset(ROUTE)
    ahead = POSES[0][:3, 3] + 6 * POSES[0][:3, 2]
    ball = PosedField(homogeneous(20.0), Pose.upright(tuple(ahead), 0.0, 2.0))
    environment.show([ball])
    frame = environment.reset(ROUTE)
    assert (frame.image[4, 8] != plain.image[4, 8]).any() == is_seen
    assert np.isfinite(frame.depth[4, 8])
    assert (frame.image[7, 0] == plain.image[7, 0]).all()
    environment.show([])
    np.testing.assert_array_equal(environment.reset(ROUTE).image, plain.image)


def test_toml_poses_of_the_camera_and_its_intrinsics(tmp_path):
    write_csv_folder(tmp_path / "frames").joinpath("poses.csv").unlink()
    lines = ["[camera]", "width = 16", "height = 8", "fx = 8.0", "fy = 8.0"]
    lines += ["cx = 8.0", "cy = 4.0"]
    for i, matrix in enumerate(POSES):
        q = {f"q{k}": v for k, v in quaternion(matrix).items()}
        row = dict(zip(("x_m", "y_m", "z_m"), matrix[:3, 3].tolist(), strict=True)) | q
        lines += ["[[frames]]", f"time_s = {i / 10}", f'file = "{i}.png"']
        lines += [f"{key} = {value!r}" for key, value in row.items()]
    files.write_text(tmp_path / "frames" / "poses.toml", "\n".join(lines))
    recording = open_recording(tmp_path / "frames", None, MOUNT)
    assert_same_camera(recording.camera)
    np.testing.assert_allclose(recording.track.camera_to_world, POSES, atol=1e-12)


def test_a_log_of_vehicle_poses(tmp_path):
    topics = log_messages(tmp_path)
    start = 1.77e9
    poses = []
    for i, (x, y, theta) in enumerate(STATES):
        turn = pose_matrix(
            "", (x, y, 0), (math.cos(theta / 2), 0, 0, math.sin(theta / 2))
        )
        poses.append(pose_message(start + 0.1 * i, turn))
    del topics["/camera/pose"]
    topics["/vehicle/pose"] = ("foxglove.PoseInFrame", poses)
    path = write_log(tmp_path / "drive.mcap", topics, "LZ4")
    recording = open_recording(path, None, MOUNT)
    np.testing.assert_allclose(recording.track.camera_to_world, POSES, atol=1e-9)
    assert_same_camera(recording.camera)  # K counts from the first pixel's centre


def test_quaternions_turn_as_they_should():
    # a quarter about z takes x to y
    half = math.sqrt(0.5)
    matrix = pose_matrix("", (1, 2, 3), (half, 0, 0, half))
    np.testing.assert_allclose(matrix @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)
    # a third about (1, 1, 1) takes x to y, y to z
    matrix = pose_matrix("", (0, 0, 0), (0.5, 0.5, 0.5, 0.5))
    np.testing.assert_allclose(matrix[:3, :3] @ np.eye(3)[:, :2], np.eye(3)[:, 1:])


def test_video_poses_with_times_go_to_the_nearest_frame(tmp_path):
    path = write_drive_video(tmp_path, table=False)
    rows = [f"{0.1 * i + 0.02},{x},{y},{t}" for i, (x, y, t) in enumerate(STATES)]
    rows.insert(3, "0.26,9,9,0")  # between two frames, nearer to none
    files.write_text(
        tmp_path / "drive.csv", "\n".join(["time_s,x_m,y_m,heading_rad", *rows])
    )
    recording = open_recording(path, CAMERA, MOUNT)
    np.testing.assert_allclose(recording.track.camera_to_world, POSES, atol=1e-12)


def test_frames_that_a_cut_keeps_but_hides_do_not_count(tmp_path):
    whole, path = write_drive_video(tmp_path, table=False), tmp_path / "cut.mp4"
    with av.open(str(whole)) as source, av.open(str(path), "w") as target:
        stream = source.streams.video[0]
        copy = target.add_stream_from_template(stream)
        start = int(0.2 / stream.time_base)  # from here on, as `ffmpeg -ss 0.2 -c copy`
        for packet in source.demux(stream):
            if packet.dts is not None:
                packet.pts, packet.dts = packet.pts - start, packet.dts - start
                packet.stream = copy
                target.mux(packet)
    rows = [f"{x},{y},{t}" for x, y, t in STATES[2:]]
    files.write_text(tmp_path / "cut.csv", "\n".join(["x_m,y_m,heading_rad", *rows]))
    recording = open_recording(path, CAMERA, MOUNT)
    np.testing.assert_allclose(recording.track.times, 0.1 * np.arange(COUNT - 2))
    for index in range(COUNT - 2):
        wanted = image_of(index + 2)[:, 1].astype(int)
        assert abs(recording.image(index)[:, 1] - wanted).max() <= 6


def test_nearest_pose_of_one_pose():
    assert nearest_pose("f", "p", np.array([1.0]), np.array([1.01])).tolist() == [0]


def test_step_comes_after_reset(tmp_path):
    environment = replay(write_folder(tmp_path / "frames"))
    with pytest.raises(InputError, match="step comes after reset"):
        environment.step(0.0)
    with pytest.raises(InputError, match="state only after reset"):
        _ = environment.state
    environment.reset(ROUTE)
    with pytest.raises(InputError, match="control: nan"):
        environment.step(math.nan)
