"""The log of a drive: what replays read of it, whole and cut off."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from helpers.driving_stand_ins import (
    CAMERA,
    RADIUS,
    SPEED,
    WALL_NS,
    Bench,
    StandInCamera,
    StandInTracker,
)

from mi_nerfattack.deploy.replay.environment import ReplayEnvironment, open_recording
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.robot.drive.log import DriveLog
from mi_nerfattack.vehicle.route.route import Route

ROUTE = Route("line", 0, np.array([(0.0, 0.0), (1.0, 0.0)]))


def drive(path, bench: Bench, duration_s: float = 3.0):
    bench.at(0.5, partial(setattr, bench, "held", True))
    return bench.drive(path, duration_s=duration_s)


def test_a_replay_shows_what_was_driven(tmp_path, variant):
    path, bench = tmp_path / "drive.mcap", Bench()
    _, loop = drive(path, bench)
    recording = open_recording(path, None, CameraMount())
    assert recording.camera == CAMERA
    times = recording.track.times
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-6)
    first = (round((times[0] - 1e-9 * WALL_NS) / 0.1)) % 256
    assert abs(int(recording.image(0)[0, 0, 0]) - first) <= 2  # as JPEG
    environment = ReplayEnvironment(recording, CameraMount())
    environment.reset(ROUTE)
    for _ in range(20):
        environment.step(0.0)
    turn = (times[20] - 1e-9 * WALL_NS) * SPEED / RADIUS
    x, y, heading = environment.state
    # a pose every 20 ms, the nearest to the frame
    assert np.hypot(x - RADIUS * np.sin(turn), y + RADIUS * np.cos(turn)) < 0.011
    assert heading == pytest.approx(turn, abs=0.01)
    environment.close()


def test_a_drive_whose_tracker_was_lost_is_replayed_up_to_there(tmp_path, variant):
    path, bench = tmp_path / "drive.mcap", Bench()
    bench.at(2.0, lambda: bench.silent.update(tracker=bench.now))
    stop, _ = drive(path, bench)
    assert stop.cause.value == "pose old"
    recording = open_recording(path, None, CameraMount())
    assert len(recording.track.times) >= 13


def test_a_log_of_a_killed_process_lacks_half_a_second_at_most(tmp_path, variant):
    path, bench = tmp_path / "drive.mcap", Bench()

    def kill() -> None:  # what is not in the file at this moment is lost
        (tmp_path / "killed.mcap").write_bytes(path.read_bytes())

    bench.at(2.5, kill)
    drive(path, bench)
    recording = open_recording(tmp_path / "killed.mcap", None, CameraMount())
    times = recording.track.times - 1e-9 * WALL_NS
    # frames come 0.1 s apart, 0.03 s late
    assert 2.5 - 0.5 - 0.15 <= times[-1] <= 2.5 and len(times) >= 14
    assert "cut off" in recording.remarks[0]
    whole = open_recording(path, None, CameraMount())
    assert not whole.remarks
    np.testing.assert_array_equal(recording.image(3), whole.image(3))


def test_both_clocks_are_kept(tmp_path):
    reader = pytest.importorskip("mcap.reader")
    path, bench = tmp_path / "drive.mcap", Bench()
    drive(path, bench, 1.0)
    with path.open("rb") as stream:
        log = reader.make_reader(stream)
        kept = {item.name: item.metadata for item in log.iter_metadata()}
        assert kept["drive"] == {"policy": "stand-in"}
        start, wall = (
            float(kept["clocks"]["monotonic_s"]),
            int(kept["clocks"]["wall_ns"]),
        )
        assert (start, wall) == (bench.start_s, WALL_NS)
        for _, channel, message in log.iter_messages(["/command", "/camera/image"]):
            since = 1e-9 * (message.log_time - wall)
            age = 1e-9 * (message.log_time - message.publish_time)
            assert 0.5 <= since <= bench.now - start and 0 <= age < 0.15
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
