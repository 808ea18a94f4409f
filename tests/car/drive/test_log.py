"""The log of a drive: what replays read of it, whole and cut off."""

from __future__ import annotations

import numpy as np
import pytest
from support.devices.car import (
    CAMERA,
    RADIUS,
    WALL_NS,
    Bench,
    StandInCamera,
    StandInTracker,
)

from mi_nerfattack.car.drive.log import DriveLog
from mi_nerfattack.deploy.replay.environment import ReplayEnvironment, open_recording
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.vehicle.route.route import Route

ROUTE = Route("line", 0, np.array([(0.0, 0.0), (1.0, 0.0)]))


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """The folder of a drive of 3 s, its bench, and what a kill after 2.5 s leaves."""
    folder, bench = tmp_path_factory.mktemp("driven"), Bench()
    path = folder / "drive.mcap"
    bench.at(2.5, lambda: (folder / "killed.mcap").write_bytes(path.read_bytes()))
    bench.press()
    bench.drive(path, duration_s=3.0)
    return folder, bench


def test_a_replay_shows_what_was_driven(driven, variant):
    folder, bench = driven
    recording = open_recording(folder / "drive.mcap", None, CameraMount())
    assert recording.camera == CAMERA and not recording.remarks
    times = recording.track.times
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-6)
    first = (round((times[0] - 1e-9 * WALL_NS) / 0.1)) % 256
    assert abs(int(recording.image(0)[0, 0, 0]) - first) <= 2  # as JPEG
    environment = ReplayEnvironment(recording, CameraMount())
    environment.reset(ROUTE)
    for _ in range(20):
        environment.step(0.0)
    turn = bench.way_m(bench.start_s + times[20] - 1e-9 * WALL_NS) / RADIUS
    x, y, heading = environment.state
    # a pose every 20 ms, and frames at their times
    assert np.hypot(x - RADIUS * np.sin(turn), y + RADIUS * np.cos(turn)) < 0.011
    assert heading == pytest.approx(turn, abs=0.01)
    environment.close()


def test_a_log_of_a_killed_process_lacks_half_a_second_at_most(driven, variant):
    folder, _ = driven
    recording = open_recording(folder / "killed.mcap", None, CameraMount())
    times = recording.track.times - 1e-9 * WALL_NS
    # frames come 0.1 s apart, 0.03 s late
    assert 2.5 - 0.5 - 0.15 <= times[-1] <= 2.5 and len(times) >= 14
    assert "cut off" in recording.remarks[0]
    complete = open_recording(folder / "drive.mcap", None, CameraMount())
    np.testing.assert_array_equal(recording.image(3), complete.image(3))


def test_both_clocks_are_kept(driven):
    reader = pytest.importorskip("mcap.reader")
    folder, bench = driven
    with (folder / "drive.mcap").open("rb") as stream:
        log = reader.make_reader(stream)
        metadata = {item.name: item.metadata for item in log.iter_metadata()}
        assert metadata["drive"] == {"policy": "stand-in"}
        wall = int(metadata["clocks"]["wall_ns"])
        assert (float(metadata["clocks"]["monotonic_s"]), wall) == (
            bench.start_s,
            WALL_NS,
        )
        for _, channel, message in log.iter_messages(["/command", "/camera/image"]):
            since = 1e-9 * (message.log_time - wall)
            age = 1e-9 * (message.log_time - message.publish_time)
            assert 0.5 <= since <= bench.now - bench.start_s and 0 <= age < 0.15
            is_image = channel.topic == "/camera/image"
            assert (age > 0.02) == is_image, "an image is older than its message"


def test_a_log_never_replaces_anything(tmp_path):
    path = tmp_path / "drive.mcap"
    files.write_text(path, "mine")
    with pytest.raises(InputError, match="drive.mcap: exists; choose another name"):
        DriveLog(path, CAMERA, lambda: 0.0, WALL_NS, {})
    assert path.read_text() == "mine"


def test_a_calibration_is_read_back_as_it_was(tmp_path, variant):
    camera = Camera(16, 8, 9.0, 8.5, 8.25, 3.75, -0.1, 0.01, 0.001, -0.002)
    path, bench = tmp_path / "drive.mcap", Bench()
    log = DriveLog(path, camera, bench.clock, WALL_NS, {})
    bench.sleep(0.04)
    log.frame(StandInCamera(bench).newest())
    log.pose(StandInTracker(bench).newest("car"))
    log.close()
    log.close()
    assert open_recording(path, None, CameraMount()).camera == camera
