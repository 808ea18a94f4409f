"""Recorded drives: folders, videos and logs, good and bad."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from support.files.recordings import (
    CAMERA,
    COUNT,
    MOUNT,
    POSES,
    STATES,
    csv_rows,
    image_of,
    log_messages,
    pose_of,
    quaternion,
    stamped,
    write_csv_folder,
    write_drive_video,
    write_folder,
    write_log,
)
from support.worlds.fields import homogeneous

from mi_nerfattack.capture.pose_files import pose_matrix
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.deploy.replay.environment import ReplayEnvironment, open_recording
from mi_nerfattack.deploy.replay.mcap import McapTopics
from mi_nerfattack.deploy.replay.recording import vehicle_states
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.camera.rig import Rig
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
    path = write(tmp_path)
    exact = 1e-5 if path.suffix == ".mcap" else 1e-9  # seconds since 1970 are rounded
    environment = replay(path)
    frame = environment.reset(ROUTE, np.array([5.0, 5.0, 1.0]), seed=7)
    for index in range(COUNT):
        middle = frame.image[:, [1, 14]].astype(int)  # away from the edge of colours
        expected = image_of(index)[:, [1, 14]].astype(int)
        assert abs(middle - expected).max() <= tolerance
        assert frame.image.dtype == np.uint8 and frame.depth.dtype == np.float32
        assert np.isposinf(frame.depth).all() and frame.depth.shape == (8, 16)
        np.testing.assert_allclose(frame.camera_to_world, POSES[index], atol=exact)
        np.testing.assert_allclose(environment.state, STATES[index], atol=exact)
        assert environment.is_over == (index == COUNT - 1)
        if not environment.is_over:
            frame = environment.step(0.1 * index)
    assert environment.controls == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    with pytest.raises(InputError, match="over after 5 steps"):
        environment.step(0.0)
    frame = environment.reset(ROUTE)
    assert abs(frame.image[:, 1].astype(int) - image_of(0)[:, 1]).max() <= tolerance
    assert environment.controls == [] and not environment.is_over
    environment.close()


def test_frames_are_picked_by_the_period(tmp_path):
    write_csv_folder(tmp_path / "frames", rows=csv_rows(0.05))
    environment = replay(tmp_path / "frames", period=0.15)
    environment.reset(ROUTE)
    positions = [environment.state[0]]
    while not environment.is_over:
        environment.step(0.0)
        positions.append(environment.state[0])
    # recorded every 0.05 s up to 0.25 s, shown at 0, 0.15 and 0.3 s: every third
    # frame, and at last the one nearest to 0.3 s
    np.testing.assert_allclose(positions, [0.0, 1.5, 2.5])


@pytest.mark.parametrize(("with_depth", "is_seen"), [(True, False), (False, True)])
def test_objects_are_behind_recorded_depth_alone(tmp_path, with_depth, is_seen):
    environment = replay(write_folder(tmp_path / "frames", depth=with_depth))
    for use in (lambda: environment.step(0.0), lambda: environment.state):
        with pytest.raises(InputError, match="after reset"):
            use()
    plain = environment.reset(ROUTE)
    with pytest.raises(InputError, match="control: nan"):
        environment.step(math.nan)
    assert np.isposinf(plain.depth[:2]).all()  # of capture: unknown
    assert (plain.depth[2:] == (3.0 if with_depth else np.inf)).all()
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
    lines = "[camera] width=16 height=8 fx=8.0 fy=8.0 cx=8.0 cy=4.0".split()
    for i, matrix in enumerate(POSES):
        lines += ["[[frames]]", f"time_s = {i / 10}", f'file = "{i}.png"']
        x, y, z = matrix[:3, 3].tolist()
        row = {"x_m": x, "y_m": y, "z_m": z}
        row |= {f"q{name}": value for name, value in quaternion(matrix).items()}
        lines += [f"{key} = {value!r}" for key, value in row.items()]
    files.write_text(tmp_path / "frames" / "poses.toml", "\n".join(lines))
    recording = open_recording(tmp_path / "frames", None, MOUNT)
    assert_same_camera(recording.camera)
    np.testing.assert_allclose(recording.track.camera_to_world, POSES, atol=1e-12)


def test_poses_of_a_vehicle_are_of_its_rear_axle(tmp_path):
    """The states are of the model's point, here 1.35 m ahead, where the mount is."""
    place = bundled_place("intersection")
    folder = write_csv_folder(tmp_path / "frames")
    place = replace(place, recording=folder).with_rig(Rig.of_one(CAMERA, MOUNT))
    car, poses = place.car, []
    for reference in (0.0, 1.35):
        own = replace(place, car=replace(car, reference=reference))
        with closing(make_environment("replay", own)) as environment:
            environment.reset(STATES[0], 0)
            poses.append(environment.state)
    x, y, heading = STATES[0]
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    np.testing.assert_allclose(poses[0], [x, y, heading], atol=1e-6)
    np.testing.assert_allclose(poses[1] - poses[0], 1.35 * ahead, atol=1e-6)


def test_a_log_of_somebody_else(tmp_path):
    """Raw images, odometry, other names; two cameras need a choice."""
    images, odometry = [], []
    for i, state in enumerate(STATES):
        pixels = image_of(i)[..., ::-1]
        rows = np.zeros((8, 50), np.uint8)  # with two bytes of padding
        rows[:, :48] = pixels.reshape(8, 48)
        raw = {"height": 8, "width": 16, "encoding": "bgr8", "is_bigendian": 0}
        head = stamped(100.0 + 0.1 * i)
        images.append({**head, **raw, "step": 50, "data": rows.tobytes()})
        turn = (math.cos(state[2] / 2), 0, 0, math.sin(state[2] / 2))
        matrix = pose_matrix("", (*state[:2], 0), turn)
        still = {name: dict.fromkeys("xyz", 0.0) for name in ("linear", "angular")}
        none = {"covariance": [0.0] * 36}
        pose = {"pose": pose_of(matrix), **none}
        child = {"child_frame_id": "base_link", "twist": {"twist": still, **none}}
        odometry.append({**head, **child, "pose": pose})
    topics = {
        "/front/image_raw": ("sensor_msgs/Image", images),
        "/back/image_raw": ("sensor_msgs/Image", images[::-1]),
        "/odom": ("nav_msgs/Odometry", odometry),
        "/safety": ("rcl_interfaces/Log", []),
    }
    path = write_log(tmp_path / "other.mcap", topics)
    with pytest.raises(InputError, match="/front/image_raw, /back/.*--topics image="):
        open_recording(path, CAMERA, MOUNT)
    chosen = McapTopics.parse(["image=/front/image_raw"])
    recording = open_recording(path, CAMERA, MOUNT, topics=chosen)
    np.testing.assert_array_equal(recording.image(3), image_of(3))
    np.testing.assert_allclose(recording.track.camera_to_world, POSES, atol=1e-12)


def test_the_pose_of_the_camera_comes_before_that_of_the_vehicle(tmp_path):
    topics = log_messages(tmp_path)
    topics["/odom"] = topics["/camera/pose"]
    path = write_log(tmp_path / "drive.mcap", topics)
    both = McapTopics.parse(["camera_pose=/camera/pose", "vehicle_pose=/odom"])
    recording = open_recording(path, CAMERA, MOUNT, topics=both)
    np.testing.assert_allclose(recording.track.camera_to_world, POSES, atol=1e-5)


def test_frames_that_a_cut_keeps_but_hides_do_not_count(tmp_path):
    video, path = write_drive_video(tmp_path, table=False), tmp_path / "cut.mp4"
    with av.open(str(video)) as source, av.open(str(path), "w") as target:
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
        expected = image_of(index + 2)[:, 1].astype(int)
        assert abs(recording.image(index)[:, 1] - expected).max() <= 6


def test_one_late_frame_does_not_refuse_a_log(tmp_path):
    topics = log_messages(tmp_path)
    late = stamped(1.77e9 + 0.296)  # 4 ms before the next, which the poses are not
    topics["/camera/image"][1][2].update(late)
    recording = open_recording(write_log(tmp_path / "d.mcap", topics), None, MOUNT)
    assert_same_camera(recording.camera)  # K counts from the first pixel's centre
    x = vehicle_states(recording.track, MOUNT)[:, 0]  # 5 m/s, poses 10 ms late
    np.testing.assert_allclose(
        x, 5 * np.array([0, 0.1, 0.296, 0.3, 0.4, 0.5]), atol=1e-5
    )
